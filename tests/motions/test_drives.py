"""Kinds of motion against an ODE solver and closed forms; what an action asks of each, and how drivers use them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import action_fields, observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.motions.table import DRIVES, MOTIONS
from coopenv.policies.route_follower import RouteFollower
from coopenv.policies.sets import SetDriver
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.builders import command, scenario, start, vehicle

LIMITS = {
    "wheelbase": 0.3,
    "max_speed": 1.2,
    "reverse": True,
    "max_acceleration": 1.5,
    "max_steering": 0.6,
    "max_steering_rate": 2.5,
    "max_turn_rate": 1.1,
    "max_turn_acceleration": 3.0,
    "max_lateral_speed": 0.7,
    "speed_time_constant": 0.15,
    "steering_time_constant": 0.08,
    "turn_time_constant": 0.12,
}
TURNS = {
    "bicycle": ("max_steering", "max_steering_rate", "steering_time_constant"),
    "differential_drive": ("max_turn_rate", "max_turn_acceleration", "turn_time_constant"),
    "omnidirectional": ("max_turn_rate", "max_turn_acceleration", "turn_time_constant"),
}


def driven(model: str, **sections: Any) -> Scenario:
    car = vehicle((1.0, -2.0, 0.0), 0.7, motion={"kind": "driven"})
    return scenario([car], dynamics={**LIMITS, "model": model}, rates={"odometry": 1000.0}, **sections)


def reference(model: str, actions: np.ndarray, decision: float = 0.1) -> np.ndarray:
    """Integrate a kind with first-order actuators whose rates are limited: (x, y, yaw, speed, turn, lateral speed)."""
    most, change, lag = (LIMITS[key] for key in TURNS[model])
    rows = [np.array([1.0, -2.0, 0.7, 0.0, 0.0, 0.0])]
    for action in actions:
        wanted = np.zeros(3)
        wanted[: len(action)] = action * [LIMITS["max_speed"], most, LIMITS["max_lateral_speed"]][: len(action)]

        def slope(_: float, s: np.ndarray, wanted: np.ndarray = wanted) -> list[float]:
            yaw, speed, turn, lateral = s[2:]
            rate = speed * np.tan(turn) / LIMITS["wheelbase"] if model == "bicycle" else turn
            first, last = LIMITS["speed_time_constant"], LIMITS["max_acceleration"]
            return [
                speed * np.cos(yaw) - lateral * np.sin(yaw),
                speed * np.sin(yaw) + lateral * np.cos(yaw),
                rate,
                float(np.clip((wanted[0] - speed) / first, -last, last)),
                float(np.clip((wanted[1] - turn) / lag, -change, change)),
                float(np.clip((wanted[2] - lateral) / first, -last, last)),
            ]

        rows.append(solve_ivp(slope, (0, decision), rows[-1], rtol=1e-9, atol=1e-10, max_step=2e-3).y[:, -1])
    return np.array(rows)


def path(made: Scenario, actions: np.ndarray) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Return (x, y, yaw, speed, turn, lateral speed) at every decision, and the states."""
    world = start(made)
    states = [world.get_state()]
    for action in actions:
        command(world, action)
        world.advance(6)
        states.append(world.get_state())
    yaw = np.unwrap([Rotation.from_matrix(s["rotation"][0, -1]).as_euler("zyx")[0] for s in states])
    parts = [
        [*s["position"][0, -1, :2], *(s[name][0, 0] for name in ("speed", "turn", "lateral_speed"))] for s in states
    ]
    rows = np.array(parts)
    return np.insert(rows, 2, yaw, axis=1), states


@pytest.mark.parametrize("model", DRIVES)
def test_drive_against_an_ode_solver(model: str) -> None:
    """Starts, turns on the spot, ways backwards and aside; the speeds of the last state are its twist."""
    columns = len(MOTIONS[model].columns)
    rng = np.random.default_rng(3)
    actions = np.repeat(rng.uniform(-1.0, 1.0, (5, columns)), 4, axis=0)
    actions[:4, 0] = 0.0
    found, states = path(driven(model), actions)
    expected = reference(model, actions)
    assert_allclose(found, expected, atol=1.5e-3)
    assert np.ptp(expected[:, 2]) > 0.1
    speed, turn, lateral = found[-1, 3:]
    rate = speed * np.tan(turn) / LIMITS["wheelbase"] if model == "bicycle" else turn
    assert_allclose(states[-1]["velocity"][0, -1], [speed, lateral, 0.0], atol=1e-12)
    assert_allclose(states[-1]["angular_velocity"][0, -1], [0.0, 0.0, rate], atol=1e-12)


def test_a_differential_drive_turns_on_the_spot() -> None:
    found, _ = path(driven("differential_drive"), np.array([[0.0, 1.0]] * 20))
    assert_allclose(found[:, :2], [[1.0, -2.0]] * 21, atol=1e-12)
    assert_allclose(found[-1, 2] - found[-6, 2], 0.5 * LIMITS["max_turn_rate"], rtol=1e-5)


