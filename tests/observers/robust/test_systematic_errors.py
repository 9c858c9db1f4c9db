"""Errors of sensors and of mounting that last, and cars that drive hard."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.robust.studies import judged
from benchmarks.robust.worlds import estimates, watched
from coopenv.observers.robust.constants import GYRO_BIAS
from coopenv.observers.robust.memory import ERRORS, MOUNTING
from coopenv.scenario import Scenario, load_scenario
from coopenv.world.world import World
from tests.helpers.builders import reset, simulate
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES

Driver = Callable[[World, int, np.ndarray], np.ndarray | float]

CORNERS = [(x, y) for x in (-3.8, 3.8) for y in (-3.8, 3.8)]
SIDES = [
    (sx * a, sy * b) for sx in (-1, 1) for sy in (-1, 1) for a, b in ((5.5, 3.9), (3.9, 5.5), (7.5, 4.0), (4.0, 7.5))
]
HEIGHTS = (0.3, 0.6, 0.9, 0.5, 0.7)


def square(**overrides: object) -> Scenario:
    """Return four cars on an open square whose landmarks are seen by those only that look aside."""
    landmarks = [{"name": f"L{n}", "position": [x, y, HEIGHTS[n % 5]]} for n, (x, y) in enumerate(CORNERS + SIDES)]
    start = {"vehicle_defaults.initial_estimate": {"position_radius": 0.3, "orientation_angle": 0.15}}
    open_space = {"obstacles": [], "landmarks": landmarks, "camera.range": 6.0, "horizon": 20.0}
    return load_scenario(FOUR_WAY, {**open_space, **start, "observer.name": "robust", **overrides})


def weaving(world: World, k: int, phase: np.ndarray) -> np.ndarray:
    """Return actions (W, N, 2) of drivers that weave along their lanes."""
    R, p = estimates(world)
    goal = world.view("goal").astype(float)
    start = world.view("start_position")[:, world.model.landmarks :].astype(float)
    along = (goal - start) / np.linalg.norm(goal - start, axis=-1, keepdims=True)
    ahead = start + along * (np.einsum("wni,wni->wn", p - start, along) + 1.5)[..., None] - p
    heading = np.arctan2(ahead[..., 1], ahead[..., 0]) + 0.6 * np.sin(0.16 * k + phase)
    turn = heading - np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.stack([np.ones_like(turn), 3.0 * np.arctan2(np.sin(turn), np.cos(turn))], -1)


def turning_hard(world: World, k: int, phase: np.ndarray) -> np.ndarray:
    """Return actions (W, N, 2) of drivers that steer as far as they can, to either side in turn."""
    return np.stack([np.full(phase.shape, 0.5), np.sign(np.sin(0.09 * k + phase))], -1)


def driven(
    scenario: Scenario, driver: Driver, worlds: int, dtype: str, seconds: int
) -> tuple[np.ndarray, np.ndarray, World]:
    """Return NEES / 6 (K, W, N) and position errors in m of vehicles under way, and the world in the end."""
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (worlds, len(scenario.vehicles)))
    return watched(
        scenario,
        range(1000, 1000 + worlds),
        10 * seconds,
        6,
        dtype=dtype,
        act=lambda world, k: np.asarray(driver(world, k, phase)),
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_hard_turns_are_in_the_covariance(dtype: str) -> None:
    """Samples of odometry that are held lag behind: with a lag of half a period ANEES would be 1.86."""
    nees, errors, _ = driven(square(), turning_hard, 48, dtype, 14)
    assert 0.8 < np.nanmean(nees[30:]) < 1.2
    assert np.nanpercentile(errors[80:], 95) < 0.03


def test_cars_that_see_little_but_each_other_are_consistent() -> None:
    """With covariances left about poses before their correction ANEES would be 1.6, at worst 80."""
    nees, _, _ = driven(square(), weaving, 96, "float32", 12)
    assert 0.8 < np.nanmean(nees[30:]) < 1.35
    assert np.nanmean(nees[30:] > 5.0) < 3e-3


LASTING = {"noise.odometry_scale": 0.03, "noise.gyro_bias": 0.0087}
YAW_ONLY = LASTING | {"noise.gyro_bias": [0.0, 0.0, 0.0087]}
ROBUST = {"observer.name": "robust"}


def still(world: World, k: int, phase: np.ndarray) -> float:
    """Return the action of who follows a prescribed motion."""
    return 0.0


def normalised_errors(world: World) -> np.ndarray:
    """Return (W, N, 4) errors of the estimated biases and scale in standard deviations."""
    memory: Any = world.memory
    believed, P = memory.member.numpy()[:, :, 1], memory.P.numpy()[:, :, 1, 1]
    scale = believed["v"][..., 0] - world.view("odometry_scale")
    errors = np.concatenate([believed["w"] - world.view("gyro_bias"), scale[..., None]], -1)
    return errors / np.sqrt(np.einsum("wnii->wni", P)[..., :4])


def test_a_small_bias_is_estimated_where_none_is_declared() -> None:
    """Its prior deviation is that of the constants, and the vehicle that sees landmarks reduces it."""
    scenario = load_scenario("busy_intersection_tracking", ROBUST)
    world, prior = simulate(scenario, 1), GYRO_BIAS**2
    reset(world)
    memory: Any = world.memory
    assert (memory.belief.numpy()["first_sender"] == 2).all()
    np.testing.assert_allclose(np.einsum("wnii->wni", memory.P.numpy()[:, :, 1, 1])[..., :3], prior)
    world.advance(480)  # 8 s, in which it would walk by eight times as much
    assert (memory.P.numpy()[0, 0, 1, 1].diagonal()[:3] < 0.5 * (1.0 + 8.0) * prior).all()


@pytest.mark.parametrize("lasting", [LASTING, YAW_ONLY])
def test_vehicles_on_prescribed_paths_know_their_errors(lasting: dict[str, Any]) -> None:
    scenario = load_scenario("busy_intersection_tracking", ROBUST | lasting)
    nees, _, world = driven(scenario, still, 16, "float64", 8)
    assert 0.5 < np.nanmean(nees[20:]) < 1.5
    squared = normalised_errors(world)[:, :3] ** 2  # of those that see landmarks early
    assert (squared.mean(axis=(0, 1)) < 2.0).all()
    assert np.sqrt(world.memory.P.numpy()[:, :3, 1, 1, 3, 3]).max() < 0.02  # it was declared to be 0.03


def test_driven_cars_know_their_errors() -> None:
    nees, _, world = driven(square(**LASTING), weaving, 48, "float32", 10)
    assert 0.5 < np.nanmean(nees[20:]) < 1.5
    assert (normalised_errors(world) ** 2).mean() < 2.0


TURNED = {"camera.extrinsics_error": 0.01745}  # rad per axis: 1 deg


def test_a_declared_turn_of_the_camera_is_estimated_consistently() -> None:
    """A car that goes straight on tells its heading from the camera's by where its odometry leads."""
    nees, _, world = judged("busy_intersection_tracking", range(16), 10, 40, **TURNED)
    assert (nees.mean(axis=0) < 2.5).all()
    R = world.memory.member.numpy()["pose"]["R"][:, 0, MOUNTING]
    turn = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2
    true = world.view("camera_turn")[:, 0]
    frame = world.model.camera.numpy()["rotation"][0]
    error = turn - true @ frame.T
    P = world.memory.P.numpy()[:, 0, MOUNTING, MOUNTING, :3, :3]
    sizes = np.einsum("wi,wi->w", error, np.linalg.solve(P, error[..., None])[..., 0])
    assert sizes.mean() < 9.0  # of three numbers; about 6 was seen, with a standard error of 1.5
    assert np.sqrt((error**2).mean()) < 0.7 * TURNED["camera.extrinsics_error"]


def test_a_declared_error_of_the_focal_length_is_estimated() -> None:
    """Of cameras that look ahead."""
    focal = {"camera.focal_length_error": 0.03, "camera.orientation": "forward"}
    nees, error, world = judged("busy_intersection_tracking", range(16), 10, 20, **focal)
    assert (nees.mean(axis=0) < 2.0).all() and error.mean() < 0.2, (nees.mean(axis=0), error.mean(axis=0))
    known, P = world.memory.member.numpy()["v"][..., ERRORS, 1], world.memory.P.numpy()[..., ERRORS, ERRORS, 4, 4]
    wrong = known - world.view("camera_focal")
    assert (np.square(wrong) / P).mean() < 2.0
    assert np.sqrt(np.square(wrong[:, 0]).mean()) < 0.1 * 0.03  # it sees three landmarks
