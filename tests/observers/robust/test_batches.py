"""What the embedded observer `robust` remembers belongs to its world: batches, resets, saved states."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.scenario import Scenario
from coopenv.world.world import World
from tests.helpers.builders import State, assert_same, constant, reset, scenario, simulate, start, vehicle
from tests.helpers.robust_sources import scene
from tests.helpers.warp_calls import DTYPES

LOST = {"position_radius": 4.0, "orientation_angle": "uniform"}
SURE = {"position_radius": 0.1, "orientation_angle": 0.02}


LASTING = {"odometry_scale": 0.02, "gyro_bias": 0.005}


def noisy(horizon: float = 5.0, observer: str = "robust", **errors: float) -> Scenario:
    """Return a world in which one vehicle knows its start, one searches, and one needs the others."""
    wide = {"orientation": "body", "miss_probability": 0.1, "position": [0.2, 0.0, 0.1]}
    return scenario(
        [
            vehicle((0.0, 0.0, 0.5), initial_estimate=SURE, motion=constant([0.3, 0, 0], [0, 0, 0.2])),
            vehicle((-3.0, -2.0, 0.2), initial_estimate=LOST, motion=constant([0.5, 0, 0])),
            vehicle(
                (2.0, -4.0, 0.5),
                initial_estimate=LOST,
                motion=constant([0.4, 0, 0], [0, 0, -0.3]),
                neighbours=["L1", "L2", "vehicle_1", "vehicle_2"],
            ),
        ],
        horizon=horizon,
        noise={"velocity": 0.1, "angular_velocity": 0.05, "bearing": {"model": "isotropic", "scale": 0.003}, **errors},
        camera=wide,
        v2x={"delay": 2, "loss": 0.3},
        observer={"name": observer},
    )


def played(world: World, ticks: int = 150) -> State:
    for _ in range(ticks // 6):
        world.advance(6)
    return world.get_state()


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_world_does_not_know_its_batch(dtype: str) -> None:
    alone = played(start(noisy(), [123 + 17], dtype))
    many = played(start(noisy(), range(123, 123 + 64), dtype))
    assert_same(alone, many, slice(0, 1), slice(17, 18))
    assert not many["observer_search.active"].all() and (many["observer_belief.members"] == 3).any()
    assert len(np.unique(many["observer_member.pose.p"].reshape(64, -1), axis=0)) == 64


def test_threads_change_nothing() -> None:
    worlds = [simulate(noisy(), 8, "float64", threads=threads) for threads in (1, 3)]
    for world in worlds:
        reset(world, range(8))
    assert_same(*(played(world) for world in worlds))


def test_a_reset_leaves_nothing_of_the_last_episode() -> None:
    world = start(noisy(), [3, 4])
    fresh = world.get_state()
    assert not (fresh["observer_search.active"][:, 0]).any() and fresh["observer_search.active"][:, 1:].all()
    played(world)
    reset(world, [3, 4])
    assert_same(fresh, world.get_state())


def test_a_reset_by_mask_touches_the_masked_only() -> None:
    world = start(noisy(), range(6))
    before = played(world, 60)
    mask = np.array([True, False, True, False, False, True])
    reset(world, mask=mask)
    assert_same(before, world.get_state(), ~mask, ~mask)
    straight = start(noisy(), range(6))
    played(straight, 60)
    assert_same(played(world, 60), played(straight, 60), ~mask, ~mask)


@pytest.mark.parametrize(("dtype", "errors"), [*((dtype, {}) for dtype in DTYPES), ("float64", LASTING)])
def test_a_saved_state_continues_as_if_nothing_happened(dtype: str, errors: dict[str, float]) -> None:
    description = noisy(5.0, **errors)
    world = start(description, [1, 2], dtype)
    played(world, 24)  # the second vehicle is still searching
    saved = world.get_state()
    assert saved["observer_search.active"].any() and saved["observer_search.hypotheses"].any()
    straight = played(world, 90)
    other = start(description, [77, 78], dtype)
    played(other, 42)
    other.set_state(saved)
    assert_same(saved, other.get_state())
    assert_same(straight, played(other, 90))


def test_a_state_with_bearings_that_the_gate_rejects_is_accepted() -> None:
    world, rejected = start(scene((1,), 6.0, kind="jump", start=2.0), [3]), False
    while not rejected:
        world.advance(6)
        saved = world.get_state()
        rejected = bool((saved["observer_measurement.fits"] < 0).any())
    world.set_state(saved)
    assert_same(saved, world.get_state())


def test_a_saved_state_without_the_memory_is_refused() -> None:
    world = start(noisy(), [1])
    saved = world.get_state()
    with pytest.raises(ValueError, match="observer_search"):
        world.set_state({name: value for name, value in saved.items() if name != "observer_search.active"})


def test_other_observers_remember_nothing_more() -> None:
    description = noisy().model_copy(update={"observer": noisy().observer.model_copy(update={"name": "riccati"})})
    world = start(description, [1])
    assert not any(name.startswith("observer_") for name in world.get_state())


def test_lost_vehicles_find_themselves() -> None:
    world = start(noisy(horizon=8.0), range(20))  # some wait until two solutions no longer nearly meet
    state = played(world, 480)
    p = np.einsum("wnij,wnj->wni", state["estimate_rotation"], state["estimate_position"])
    error = np.linalg.norm(p - state["position"][:, world.model.landmarks :], axis=2)
    assert not state["observer_search.active"].any()
    assert error.max() < 0.2
