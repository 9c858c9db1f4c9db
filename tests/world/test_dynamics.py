"""The bicycle against an ODE solver: circles, limits, lags, dead time, ended vehicles; what an action asks of it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError
from tests.helpers.builders import command, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

DEFAULTS = {
    "wheelbase": 0.324,
    "max_speed": 1.53,
    "max_acceleration": 2.0,
    "max_steering": 0.6981317007977318,
    "max_steering_rate": 2.0,
    "speed_time_constant": 0.1,
    "steering_time_constant": 0.05,
}


def driven(dynamics: dict[str, Any] | None = None, speed: float = 0.0, **sections: Any) -> Any:
    car = vehicle((1.0, -2.0, 0.0), 0.7, motion={"kind": "driven", "initial_speed": speed})
    return scenario([car], dynamics=dynamics or {}, **sections)


def drive(
    made: Any, actions: list[tuple[float, float]], ticks: int = 6, dtype: str = "float64"
) -> list[dict[str, Any]]:
    """Return the state at every decision under a list of actions."""
    world = start(made, 0, dtype)
    states = [world.get_state()]
    for action in actions:
        command(world, action)
        world.advance(ticks)
        states.append(world.get_state())
    return states


def path(states: list[dict[str, Any]]) -> np.ndarray:
    """Return (x, y, yaw, speed, steering) per state."""
    yaw = [Rotation.from_matrix(s["rotation"][0, -1]).as_euler("zyx")[0] for s in states]
    rows = [[*s["position"][0, -1, :2], a, s["speed"][0, 0], s["turn"][0, 0]] for s, a in zip(states, yaw, strict=True)]
    return np.array(rows, dtype=float)


def reference(
    actions: list[tuple[float, float]], d: dict[str, float], speed: float, decision: float = 0.1
) -> np.ndarray:
    """Integrate the bicycle with first-order actuators whose rates are limited."""

    def approach(value: float, target: float, lag: float, rate: float) -> float:
        return float(np.clip((target - value) / lag, -rate, rate))

    y = np.array([1.0, -2.0, 0.7, speed, 0.0])
    rows = [y]
    for throttle, wheel in actions:
        goal_speed = (throttle + 1) / 2 * d["max_speed"]
        goal_angle = float(np.clip(wheel, -1, 1)) * d["max_steering"]

        def rate(
            _: float, s: np.ndarray, goal_speed: float = goal_speed, goal_angle: float = goal_angle
        ) -> list[float]:
            return [
                s[3] * np.cos(s[2]),
                s[3] * np.sin(s[2]),
                s[3] * np.tan(s[4]) / d["wheelbase"],
                approach(s[3], goal_speed, d["speed_time_constant"], d["max_acceleration"]),
                approach(s[4], goal_angle, d["steering_time_constant"], d["max_steering_rate"]),
            ]

        y = solve_ivp(rate, (0, decision), y, rtol=1e-9, atol=1e-10, max_step=1e-3).y[:, -1]
        rows.append(y)
    return np.array(rows)


ACTIONS = [(0.5, 0.8)] * 5 + [(1.0, -0.9)] * 8 + [(-0.6, 0.3)] * 6 + [(-1.0, 0.0)] * 6 + [(0.2, -0.2)] * 5


@pytest.mark.parametrize(("odometry", "tolerance"), [(100.0, 6e-3), (1000.0, 6e-4)])
def test_bicycle_against_an_ode_solver(odometry: float, tolerance: float) -> None:
    """Three seconds of starts, turns and stops; the error falls with the step, which odometry samples shorten."""
    states = drive(driven(rates={"odometry": odometry}), ACTIONS)
    found, expected = path(states), reference(ACTIONS, DEFAULTS, 0.0)
    found[:, 2] = np.unwrap(found[:, 2])
    assert_allclose(found, expected, atol=tolerance)
    assert np.ptp(found[:, 0]) > 1.0


@pytest.mark.parametrize("dtype", DTYPES)
def test_circle_of_the_wheelbase_over_the_tangent(dtype: str) -> None:
    """After the lags have died out the rear axle runs on a circle of radius L / tan(delta), at constant speed."""
    states = drive(driven(), [(0.2, 0.6)] * 80, dtype=dtype)
    rows = path(states)[30:]
    speed, angle = 0.6 * 1.53, 0.6 * DEFAULTS["max_steering"]
    assert_allclose(rows[:, 3], speed, rtol=1e-6)
    assert_allclose(rows[:, 4], angle, rtol=1e-6)
    x, y = rows[:, 0], rows[:, 1]
    fit, *_ = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones(len(x))]), x**2 + y**2, rcond=None)
    radius = np.sqrt(fit[2] + fit[0] ** 2 + fit[1] ** 2)
    assert_allclose(radius, 0.324 / np.tan(angle), rtol=1e-10 if dtype == "float64" else 1e-4)
    turned = np.diff(np.unwrap(rows[:, 2]))
    assert_allclose(turned, 0.1 * speed / radius, rtol=1e-6 if dtype == "float64" else 1e-4)
    twist = states[-1]
    assert_allclose(twist["velocity"][0, -1], [speed, 0, 0], rtol=1e-6)
    assert_allclose(twist["angular_velocity"][0, -1], [0, 0, speed / radius], rtol=1e-4)


def test_truth_and_twist_agree() -> None:
    states = drive(driven(), ACTIONS, ticks=1)
    for before, now in pairwise(states[5:]):
        step = now["position"][0, -1] - before["position"][0, -1]
        mean = (now["velocity"] + before["velocity"])[0, -1, 0] / 2
        assert_allclose(np.linalg.norm(step), mean / 60, atol=1e-4)


NO_LAG = {"speed_time_constant": 0.0, "steering_time_constant": 0.0}
NO_LIMIT = {"max_acceleration": 1e6, "max_steering_rate": 1e6}


def test_lags_and_limits_of_the_actuators() -> None:
    """Speed and steering have lags of first order, each its own, and limits of their rates; without both, neither."""
    t = np.arange(61) / 60
    for actuators, speed, steering in (
        (NO_LIMIT, 1 - np.exp(-t / 0.1), 1 - np.exp(-t / 0.05)),
        (NO_LAG, np.minimum(2.0 * t / 1.53, 1.0), np.minimum(2.0 * t / DEFAULTS["max_steering"], 1.0)),
        (NO_LAG | NO_LIMIT, t > 0.0, t > 0.0),
    ):
        rows = path(drive(driven(actuators), [(1.0, 1.0)] * 60, ticks=1))
        assert_allclose(rows[:, 3], 1.53 * speed, atol=1e-12)
        assert_allclose(rows[:, 4], DEFAULTS["max_steering"] * steering, atol=1e-12)


@pytest.mark.parametrize(("reverse", "lowest"), [(False, 0.0), (True, -1.53)])
def test_action_minus_one_is_the_lowest_speed(reverse: bool, lowest: float) -> None:
    rows = path(drive(driven({"reverse": reverse}, speed=0.8), [(-1.0, 0.0)] * 60))
    assert_allclose(rows[-1, 3], lowest, atol=1e-6)
    assert rows[:, 3].min() >= lowest - 1e-12
    back = (rows[20, :2] - rows[0, :2]) @ [np.cos(0.7), np.sin(0.7)]
    assert -1.9 < back < -1.3 if reverse else 0.1 < back < 0.4  # brakes at 2 m/s^2, with a lag


def test_acceleration_mode() -> None:
    made = driven(speed=0.5, action={"longitudinal": "acceleration"})
    rows = path(drive(made, [(0.25, 0.0)] * 3 + [(-1.0, 0.0)] * 10))
    assert_allclose(rows[:4, 3], 0.5 + 0.05 * np.arange(4), atol=1e-12)
    assert_allclose(rows[-1, 3], 0.0, atol=1e-12)  # no reverse
    full = path(drive(made, [(1.0, 0.0)] * 20))
    assert_allclose(full[-1, 3], 1.53, atol=1e-12)


def test_action_steering_is_narrower_than_the_wheel() -> None:
    rows = path(drive(driven(action={"steering": 0.3}), [(0.0, -1.0)] * 20))
    assert_allclose(rows[-1, 4], -0.3, atol=1e-6)


@pytest.mark.parametrize("latency_ticks", [0, 1, 3, 6])
def test_latency_holds_the_last_action(latency_ticks: int) -> None:
    """With a dead time of n ticks the wheel starts to turn n ticks after the decision."""
    made = driven({"latency": latency_ticks / 60}, speed=0.5)
    world = start(made)
    command(world, [1.0, 1.0])
    steering = [s["turn"][0, 0] for s in run_within_decision(world, 6)]
    assert_allclose(steering[:latency_ticks], 0.0)
    assert (np.diff(steering[max(0, latency_ticks - 1) :]) > 0).all()
    if latency_ticks == 6:  # a whole decision: the next one acts as this one would have
        command(world, [-1.0, -1.0])
        world.advance(6)
        assert world.get_state()["turn"][0, 0] > 0.1


@pytest.mark.parametrize(("dead_band", "moves"), [(0.0, True), (0.2, True), (0.31, False)])
def test_commands_within_the_dead_band_do_not_move(dead_band: float, moves: bool) -> None:
    """A command of 0.3 m/s; one above the band is followed as without it, and steering always is."""
    made = {"dead_band": dead_band}
    wanted = (2 * 0.3 / 1.53 - 1, 0.5)
    rows = path(drive(driven(made), [wanted] * 20))
    assert_allclose(rows[-1, 3], 0.3 if moves else 0.0, atol=1e-6)
    assert rows[-1, 4] > 0.3
    if moves:
        assert_allclose(rows, path(drive(driven(), [wanted] * 20)), atol=0.0)
    stopping = path(drive(driven(made, speed=1.0), [wanted] * 30))
    assert_allclose(stopping[-1, 3], 0.3 if moves else 0.0, atol=1e-6)


def test_the_dead_band_holds_backwards_too() -> None:
    rows = path(drive(driven({"reverse": True, "dead_band": 0.4}), [(-0.2, 0.0)] * 10 + [(-0.4, 0.0)] * 20))
    assert_allclose(rows[10, 3], 0.0, atol=1e-12)
    assert_allclose(rows[-1, 3], -0.4 * 1.53, atol=1e-6)


def test_a_dead_band_above_the_top_speed_is_refused() -> None:
    with pytest.raises(CoopenvError, match=r"dynamics\.?.*dead_band: 2 m/s is above max_speed \(1\.53 m/s\)"):
        driven({"dead_band": 2.0})


def test_gated_commands_change_as_fast_as_is_permitted() -> None:
    """Without lags, so that speed and steering are the commands: 1 m/s^2 and 2 rad/s at ten decisions a second."""
    made = {"gated": True, "max_acceleration": 1.0, "max_steering_rate": 2.0, **NO_LAG}
    rows = path(drive(driven(made), [(1.0, 1.0)] * 6 + [(-1.0, -1.0)] * 6))
    decisions = np.arange(1, 7)
    assert_allclose(rows[1:7, 3], np.minimum(0.1 * decisions, 1.53), atol=1e-9)
    assert_allclose(rows[1:7, 4], np.minimum(0.2 * decisions, 0.6981317), atol=1e-6)
    assert_allclose(rows[7:13, 3], 0.6 - 0.1 * decisions, atol=1e-9)
    ungated = path(drive(driven({**made, "gated": False}), [(1.0, 1.0)] * 3))
    assert_allclose(ungated[1:4, 3], 0.1 * decisions[:3], atol=1e-9)  # the car alone is as slow


def test_a_gate_in_front_of_a_lag_is_slower_than_the_lag_alone() -> None:
    gated, free = (path(drive(driven({"gated": g, "max_acceleration": 1.0}), [(0.0, 0.0)] * 10)) for g in (True, False))
    assert (gated[1:6, 3] < free[1:6, 3] - 0.01).all()
    assert_allclose(gated[-1, 3], free[-1, 3], atol=0.05)


def run_within_decision(world: Any, ticks: int) -> list[dict[str, np.ndarray]]:
    """Return the state after 1, 2, ... ticks of one and the same decision."""
    saved, states = world.get_state(), []
    for elapsed in range(1, ticks + 1):
        world.set_state(saved)
        world.advance(elapsed)
        states.append(world.get_state())
    return states


def test_before_the_first_action_the_speed_is_kept() -> None:
    """During the first dead time there is no action yet: the vehicle rolls on."""
    world = start(driven({"latency": 0.1}, speed=0.8))
    command(world, [-1.0, 1.0])
    world.advance(6)
    assert_allclose(path([world.get_state()])[0, 3:], [0.8, 0.0], atol=1e-12)


def test_initial_speed() -> None:
    rows = path(drive(driven(speed=0.9), [(2 * 0.9 / 1.53 - 1, 0.0)] * 10))
    assert_allclose(rows[:, 3], 0.9, atol=1e-12)
    assert_allclose(rows[-1, :2] - rows[0, :2], 0.9 * np.array([np.cos(0.7), np.sin(0.7)]), atol=1e-12)


def test_an_ended_vehicle_parks() -> None:
    made = scenario(
        [
            vehicle((0, 0, 0), motion={"kind": "driven"}, goal={"position": [0.5, 0, 0], "radius": 0.2}),
            vehicle((0, 5, 0), motion={"kind": "driven"}),
        ]
    )
    world = start(made)
    command(world, [1.0, 0.1])
    states = run(world, 240)
    ended = np.array([s["ended"][0] for s in states])
    first = int(np.argmax(ended[:, 0] != 0))
    assert 0 < first < 120
    assert ended[-1].tolist() == [1, 0]
    after = states[first + 1 :]
    assert all(np.array_equal(s["position"][0, -2], after[0]["position"][0, -2]) for s in after)
    assert all(s["speed"][0, 0] == 0 and (s["velocity"][0, -2] == 0).all() for s in after)
    assert all((s["odometry_velocity"][0, 0] == 0).all() for s in after[2:])
    assert states[-1]["speed"][0, 1] > 1.0
    assert_allclose(states[-1]["command"][0, 0, [0, 2]], [0.0, 2.0])  # to stand


def test_prescribed_and_static_vehicles_ignore_actions() -> None:
    made = scenario([vehicle((0, 0, 0)), vehicle((3, 0, 0), motion={"kind": "constant", "linear": [0.5, 0, 0]})])
    world = start(made)
    command(world, [1.0, 1.0])
    world.advance(60)
    assert_allclose(world.get_state()["position"][0, -2:], [[0, 0, 0], [3.5, 0, 0]], atol=1e-12)


def asked(actions: list[tuple[float, float]], **sections: Any) -> np.ndarray:
    """Return (speed m/s, steering rad, acceleration m/s^2) that each action asks of a default car."""
    world = start(scenario([vehicle(motion={"kind": "driven"})], **sections))
    rows = []
    for action in actions:
        command(world, action)
        world.decide()
        rows.append(world.view("command")[0, 0].copy())
    return np.array(rows)


def test_the_first_entry_spans_the_speeds() -> None:
    rows = asked([(-1.0, 0.0), (0.0, 0.5), (1.0, -1.0), (7.0, -7.0)])
    assert_allclose(rows[:, 0], [0.0, 0.765, 1.53, 1.53])
    assert_allclose(rows[:, 1], np.array([0.0, 0.5, -1.0, -1.0]) * DEFAULTS["max_steering"])
    assert_allclose(rows[:, 2], 2.0)
    both_ways = asked([(-1.0, 0.0), (0.0, 0.0), (0.5, 0.0)], dynamics={"reverse": True, "max_speed": 2.0})
    assert_allclose(both_ways[:, 0], [-2.0, 0.0, 1.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_actions_that_are_not_finite_count_as_zero(bad: float) -> None:
    assert_allclose(asked([(bad, bad)]), asked([(0.0, 0.0)]))
