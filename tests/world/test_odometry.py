"""Odometry samples, and the errors of sensors that last: how they are drawn, and what is measured with them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.spatial.transform import Rotation

from coopenv.api.arguments import LASTING_SCALE
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.estimation import Sight
from coopenv.world.state import LASTING_ERRORS
from tests.helpers.builders import command, constant, run, same_bits, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES
from tests.oracles.continuous import left_jacobian
from tests.oracles.geometry import OPTICAL_TO_BODY_FORWARD as FORWARD

NOISE = {"velocity": 0.3, "angular_velocity": 0.2}
SEGMENTS = {
    "kind": "segments",
    "segments": [
        {"duration": 0.123, "linear": [0.5, 0.0, 0.1], "angular": [0.0, 0.1, 0.8]},
        {"duration": 0.2, "linear": [0.2, 0.3, 0.0], "angular": [0.3, 0.0, -2.0]},
    ],
}


def held(times: np.ndarray, v: np.ndarray, w: np.ndarray, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Integrate twists held from their sampling times on (none before the first), from begin to end."""
    R, p = np.eye(3), np.zeros(3)
    edges = np.unique(np.concatenate([[begin, end], times[(times > begin) & (times < end)]]))
    for a, b in pairwise(edges):
        now = np.searchsorted(times, (a + b) / 2, side="right") - 1
        if now < 0:
            continue
        p = p + R @ left_jacobian(w[now] * (b - a)) @ v[now] * (b - a)
        R = R @ Rotation.from_rotvec(w[now] * (b - a)).as_matrix()
    return R, p


@pytest.mark.parametrize("rate", [100.0, 60.0, 37.0, 1000.0, 1.0, 59.9])
def test_sample_counts_and_increments(rate: float) -> None:
    """The noise is read off the held samples of a world of the same seed whose camera is as fast as its odometry."""
    made = scenario([vehicle(motion=SEGMENTS)], rates={"odometry": rate}, noise=NOISE)
    ticks = 150
    read = ("odometry_samples", "odometry_velocity", "odometry_angular_velocity")
    states = run(start(made, 5), ticks, *read, "increment_rotation", "increment_translation")
    count = int(np.floor(ticks / 60 * rate + 1e-9)) + 1
    samples = [int(s["odometry_samples"][0, 0]) for s in states]
    assert samples == [0] + [int(np.floor(k / 60 * rate + 1e-9)) + 1 for k in range(1, ticks + 1)]
    paired = scenario(
        [vehicle(motion=SEGMENTS)], rates={"odometry": rate, "camera": rate, "decision": rate}, noise=NOISE
    )
    fast = run(start(paired, 5), count, *read)
    times = np.arange(count) / rate
    # at tick m of the fast camera the last sample is sample m; sample 0 is heard before tick 1 only
    v = np.array([s["odometry_velocity"][0, 0] for s in fast])[:count]
    w = np.array([s["odometry_angular_velocity"][0, 0] for s in fast])[:count]
    v[0], w[0] = first_sample(rate)
    for k in range(1, ticks + 1):
        R, p = held(times, v, w, (k - 1) / 60, k / 60)
        assert_allclose(states[k]["increment_rotation"][0, 0], R, atol=1e-12, err_msg=f"tick {k}")
        assert_allclose(states[k]["increment_translation"][0, 0], p, atol=1e-12, err_msg=f"tick {k}")
        assert_allclose(states[k]["odometry_velocity"][0, 0], v[samples[k] - 1])
        assert_allclose(states[k]["odometry_angular_velocity"][0, 0], w[samples[k] - 1])


