"""Same seed, same world: whatever the batch, the neighbours in it, and where a run was interrupted.

With an observer that has no memory, with `robust`, which has one, and with everything that a world can draw.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from coopenv.base.errors import DeviceError
from coopenv.scenario import Scenario
from coopenv.world.world import World
from tests.helpers.builders import (
    State,
    assert_same,
    command,
    constant,
    errors,
    reset,
    same_bits,
    scenario,
    simulate,
    start,
    vehicle,
)
from tests.helpers.warp_calls import DTYPES

WALKING = {"odometry_scale": 0.02, "odometry_scale_walk": 0.01, "gyro_bias": 0.005, "gyro_bias_walk": 0.002}
DRAWN = {
    "faults": {
        "clock_offset": 0.1,
        "restart": {"chance": 0.5, "time_spread": 0.5},
        "corruption": {"probability": 0.3},
        "lie": {"kind": "jump", "chance": 0.5, "start_spread": 0.5},
    },
    "landmark_groups": [
        {"name": "kerb", "count": 1, "lines": [{"start": [-4, 3], "end": [4, -3]}], "height": [0.3, 0.3]}
    ],
    "randomisation": {"camera_range": [0.5, 1.0]},
}


def noisy(noise: dict[str, Any] | None = None, **sections: Any) -> Scenario:
    """Return a world that uses every stream: spreads, noise, misses, losses, driven and prescribed vehicles."""
    pose = {"yaw": 0.3, "position_spread": [0.5, 0.3, 0.1], "yaw_spread": 0.2}
    estimate = {"position_radius": 1.0, "orientation_angle": "uniform"}
    driven = {"initial_estimate": estimate, "motion": {"kind": "driven", "initial_speed": 0.5}}
    turning = constant([0.3, 0, 0], [0, 0, 0.2])
    return scenario(
        [
            {"initial_pose": {"position": [0.0, 0.0, 0.5], **pose}, **driven},
            {"initial_pose": {"position": [-3.0, -2.0, 0.2], **pose}, **driven},
            vehicle((2.0, -4.0, 0.5), initial_estimate=estimate, motion=turning, pace_spread=0.3, presence=0.5),
        ],
        horizon=5.0,
        noise={"velocity": 0.1, "angular_velocity": 0.05, "bearing": {"scale": 0.01}, **(noise or {})},
        camera={"miss_probability": 0.2, "position": [0.2, 0.0, 0.1]},
        v2x={"delay": 2, "loss": 0.3},
        **sections,
    )


def searching(horizon: float = 5.0, observer: str = "robust", **errors: float) -> Scenario:
    """Return a world in which one vehicle knows its start, one searches, and one needs the others."""
    lost = {"position_radius": 4.0, "orientation_angle": "uniform"}
    sure = {"position_radius": 0.1, "orientation_angle": 0.02}
    return scenario(
        [
            vehicle((0.0, 0.0, 0.5), initial_estimate=sure, motion=constant([0.3, 0, 0], [0, 0, 0.2])),
            vehicle((-3.0, -2.0, 0.2), initial_estimate=lost, motion=constant([0.5, 0, 0])),
            vehicle(
                (2.0, -4.0, 0.5),
                initial_estimate=lost,
                motion=constant([0.4, 0, 0], [0, 0, -0.3]),
                neighbours=["L1", "L2", "vehicle_1", "vehicle_2"],
            ),
        ],
        horizon=horizon,
        noise={"velocity": 0.1, "angular_velocity": 0.05, "bearing": {"model": "isotropic", "scale": 0.003}, **errors},
        camera={"orientation": "body", "miss_probability": 0.1, "position": [0.2, 0.0, 0.1]},
        v2x={"delay": 2, "loss": 0.3},
        observer={"name": observer},
    )


MADE = {
    "riccati": noisy(),
    "robust": searching(),
    "robust, errors that last": searching(odometry_scale=0.02, gyro_bias=0.005),
    "all that is drawn": noisy(WALKING, **DRAWN),
}
BOTH = [
    *product(["riccati", "robust"], DTYPES),
    *product(["robust, errors that last", "all that is drawn"], ["float64"]),
]
"""Cases and their precision."""


def played(world: World, ticks: int = 300) -> State:
    """Drive by actions that differ between vehicles and decisions, not between worlds."""
    for decision in range(ticks // 6):
        command(world, np.array([[0.2, 0.4], [-0.3, -0.5], [0, 0]]) * np.cos(decision))
        world.advance(6)
    return world.get_state()


@pytest.mark.parametrize(("name", "dtype"), BOTH)
def test_a_world_does_not_know_its_batch(name: str, dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COOPENV_LANES", "0")
    alone = played(start(MADE[name], [123 + 17], dtype), 150)
    many = played(start(MADE[name], range(123, 123 + 64), dtype), 150)
    assert_same(alone, many, slice(0, 1), slice(17, 18))
    assert alone["tick"][0] == 150
    own = {"riccati": ["position"], "robust": ["observer_member.pose.p"], "all that is drawn": ["parameter"]}
    for field in ("estimate_position", "odometry_velocity", "bearing", *own.get(name, [])):
        assert len(np.unique(many[field].reshape(64, -1), axis=0)) == 64, field
    if name == "robust":
        assert not many["observer_search.active"].all() and (many["observer_belief.members"] == 3).any()
    if name == "all that is drawn":
        assert len(np.unique(many["gyro_bias"].reshape(-1, 3), axis=0)) == 3 * 64  # no two vehicles have the same


@pytest.mark.parametrize("name", MADE)
def test_reset_leaves_nothing_of_the_last_episode(name: str) -> None:
    world = start(MADE[name], [3, 4])
    fresh = world.get_state()
    played(world)
    reset(world, [3, 4])
    again = world.get_state()
    again["actions"] = fresh["actions"]
    assert_same(fresh, again)


@pytest.mark.parametrize("seed", [0, 1, 2**31, 2**32 + 1, 2**63, 2**64 - 1])
def test_seeds_of_every_size(seed: int) -> None:
    assert_same(played(start(noisy(), [seed]), 30), played(start(noisy(), [seed]), 30))
    assert start(noisy(), [seed]).get_state()["seed"][0] == seed


def test_large_seeds_differ_in_their_upper_half() -> None:
    low, high = start(noisy(), [5]).get_state(), start(noisy(), [5 + 2**32]).get_state()
    assert not np.allclose(low["position"], high["position"])


@pytest.mark.parametrize("name", MADE)
def test_reset_by_mask_touches_the_masked_only(name: str) -> None:
    world = start(MADE[name], range(8))
    before = played(world, 60)
    mask = np.array([True, False, True, False, False, True, False, False])
    reset(world, mask=mask)
    after = world.get_state()
    assert_same(before, after, ~mask, ~mask)
    assert (after["tick"] == np.where(mask, 0, 60)).all()
    assert (after["episode"] == mask).all()
    straight = start(MADE[name], range(8))
    played(straight, 60)
    assert_same(played(world, 60), played(straight, 60), ~mask, ~mask)


def test_reset_by_mask_with_seeds() -> None:
    world = start(noisy(), range(4))
    played(world, 30)
    reset(world, [100, 101, 102, 103], mask=np.array([False, True, False, False]))
    assert world.get_state()["seed"].tolist() == [0, 101, 2, 3]
    fresh = start(noisy(), [101])
    command(fresh, world.get_state()["actions"][1:2])
    assert_same(world.get_state(), fresh.get_state(), slice(1, 2))


def test_the_next_episode_differs_and_is_reproducible() -> None:
    world, twin = start(noisy(), [9]), start(noisy(), [9])
    first = world.get_state()
    reset(world)
    second = world.get_state()
    assert second["episode"][0] == 1
    assert second["seed"][0] == 9
    assert not np.allclose(first["start_position"][0, 4:6], second["start_position"][0, 4:6])
    assert not np.allclose(first["estimate_rotation"], second["estimate_rotation"])
    assert not np.allclose(played(start(noisy(), [9]), 6)["odometry_velocity"], played(world, 6)["odometry_velocity"])
    played(twin, 120)  # where an episode ends does not change the next one
    reset(twin)
    assert same_bits(twin.get_state()["start_position"], second["start_position"])
    assert same_bits(twin.get_state()["estimate_position"], second["estimate_position"])


@pytest.mark.parametrize(("name", "dtype"), BOTH)
def test_saved_state_continues_as_if_nothing_happened(name: str, dtype: str) -> None:
    world = start(MADE[name], [1, 2], dtype)
    world.set_parameters({"slip": np.full(2, 2.0), "difficulty": np.full(2, 0.9)}, np.ones(2, bool))
    played(world, 24)  # a vehicle that searches has not found itself
    saved = world.get_state()
    assert name not in ("robust", "robust, errors that last") or saved["observer_search.hypotheses"].any()
    straight = played(world, 90)
    other = start(MADE[name], [77, 78], dtype)
    played(other, 42)
    other.set_state(saved)
    assert_same(saved, other.get_state())
    assert_same(straight, played(other, 90))
    for each in (world, other):
        reset(each)
    assert_same(played(world, 30), played(other, 30))


def test_saved_state_is_a_copy() -> None:
    world = start(noisy(), [1])
    saved = world.get_state()
    kept = {name: value.copy() for name, value in saved.items()}
    played(world, 30)
    assert_same(saved, kept)


@pytest.mark.parametrize("name", ["riccati", "robust"])
def test_set_state_names_what_is_wrong(name: str) -> None:
    world = start(MADE[name], [1])
    saved = world.get_state()
    assert any(field.startswith("observer_") for field in saved) == (name == "robust")
    for field in [field for field in saved if name == "riccati" or field.startswith("observer_search.")]:
        with pytest.raises(ValueError, match=field):
            world.set_state({k: v for k, v in saved.items() if k != field})
        with pytest.raises(ValueError, match=field):
            world.set_state({**saved, field: np.concatenate([saved[field], saved[field]])})


def test_worlds_stop_at_their_horizon() -> None:
    world = start(noisy(), [1, 2])
    world.advance(200)
    reset(world, mask=np.array([False, True]))
    world.advance(200)
    assert world.get_state()["tick"].tolist() == [300, 200]
    ended = world.get_state()
    world.advance(60)
    assert_same(ended, world.get_state(), slice(0, 1), slice(0, 1))


def test_ticks_may_be_advanced_one_by_one_or_together() -> None:
    together, single = start(noisy(), [6]), start(noisy(), [6])
    together.advance(60)
    sent = 0
    for _ in range(60):
        single.advance(1)
        sent += single.state.bytes_sent.numpy()
    single.state.bytes_sent.assign(sent)  # counts what is sent in one call
    assert_same(together.get_state(), single.get_state())


def test_impossible_worlds_are_refused() -> None:
    with pytest.raises(ValueError, match="num_worlds must be at least 1"):
        World(noisy(), 0)
    with pytest.raises(DeviceError, match="did you mean 'float32'"):
        World(noisy(), 1, "float23")
    with pytest.raises(DeviceError, match="unknown device 'gpu'"):
        World(noisy(), 1, "float32", "gpu")


@pytest.mark.parametrize("name", MADE)
def test_threads_change_nothing(name: str) -> None:
    found = []
    for threads in (1, 2, 5):
        world = simulate(MADE[name], 11, threads=threads)
        reset(world, range(11))
        found.append(played(world, 60))
    assert_same(found[0], found[1])
    assert_same(found[0], found[2])


def test_lost_vehicles_find_themselves() -> None:
    world = start(searching(8.0), range(20))  # some wait until two solutions no longer nearly meet
    state = played(world, 480)
    position, _ = errors(world, state)
    assert not state["observer_search.active"].any()
    assert position.max() < 0.2