def test_an_omnidirectional_drive_keeps_its_heading_on_a_way_aside() -> None:
    found, _ = path(driven("omnidirectional"), np.array([[0.0, 0.0, -1.0]] * 20))
    assert_allclose(found[:, 2], 0.7, atol=1e-12)
    way = found[-1, :2] - found[-11, :2]
    assert_allclose(way, 0.7 * np.array([np.sin(0.7), -np.cos(0.7)]), rtol=1e-3)


@settings(max_examples=15, deadline=None)
@given(
    model=st.sampled_from(DRIVES),
    levels=st.lists(st.tuples(*[st.floats(-1.0, 1.0)] * 3), min_size=3, max_size=3),
    quarter=st.integers(0, 3),
)
def test_a_way_does_not_depend_on_the_frame(model: str, levels: list[tuple[float, ...]], quarter: int) -> None:
    """A start that is turned and shifted turns and shifts the whole way."""
    actions = np.array(levels)[:, : len(MOTIONS[model].columns)]
    here, _ = path(driven(model), actions)
    turned = 0.5 * np.pi * quarter
    car = vehicle((5.0, 3.0, 0.0), 0.7 + turned, motion={"kind": "driven"})
    there, _ = path(scenario([car], dynamics={**LIMITS, "model": model}, rates={"odometry": 1000.0}), actions)
    R = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    assert_allclose(there[:, :2] - [5.0, 3.0], (here[:, :2] - [1.0, -2.0]) @ R.T, atol=1e-9)
    assert_allclose(there[:, 3:], here[:, 3:], atol=1e-12)


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("bicycle", [("speed", "m/s", -1.2, 1.2), ("steering", "rad", -0.5, 0.5)]),
        ("differential_drive", [("speed", "m/s", -1.2, 1.2), ("turn_rate", "rad/s", -0.9, 0.9)]),
        (
            "omnidirectional",
            [("speed", "m/s", -1.2, 1.2), ("turn_rate", "rad/s", -0.9, 0.9), ("lateral_speed", "m/s", -0.7, 0.7)],
        ),
    ],
)
def test_actions_and_observations_have_the_columns_of_the_kind(model: str, expected: list[Any]) -> None:
    made = driven(
        model,
        action={"steering": 0.5, "turn_rate": 0.9, "pan": {"limit": 0.4, "rate": 1.0}},
        observation={"include": ["self"]},
    )
    *fields, pan = action_fields(made)
    assert [(f.name, f.unit, f.low, f.high) for f in fields] == expected and pan.name == "pan"
    layout = observation_layout(made)
    names = [name for name, *_ in expected[1:]]
    assert [*layout] == [*names, "last_action", "time_left"]
    for name, unit, _, high in expected[1:]:
        assert (layout[name].unit, layout[name].scale) == (unit, high)
    engine = Engine(made)
    engine.reset([0])
    engine.step(np.full((1, 1, made.action_size), 1.0))
    seen = engine.view("observation")[0, 0]
    present = {"steering": "turn", "turn_rate": "turn", "lateral_speed": "lateral_speed"}
    for name in names:
        assert_allclose(layout[name].values(seen), engine.view(present[name])[0], rtol=1e-5)
        assert layout[name].values(seen)[0] > 0.05
    assert engine.view("pan")[0, 0] > 0.0
    engine.close()


