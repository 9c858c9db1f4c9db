"""Errors of sensors that last: how they are drawn, how they walk, and what they do to what is measured."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.spatial.transform import Rotation

from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.estimation.outcomes import Sight
from coopenv.world.state import LASTING_ERRORS
from tests.helpers.builders import constant, run, same_bits, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

WORLDS = 2000
SPREAD = 4 / np.sqrt(2 * WORLDS)  # four standard errors of a standard deviation, relative
TURNING = constant([0.8, 0.0, 0.0], [0.0, 0.0, 0.4])
ALL = {
    "odometry_scale": 0.03,
    "odometry_scale_walk": 0.01,
    "gyro_bias": 0.01,
    "gyro_bias_walk": 0.002,
    "slip": {"rate": 2.0, "duration": 0.2, "size": 0.5, "angle": 0.3},
}
DRAWN = ("odometry_scale", "gyro_bias", "camera_turn", "camera_shift", "camera_focal")
MISPLACED = {"orientation": "forward", "extrinsics_error": 0.02, "extrinsics_position_error": 0.05}


def drawn(noise: dict[str, Any], ticks: int = 0, dtype: str = "float64", **camera: Any) -> dict[str, np.ndarray]:
    """Return the state of many worlds of one vehicle after some ticks."""
    made = scenario([vehicle(motion=TURNING)], noise=noise, camera={"orientation": "forward", **camera})
    world = start(made, range(WORLDS), dtype)
    world.advance(ticks)
    return world.get_state()


@pytest.mark.parametrize("dtype", DTYPES)
def test_errors_of_an_episode_are_normal_and_of_the_stated_size(dtype: str) -> None:
    camera = MISPLACED | {"focal_length_error": 0.04}
    state = drawn({"odometry_scale": 0.03, "gyro_bias": [0.01, 0.0, 0.02]}, 0, dtype, **camera)
    columns = np.column_stack([state[name][:, 0].astype(float) for name in DRAWN])
    sizes = np.array([0.03, 0.01, 0.0, 0.02, *[0.02] * 3, *[0.05] * 3, 0.04])
    assert_allclose(columns.std(axis=0), sizes, rtol=SPREAD)
    normal = columns[:, sizes > 0] / sizes[sizes > 0]
    for column in normal.T:
        assert stats.kstest(column, "norm").pvalue > 1e-4
    assert np.abs(np.corrcoef(normal.T) - np.eye(normal.shape[1])).max() < 4.5 / np.sqrt(WORLDS)


def test_scale_and_bias_walk() -> None:
    """After t seconds the variance has grown by the walk's squared times t."""
    noise = {"odometry_scale": 0.02, "odometry_scale_walk": 0.03, "gyro_bias": 0.01, "gyro_bias_walk": [0.0, 0.0, 0.02]}
    begin, end = drawn(noise), drawn(noise, 90)
    scale = (end["odometry_scale"] - begin["odometry_scale"])[:, 0]
    bias = (end["gyro_bias"] - begin["gyro_bias"])[:, 0]
    assert_allclose(scale.std(), 0.03 * np.sqrt(1.5), rtol=SPREAD)
    assert_allclose(bias.std(axis=0), [0.0, 0.0, 0.02 * np.sqrt(1.5)], rtol=SPREAD)
    assert_allclose(end["odometry_scale"].std(), np.hypot(0.02, 0.03 * np.sqrt(1.5)), rtol=SPREAD)


def test_slips_come_and_go() -> None:
    """Per frame a slip begins with 1 - exp(-rate dt) where there is none, and ends with 1 - exp(-dt / duration)."""
    slip = {"rate": 1.0, "duration": 0.25, "size": 0.4, "angle": 0.2}
    made = scenario([vehicle(motion=TURNING)], noise={"slip": slip})
    states = run(start(made, range(400)), 600)
    slips = np.array([state["slip"][:, 0] for state in states])
    there = (slips != 0.0).any(axis=-1)
    assert not there[0].any()
    began, over = there[1:] & ~there[:-1], there[:-1] & ~there[1:]
    for events, frames, rate in ((began, ~there[:-1], 1.0), (over, there[:-1], 4.0)):
        often = 1 - np.exp(-rate / 60)
        assert events.sum() / frames.sum() == pytest.approx(often, rel=4 / np.sqrt(events.sum()))
    share, angle = slips[1:][began].T
    assert stats.kstest(share / 0.4, "uniform").pvalue > 1e-4
    assert stats.kstest(angle / 0.4 + 0.5, "uniform").pvalue > 1e-4


def test_odometry_reads_the_twist_with_its_errors() -> None:
    states = run(start(scenario([vehicle(motion=TURNING)], noise=ALL), range(40)), 90)
    for before, after in pairwise(states):
        s = {name: after[name][:, 0].astype(float) for name in LASTING_ERRORS}
        speed = 0.8 * (1 + s["odometry_scale"]) * (1 + s["slip"][:, 0])
        angle = s["slip"][:, 1]
        v = np.column_stack([speed * np.cos(angle), speed * np.sin(angle), np.zeros(40)])
        w = s["gyro_bias"] + [0.0, 0.0, 0.4]
        taken = after["odometry_samples"] > before["odometry_samples"]
        assert taken.all()
        assert_allclose(after["odometry_velocity"][:, 0], v, atol=1e-6)
        assert_allclose(after["odometry_angular_velocity"][:, 0], w, atol=1e-6)


