"""Traffic of simulated worlds: gaps, signals, appearances and departures, the same whoever steps it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import coopenv
from coopenv import ScenarioError
from coopenv.estimation import Outcome, Sight
from coopenv.runs.recorder import record
from tests.helpers.builders import command, run, scenario, start

BODY = {"size": [4.0, 1.8, 1.5], "center": [1.0, 0.0, 0.75]}
DYNAMICS = {"wheelbase": 2.7, "max_speed": 10.0, "max_acceleration": 4.0, "max_steering": 0.6, "max_steering_rate": 1.0}
STREET = {"name": "street", "waypoints": [[0, 0], [300, 0]]}
RATES = {"camera": 10.0, "odometry": 10.0, "decision": 10.0}


def car(*routes: str, **more: Any) -> dict[str, Any]:
    return {"motion": {"kind": "traffic"}, "body": BODY, "routes": list(routes), **more}


def streets(cars: list[dict[str, Any]], *routes: dict[str, Any], **more: Any) -> Any:
    common = {"rates": RATES, "dynamics": DYNAMICS, "horizon": 200.0}
    return scenario(cars, routes=list(routes), **{**common, **more})


def test_the_gap_behind_a_slower_car_is_that_of_the_models_equilibrium() -> None:
    """(s0 + v T) / sqrt(1 - (v / v0)^4), Treiber, Hennecke and Helbing 2000, with s0 = 2 m and T = 1 s."""
    ahead = {"name": "ahead", "waypoints": [[30, 0], [300, 0]]}
    slow = {"dynamics": {"max_speed": 4.0}}
    world = start(streets([car("ahead", **slow), car("street")], STREET, ahead))
    last = run(world, 600)[-1]
    gap = np.diff(last["position"][0, -2:, 0])[0] * -1.0 - BODY["size"][0]
    np.testing.assert_allclose(last["speed"][0], 4.0, atol=0.02)
    assert gap == pytest.approx(6.0 / np.sqrt(1.0 - 0.4**4), rel=0.01)
    np.testing.assert_allclose(last["position"][0, -2:, 1], 0.0, atol=1e-6)


def test_bends_are_taken_within_the_lateral_acceleration_and_near_the_route() -> None:
    bend = {"name": "bend", "waypoints": [[0, 0], [60, 0], [60, -60]], "corner_radius": 6.0}
    states = run(start(streets([car("bend")], bend)), 200)
    speed = np.array([state["speed"][0, 0] for state in states])
    turn = np.array([state["angular_velocity"][0, -1, 2] for state in states])
    assert speed.max() > 6.0
    assert np.abs(speed * turn).max() < 2.5
    x, y = np.array([state["position"][0, -1, :2] for state in states]).T
    aside = np.where((x < 54) & (y > -6), y, np.where(y < -6, x - 60, np.hypot(x - 54, y + 6) - 6.0))
    assert np.abs(aside).max() < 0.7
    assert y[-1] < -20.0


def test_signals_are_obeyed() -> None:
    """A front is beyond the stop line in green, or so soon after that the car could not have stopped."""
    light = {"at": 100.0, "period": 20.0, "start": 5.0, "green": 8.0}
    road = {**STREET, "start_spread": 60.0, "signal": light}
    worlds = 60
    world = start(streets([car("street")], road), range(worlds))
    front = np.array([state["position"][:, -1, 0] + 3.0 for state in run(world, 500)])
    crossed = np.argmax(front > 101.0, axis=0)
    assert (crossed > 0).all()
    phase = (crossed * 0.1 - 5.0) % 20.0
    assert (phase < 8.0 + 10.0 / 4.0).all()
    assert (phase > 8.0).mean() < 0.5
    waiting = np.abs(np.diff(front, axis=0)) < 1e-3
    assert waiting[50:].any()
    assert not ((front[1:] > 101.0) & (front[1:] < 295.0))[waiting].any()


def test_cars_appear_in_their_time_where_there_is_room_and_leave_where_no_route_follows() -> None:
    first, second = (
        {"name": "first", "waypoints": [[0, 0], [60, 0]]},
        {"name": "second", "waypoints": [[60, 0], [99, 0]]},
    )
    watcher = {"initial_pose": {"position": [-5.0, 15.0, 0.5]}}
    cars = [watcher, car("first", entry=[2.0, 12.0]), car("first", entry=[0.0, 0.0])]
    made = streets(
        cars, first, second, termination={"after_arrival": "transit"}, topology={"mode": "sensed", "acyclic": False}
    )
    states = run(start(made, range(50)), 400, "present", "ended", "route_drawn", "position", "sight")
    present = np.array([state["present"][:, -2:] for state in states])
    ended, drawn = (np.array([state[name][:, 1:] for state in states]) for name in ("ended", "route_drawn"))
    position = np.array([state["position"][:, -2:] for state in states])
    begun = np.argmax(present[:, :, 0] > 0, axis=0)
    assert (present[1, :, 1] == 1).all()
    assert ((begun >= 50) & (begun <= 121)).all()  # 50: the one before has made room
    assert stats.kstest((begun[begun > 60] - 60.0) / 60.0, "uniform").pvalue > 1e-3
    apart = np.linalg.norm(position[begun, np.arange(50), 0] - position[begun, np.arange(50), 1], axis=-1)
    assert (apart > 14.0).all()
    assert (position[begun - 1, np.arange(50), 0, 0] == 0.0).all()
    seen = np.array([state["sight"][:, 0, -2] == Sight.VISIBLE for state in states])
    assert not seen[present[:, :, 0] == 0].any()
    assert {*drawn[-1].ravel().tolist()} == {1}
    assert (ended[-1] == Outcome.ARRIVED).all()
    assert (present[-1] == 0).all()
    assert (position[-1, ..., 0] > 98.0).all()


def test_actions_do_not_matter_and_ticks_one_by_one_are_the_same() -> None:
    light = {"at": 100.0, "period": 20.0, "green": 8.0}
    cars = [car("street"), car("street"), car("street", entry=[1.0, 3.0])]
    made = streets(cars, {**STREET, "start_spread": 60.0, "signal": light}, horizon=20.0)
    worlds = start(made, [7, 7])
    command(worlds, np.array([[[0.0, 0.0]], [[1.0, -1.0]]]))
    states = run(worlds, 200)
    np.testing.assert_array_equal(states[-1]["position"][0], states[-1]["position"][1])
    truth = np.array([state["position"][0, -3:] for state in states])
    np.testing.assert_allclose(record(made, 7).truth.position, truth, atol=1e-9)


@pytest.mark.parametrize("seed", [0, 2**31])
def test_cars_of_a_city_do_not_touch(seed: int) -> None:
    overrides = {
        "streets.blocks": [2, 3],
        "vehicles.0.count": 20,
        "vehicles.1.count": 10,
        "observer.name": "dead_reckoning",
    }
    world = start(coopenv.load_scenario("city", overrides), seed)
    touched, there = np.zeros(30, bool), []
    for _ in range(600):
        world.advance(3)
        touched |= world.view("collided")[0] > 0
        there.append(world.view("present")[0, -30:].sum())
    assert not touched.any()
    assert world.view("arrivals")[0].max() >= 3
    assert (world.view("ended")[0] == Outcome.ARRIVED).any()
    assert min(there) >= 10


@pytest.mark.parametrize(
    ("cars", "message"),
    [
        ([{"motion": {"kind": "traffic"}, "initial_pose": {"position": [0, 0, 0]}}], r"vehicles.0.routes"),
        ([car("street", entry=[3.0, 2.0])], r"vehicles.0.entry: the first time, then the last one"),
        ([{"entry": [0.0, 2.0], "initial_pose": {"position": [0, 0, 0]}}], r"vehicles.0.entry: the first time"),
    ],
)
def test_wrong_cars(cars: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        streets(cars, STREET)