def test_vehicles_of_one_scenario_may_have_different_kinds() -> None:
    own = {"model": "omnidirectional", "max_lateral_speed": 0.4}
    cars = [vehicle(motion={"kind": "driven"}), vehicle((0, 3, 0), motion={"kind": "driven"}, dynamics=own)]
    made = scenario(cars, observation={"include": ["self"]})
    first, second = observation_layout(made).actions
    assert [field.name for field in first] == ["speed", "steering", "unused"]
    assert [field.name for field in second] == ["speed", "turn_rate", "lateral_speed"]
    assert [*observation_layout(made)][:3] == ["steering", "turn_rate", "lateral_speed"]
    world = start(made)
    command(world, [1.0, 0.5, 1.0])
    world.advance(60)
    assert_allclose(world.view("velocity")[0, -2:, 1], [0.0, 0.4], atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"model": "bicicle"}, "dynamics.model: unknown model 'bicicle' (did you mean 'bicycle'?)"),
        ({"model": "missing.py:Drive"}, "dynamics.model: 'missing.py:Drive': no such file"),
        ({"max_turn_rate": "3 m/s"}, "max_turn_rate: '3 m/s' has no unit of this key"),
    ],
)
def test_wrong_drives_are_one_line(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(CoopenvError) as caught:
        scenario([vehicle(motion={"kind": "driven"})], dynamics=changes)
    assert line in str(caught.value) and "\n" not in str(caught.value)


def test_limits_of_an_action_are_checked_in_the_unit_of_the_column() -> None:
    made = {"model": "differential_drive", "max_turn_rate": 0.8, "max_steering": 0.3}
    car = [vehicle(motion={"kind": "driven"})]
    assert scenario(car, dynamics=made, action={"steering": 1.0, "turn_rate": 0.7})
    line = r"action\.turn_rate: 0\.9 rad/s is above dynamics\.max_turn_rate \(0\.8 rad/s\)"
    with pytest.raises(CoopenvError, match=line):
        scenario(car, dynamics=made, action={"turn_rate": 0.9})


def test_the_model_of_traffic_drives_bicycles() -> None:
    cars = [{"motion": {"kind": "traffic"}, "routes": ["way"]}, vehicle((9, 9, 0))]
    ways = [{"name": "way", "waypoints": [[0.0, 0.0], [9.0, 0.0]]}]
    with pytest.raises(CoopenvError, match=r"dynamics\.model: 'differential_drive': the model of traffic drives"):
        scenario(cars, routes=ways, dynamics={"model": "differential_drive"})


WAY = {"name": "way", "waypoints": [[0.0, 0.0], [6.0, 0.0], [6.0, 6.0], [12.0, 6.0]], "corner_radius": 1.0}
ARC = np.linspace(0.0, 0.5 * np.pi, 100)
LINE = np.concatenate(
    [
        np.column_stack([np.linspace(0.0, 5.0, 500), np.zeros(500)]),
        np.column_stack([5.0 + np.sin(ARC), 1.0 - np.cos(ARC)]),
        np.column_stack([np.full(400, 6.0), np.linspace(1.0, 5.0, 400)]),
        np.column_stack([7.0 - np.cos(ARC), 5.0 + np.sin(ARC)]),
        np.column_stack([np.linspace(7.0, 12.0, 500), np.full(500, 6.0)]),
    ]
)
"""Points of the way, m, with its rounded corners."""
GROUPS = ("estimate", "odometry", "goal", "route", "self")


@pytest.mark.parametrize("model", DRIVES)
@pytest.mark.parametrize("max_turn_rate", [0.6, 2.0])
def test_route_follower_keeps_to_the_route(model: str, max_turn_rate: float) -> None:
    """Two corners of a radius of 1 m; a drive that turns slowly drives more slowly there."""
    made = scenario(
        [{"routes": ["way"], "motion": {"kind": "driven"}, "goal": {"radius": 0.5}}],
        routes=[WAY],
        dynamics={"model": model, "max_speed": 1.0, "max_turn_rate": max_turn_rate},
        observation={"include": GROUPS},
        observer={"name": "dead_reckoning"},
        noise={"enabled": False},
        horizon=60.0,
    )
    engine, policy = Engine(made), RouteFollower(made)
    engine.reset([0])
    farthest = 0.0
    for _ in range(400):
        engine.step(policy(engine.view("observation")[0])[None])
        if engine.view("ended")[0, 0]:
            break
        farthest = max(farthest, float(np.linalg.norm(LINE - engine.view("position")[0, -1, :2], axis=1).min()))
    assert engine.view("ended")[0, 0] == 1 and farthest < 0.35
    engine.close()


def test_route_follower_drives_each_kind_of_a_mixed_team_by_its_columns() -> None:
    cars = [vehicle(motion={"kind": "driven"}, goal={"position": [9.0, 9.0, 0.0]}) for _ in range(2)]
    cars[1]["dynamics"] = {"model": "differential_drive", "max_turn_rate": 1.2}
    cars[1]["initial_pose"]["position"] = [0.0, 5.0, 0.0]
    made = scenario(cars, observation={"include": GROUPS}, dynamics={"max_speed": 1.0})
    policy = RouteFollower(made)
    steering, rate = policy.pursue(np.array([0.1, 0.1]))
    circle = policy.look_ahead / (2.0 * np.sin(0.1))
    assert_allclose([np.tan(steering) / 0.324, rate / policy.cruise], [1.0 / circle] * 2, rtol=1e-6)
    speeds, turns = np.array([1.0, 1.0]), np.array([0.2, 2.4])
    levels = policy.levels(speeds, turns)
    assert_allclose(levels[0], [1.0, 0.2 / made.limits[0].max_steering], rtol=1e-6)
    assert_allclose(levels[1], [0.0, 1.0], atol=1e-6)  # half the speed, on the circle of 2.4 rad/s at 1 m/s


def test_drivers_refuse_what_they_cannot_drive() -> None:
    with pytest.raises(ValueError, match=r"dynamics\.model must be 'bicycle'"):
        SetDriver(load_scenario("facade", {"dynamics.model": "differential_drive"}), {})