def first_sample(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sample 0, taken at t = 0 and held through the first tick, from a camera faster than the odometry."""
    faster = 10 * rate
    made = scenario(
        [vehicle(motion=SEGMENTS)], rates={"odometry": rate, "camera": faster, "decision": rate}, noise=NOISE
    )
    state = run(start(made, 5), 1)[1]
    assert state["odometry_samples"][0, 0] == 1
    return state["odometry_velocity"][0, 0], state["odometry_angular_velocity"][0, 0]


def test_noise_free_samples_are_the_true_twist() -> None:
    states = run(start(scenario([vehicle(motion=SEGMENTS)], rates={"odometry": 100.0})), 30)
    for s in states[1:]:
        at = (s["odometry_samples"][0, 0] - 1) / 100.0
        segment = SEGMENTS["segments"][0 if at < 0.123 else 1] if at < 0.323 else {}
        assert_allclose(s["odometry_velocity"][0, 0], segment.get("linear", [0, 0, 0]))
        assert_allclose(s["odometry_angular_velocity"][0, 0], segment.get("angular", [0, 0, 0]))


def test_noise_free_odometry_integrates_to_the_truth() -> None:
    """A constant twist is met exactly at any rate; the increments compose to the pose."""
    for rate in (100.0, 37.0, 1.0):
        made = scenario(
            [vehicle((1, 2, 3), 0.4, motion=constant([0.5, 0.1, 0], [0.1, 0, 0.6]))], rates={"odometry": rate}
        )
        states = run(start(made), 240, "rotation", "position", "increment_rotation", "increment_translation")
        R, p = states[0]["rotation"][0, -1], states[0]["position"][0, -1]
        for s in states[1:]:
            p = p + R @ s["increment_translation"][0, 0]
            R = R @ s["increment_rotation"][0, 0]
        assert_allclose(p, states[-1]["position"][0, -1], atol=1e-12)
        assert_allclose(R, states[-1]["rotation"][0, -1], atol=1e-12)


def test_driven_vehicles_are_sampled_on_the_way() -> None:
    """Samples are the twist at their own instant: at 240 Hz within a tick the speed climbs four times."""
    made = scenario([vehicle(motion={"kind": "driven"})], rates={"odometry": 240.0}, dynamics={"max_speed": 10.0})
    world = start(made)
    command(world, [1.0, 0.0])
    states = run(world, 6)
    speeds = np.array([s["odometry_velocity"][0, 0, 0] for s in states])
    assert_allclose(speeds[1:], 2.0 * np.arange(1, 7) / 60, atol=1e-12)  # limited by 2 m/s^2
    travelled = sum(s["increment_translation"][0, 0, 0] for s in states[1:])
    # each sample is held, so odometry lags by half a sample
    assert_allclose(states[-1]["position"][0, -1, 0] - travelled, 0.5 * speeds[-1] / 240, rtol=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_noise_is_gaussian_white_and_of_the_stated_size(dtype: str) -> None:
    made = scenario([vehicle(motion=constant([0.5, 0, 0]))], rates={"odometry": 60.0}, noise=NOISE)
    states = run(start(made, range(200), dtype), 100, "odometry_velocity", "odometry_angular_velocity")[1:]
    for name, sigma, mean in (("odometry_velocity", 0.3, [0.5, 0, 0]), ("odometry_angular_velocity", 0.2, [0, 0, 0])):
        x = np.array([s[name][:, 0] for s in states]).astype(float) - mean
        assert_allclose(x.std(axis=(0, 1)), sigma, rtol=4 / np.sqrt(2 * 20000))
        assert np.abs(x.mean(axis=(0, 1))).max() < 4 * sigma / np.sqrt(20000)
        assert stats.kstest(x[:, :, 0].ravel() / sigma, "norm").pvalue > 1e-4
        assert abs(np.corrcoef(x[:-1, :, 0].ravel(), x[1:, :, 0].ravel())[0, 1]) < 0.03
    both = [
        np.array([s[n][:, 0] for s in states]).reshape(-1, 3)
        for n in ("odometry_velocity", "odometry_angular_velocity")
    ]
    assert np.abs(np.corrcoef(np.hstack(both).T.astype(float)) - np.eye(6)).max() < 0.03


@pytest.mark.parametrize("stated", [60.0, 240.0, "sample"])
def test_density_is_kept_when_the_rate_changes(stated: float | str) -> None:
    """The heading drifts alike whatever the odometry rate: its variance after T is sigma^2 T / stated rate.

    Noise that is stated per sample is the same at any rate.
    """
    for rate in (30.0, 60.0, 240.0):
        made = scenario(
            [vehicle()],
            rates={"odometry": rate},
            noise={"velocity": 0.1, "angular_velocity": 0.05, "odometry_rate": stated},
        )
        states = run(start(made, range(600)), 121, "increment_rotation", "odometry_velocity")
        states = states[2:]  # two seconds, without the first sample's partial hold
        drift = sum(s["increment_rotation"][:, 0, 1, 0] for s in states)
        held = rate if isinstance(stated, str) else stated
        assert_allclose(drift.std(), 0.05 * np.sqrt(2.0 / held), rtol=0.1)
        last = states[-1]["odometry_velocity"][:, 0]
        assert_allclose(last.std(), 0.1 * np.sqrt(rate / held), rtol=0.1)


def test_samples_are_numbered_not_timed() -> None:
    """Sample m has the same noise at any camera rate: streams depend on the sample's number alone."""
    found = []
    for camera in (20.0, 100.0):
        made = scenario([vehicle()], rates={"camera": camera, "odometry": 100.0}, noise=NOISE)
        world = start(made, 3)
        world.advance(round(camera / 10))
        state = world.get_state()
        assert state["odometry_samples"][0, 0] == 11
        found.append(state["odometry_velocity"][0, 0])
    assert_allclose(found[0], found[1])


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
    states = run(start(made, range(400)), 600, "slip")
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
    turned = R @ FORWARD @ Rotation.from_rotvec(state["camera_turn"][:, 0]).as_matrix()
    eye = position + np.einsum("wij,wj->wi", R, np.array(place) + state["camera_shift"][:, 0])
    for target in range(4):
        line = np.einsum("wji,wj->wi", turned, state["position"][:, target] - eye)
        seen = state["bearing"][:, 0, target]
        assert_allclose(seen, line / np.linalg.norm(line, axis=1, keepdims=True), atol=2e-6)


def test_a_longer_focal_length_spreads_the_image() -> None:
    """Pixels are f (1 + e) x, bearings are computed from them with f: the tangents to the optical axis are wider."""
    state = drawn({}, 20, "float64", focal_length_error=0.1)
    state = {name: values.astype(float) for name, values in state.items() if values.dtype.kind == "f"}
    for target in range(4):
        ray = np.einsum(
            "wji,wj->wi", state["rotation"][:, -1] @ FORWARD, state["position"][:, target] - state["position"][:, -1]
        )
        wide, seen = 1.0 + state["camera_focal"][:, 0], state["bearing"][:, 0, target]
        assert_allclose(seen[:, 0] / seen[:, 2], wide * ray[:, 0] / ray[:, 2], rtol=1e-4)
        assert_allclose(seen[:, 1] / seen[:, 2], wide * ray[:, 1] / ray[:, 2], rtol=1e-4)
        assert (np.sign(seen[:, 2]) == np.sign(ray[:, 2])).all()


def test_a_pinhole_s_view_is_that_of_its_true_focal_length() -> None:
    """Bearings pass through the image of (1 + e) f, and back through f."""
    camera = {"model": "pinhole", "focal_length_error": 0.3, "orientation": "forward"}
    made = scenario([vehicle(motion=TURNING)], camera=camera, topology={"mode": "sensed"})
    state = start(made, range(500)).get_state()
    (fx, fy), (cx, cy), (width, height) = made.camera.focal_length, made.camera.principal_point, made.camera.image_size
    for target in range(4):
        line = state["position"][:, target] - state["position"][:, -1]
        x, y, z = np.einsum("wji,wj->iw", state["rotation"][:, -1] @ FORWARD, line)
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


def test_systematic_errors_are_truth() -> None:
    env = CooperativeLocalisationEnv(scenario([vehicle(motion=TURNING)], noise=ALL, camera=MISPLACED), "test")
    _, infos = env.reset(seed=1)
    truth, state = infos["vehicle_1"]["truth"], env.state()
    assert env.state_space.contains(state)
    lasting = np.concatenate([np.ravel(truth[name]) for name in LASTING_ERRORS])
    assert_allclose(state[-12:], lasting / LASTING_SCALE, atol=1e-5)
    assert np.count_nonzero(lasting) == 10  # no slip yet
