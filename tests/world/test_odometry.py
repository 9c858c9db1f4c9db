"""Odometry: samples at their own rate, held until the next, summed up to one increment per camera tick."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.spatial.transform import Rotation

from tests.helpers.builders import command, constant, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES
from tests.oracles.continuous import left_jacobian
from tests.oracles.philox import philox4x32

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
    states = run(start(made, 5), ticks)
    count = int(np.floor(ticks / 60 * rate + 1e-9)) + 1
    samples = [int(s["odometry_samples"][0, 0]) for s in states]
    assert samples == [0] + [int(np.floor(k / 60 * rate + 1e-9)) + 1 for k in range(1, ticks + 1)]
    paired = scenario(
        [vehicle(motion=SEGMENTS)], rates={"odometry": rate, "camera": rate, "decision": rate}, noise=NOISE
    )
    fast = run(start(paired, 5), count)
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
        states = run(start(made), 240)
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
    states = run(start(made, range(200), dtype), 100)[1:]
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
        states = run(start(made, range(600)), 121)[2:]  # two seconds, without the first sample's partial hold
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
    assert philox4x32((10, 0, 4, 0), (3, 0)) != philox4x32((10, 0, 5, 0), (3, 0))