def test_white_noise_is_the_same_with_and_without_lasting_errors() -> None:
    white = {"velocity": 0.1, "angular_velocity": 0.05, "bearing": {"scale": 0.01}}
    vehicles = [vehicle(motion=TURNING)]
    plain = run(start(scenario(vehicles, noise=white), range(5)), 30)[-1]
    biased = run(start(scenario(vehicles, noise=white | {"odometry_scale": 0.1, "gyro_bias": 0.2}), range(5)), 30)[-1]
    reads = 0.8 * (1 + biased["odometry_scale"][:, 0])
    assert_allclose(biased["odometry_velocity"][:, 0, 0] - reads, plain["odometry_velocity"][:, 0, 0] - 0.8)
    assert_allclose(
        biased["odometry_angular_velocity"] - biased["gyro_bias"], plain["odometry_angular_velocity"], atol=1e-12
    )
    assert same_bits(biased["bearing"], plain["bearing"])


def test_camera_looks_from_where_it_truly_is() -> None:
    place = [0.3, 0.0, 0.2]
    state = drawn({}, 20, "float64", position=place, **{**MISPLACED, "extrinsics_error": 0.3})
    state = {name: values.astype(float) for name, values in state.items() if values.dtype.kind == "f"}
    R, position = state["rotation"][:, -1], state["position"][:, -1]
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = R @ forward @ Rotation.from_rotvec(state["camera_turn"][:, 0]).as_matrix()
    eye = position + np.einsum("wij,wj->wi", R, np.array(place) + state["camera_shift"][:, 0])
    for target in range(4):
        line = np.einsum("wji,wj->wi", turned, state["position"][:, target] - eye)
        seen = state["bearing"][:, 0, target]
        assert_allclose(seen, line / np.linalg.norm(line, axis=1, keepdims=True), atol=2e-6)


def test_a_longer_focal_length_spreads_the_image() -> None:
    """Pixels are f (1 + e) x, bearings are computed from them with f: the tangents to the optical axis are wider."""
    state = drawn({}, 20, "float64", focal_length_error=0.1)
    state = {name: values.astype(float) for name, values in state.items() if values.dtype.kind == "f"}
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for target in range(4):
        ray = np.einsum(
            "wji,wj->wi", state["rotation"][:, -1] @ forward, state["position"][:, target] - state["position"][:, -1]
        )
        wide, seen = 1.0 + state["camera_focal"][:, 0], state["bearing"][:, 0, target]
        assert_allclose(seen[:, 0] / seen[:, 2], wide * ray[:, 0] / ray[:, 2], rtol=1e-4)
        assert_allclose(seen[:, 1] / seen[:, 2], wide * ray[:, 1] / ray[:, 2], rtol=1e-4)
        assert (np.sign(seen[:, 2]) == np.sign(ray[:, 2])).all()


def test_a_pinhole_s_view_is_that_of_its_true_focal_length() -> None:
    """What is seen of a target falls into the image of (1 + e) f, and back through f."""
    camera = {"model": "pinhole", "focal_length_error": 0.3, "orientation": "forward"}
    made = scenario([vehicle(motion=TURNING)], camera=camera, topology={"mode": "sensed"})
    state = start(made, range(500)).get_state()
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    (fx, fy), (cx, cy), (width, height) = made.camera.focal_length, made.camera.principal_point, made.camera.image_size
    for target in range(4):
        line = state["position"][:, target] - state["position"][:, -1]
        x, y, z = np.einsum("wji,wj->iw", state["rotation"][:, -1] @ forward, line)
        wide = 1.0 + state["camera_focal"][:, 0]
        u, v = fx * wide * x / np.abs(z) + cx, fy * wide * y / np.abs(z) + cy
        inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        assert_array_equal(state["sight"][:, 0, target] == Sight.VISIBLE, inside)


def test_off_draws_nothing() -> None:
    """Neither by default, nor with the noise switched off."""
    silent = drawn(ALL | {"enabled": False}, 10, **MISPLACED)
    default = drawn({}, 10)
    for state in (silent, default):
        for name in LASTING_ERRORS:
            assert not state[name].any(), name
    assert same_bits(silent["bearing"], default["bearing"])
    assert same_bits(silent["increment_rotation"], default["increment_rotation"])


def test_truth_of_them_is_told_as_such() -> None:
    env = CooperativeLocalisationEnv(scenario([vehicle(motion=TURNING)], noise=ALL, camera=MISPLACED), "test")
    _, infos = env.reset(seed=1)
    truth, state = infos["vehicle_1"]["truth"], env.state()
    assert env.state_space.contains(state)
    told = np.concatenate([np.ravel(truth[name]) for name in LASTING_ERRORS])
    assert_allclose(state[-12:], told, atol=1e-6)
    assert np.count_nonzero(told) == 10  # no slip yet
