"""Declared errors of frames and of the map against a dense filter with numerical derivatives, which has them as states.

Frames that are older than stated, by a known age, by a constant or by one drawn anew; landmarks that are not where the
map has them; a camera that turns slowly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, expm, null_space
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from coopenv.observers.contract import SensorNoise
from coopenv.observers.robust.memory import ERRORS, MOUNTING
from tests.helpers.robust_ticks import (
    CALIBRATION,
    LANDMARKS,
    LEVER_ARM,
    NOISE,
    WALK,
    OpenRobust,
    Pose,
    covariance,
    direction,
    displaced,
    known,
    left_error,
    pose_of,
    tick,
)
from tests.oracles.continuous import skew

AT: Pose = displaced((np.eye(3), np.zeros(3)), np.array([0.3, -0.2, 1.1, 0.5, -0.4, 0.2]))
DT = 0.1
V, W = np.array([4.0, 0.3, -0.2]), np.array([0.1, -0.2, 0.5])
SEEN = (0, 1, 2)
"""Landmarks in view."""
LAST = slice(12, None)
"""Errors of the landmarks on the map."""


def gone(time: float) -> Pose:
    """Return the motion at the constant twist over a time, s."""
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = skew(W), V
    moved = expm(time * twist)
    return moved[:3, :3], moved[:3, 3]


def composed(pose: Pose, step: Pose) -> Pose:
    """Return a pose after a motion."""
    return pose[0] @ step[0], pose[1] + pose[0] @ step[1]


def begun(P: np.ndarray, noise: SensorNoise, map_std: float = 0.0) -> OpenRobust:
    """Return an observer with declared noise that has started at `AT`."""
    observer = OpenRobust(replace(known(0, noise), landmark_std=(map_std,) * len(LANDMARKS)))
    observer.reset(AT, P)
    return observer


def seen(e: np.ndarray, pose: Pose, n: int, age: float = 0.0) -> np.ndarray:
    """Return the direction to a landmark at errors of a pose, of its calibration and of the map, in an older frame."""
    there = composed(displaced(pose, e[:6]), gone(-(age + e[11])))
    return direction(there, LANDMARKS[n] + e[12 + 3 * n : 15 + 3 * n])


class Dense:
    """A filter of the own pose, of bias, scale and latency, and of the places of all landmarks, which it considers."""

    def __init__(self, P: np.ndarray, noise: SensorNoise, map_std: float) -> None:
        self.noise = noise
        errors = CALIBRATION.copy()
        errors[5, 5] = max(noise.latency**2, 1e-14)
        self.P = block_diag(P, errors, map_std**2 * np.eye(3 * len(LANDMARKS)))

    def predict(self) -> None:
        step = gone(DT)

        def after(e: np.ndarray) -> np.ndarray:
            turned = Rotation.from_rotvec(-e[6:9] * DT).as_matrix()
            own = step[0] @ turned, step[1] - 0.5 * np.cross(e[6:9] * DT, step[1])
            return left_error(composed(AT, step), composed(displaced(AT, e[:6]), own))

        F = np.eye(len(self.P))
        F[:6] = approx_fprime(np.zeros(len(self.P)), after, 1e-6)
        F[:6, 9] = 0.0  # the scale is known
        Q = np.zeros(len(F))
        Q[:6], Q[6:9] = self.noise.odometry(DT), WALK**2 * DT
        self.P = F @ self.P @ F.T + np.diag(Q)

    def correct(self, pose: Pose) -> None:
        zero = np.zeros(len(self.P))
        axes = [null_space(direction(pose, LANDMARKS[n])[None]).T for n in SEEN]
        H = np.vstack([T @ approx_fprime(zero, seen, 1e-6, pose, n) for T, n in zip(axes, SEEN, strict=True)])
        N = self.noise.bearing**2 * np.eye(len(H))
        if self.noise.latency_jitter:
            N += np.diag(len(SEEN) * self.noise.latency_jitter**2 * np.repeat((H[:, 11] ** 2).reshape(-1, 2).sum(1), 2))
        S = H @ self.P @ H.T + N
        K = self.P @ H.T @ np.linalg.inv(S)
        K[LAST] = 0.0
        A = np.eye(len(self.P)) - K @ H
        self.P = A @ self.P @ A.T + K @ N @ K.T


def run_both(noise: SensorNoise, map_std: float, frames: int = 12) -> tuple[OpenRobust, Dense, Pose]:
    """Return both filters after exact measurements of a constant motion, and where the vehicle is."""
    P = covariance(np.random.default_rng(0), 0.001, 0.004)
    observer, dense, pose = begun(P, noise, map_std), Dense(P, noise, map_std), AT
    for k in range(1, frames + 1):
        pose = composed(pose, gone(DT))
        bearings = {n: direction(pose, LANDMARKS[n]) for n in SEEN}
        moving = replace(tick(observer, k, gone(DT), bearings, dt=DT), velocity=V, angular_velocity=W)
        observer.update(moving)
        dense.predict()
        dense.correct(pose)
    return observer, dense, pose


@pytest.mark.parametrize(
    ("declared", "map_std"),
    [({}, 0.02), ({"latency": 0.003}, 0.0), ({"latency": 0.003}, 0.02), ({"latency_jitter": 0.002}, 0.0)],
)
def test_declared_errors_are_those_of_a_dense_filter(declared: dict[str, float], map_std: float) -> None:
    observer, dense, pose = run_both(replace(NOISE, **declared), map_std)
    assert np.abs(left_error(pose, pose_of(observer))).max() < 1e-3
    expected = dense.P[:6, :6]
    scale = np.sqrt(expected.diagonal())
    assert_allclose(observer.P[:6, :6] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.05)
    assert_allclose(np.sqrt(observer.P[11, 11]), np.sqrt(dense.P[11, 11]), rtol=0.05)
    plain = run_both(NOISE, 0.0)[0].P[3:6, 3:6]
    assert np.abs(plain - expected[3:, 3:]).max() > 0.3 * np.abs(plain).max()


def test_the_derivative_by_the_latency_is_that_of_the_older_bearing() -> None:
    """A bearing of an older frame differs from the predicted one by the age times the derivative."""
    noise = replace(NOISE, latency=1e-5)
    pose, age = composed(AT, gone(DT)), 1e-3
    found = []
    for older in (0.0, age):
        observer = begun(1e-14 * np.eye(6), noise)
        bearings = {n: seen(np.zeros(27), pose, n, older) for n in SEEN}
        observer.update(replace(tick(observer, 1, gone(DT), bearings, dt=DT), velocity=V, angular_velocity=W))
        found.append(observer.memory.measurement["residual"][: len(SEEN)].copy())
    by_latency = observer.memory.derivative["jacobian"][: len(SEEN), 3, :, 5]
    assert np.abs(by_latency).max() > 0.3  # rad/s
    assert_allclose((found[1] - found[0]) / age, by_latency, atol=0.01)


def test_a_known_age_is_taken_into_account() -> None:
    """An old frame with its age corrects as one of now does."""
    P = covariance(np.random.default_rng(1), 0.01, 0.05)
    pose, age, found = composed(displaced(AT, np.array([4e-3, -6e-3, 5e-3, 0.03, -0.02, 0.04])), gone(DT)), 0.04, []
    for older in (0.0, age):
        observer = begun(P, NOISE)
        bearings = {n: seen(np.zeros(27), pose, n, older) for n in range(5)}
        late = replace(tick(observer, 1, gone(DT), bearings, dt=DT), velocity=V, angular_velocity=W)
        observer.update(replace(late, bearing_age=older))
        found.append(pose_of(observer))
    assert np.abs(left_error(pose, found[0]))[3:].max() < 0.02
    assert np.abs(left_error(*found)).max() < 2e-3


def test_a_constant_latency_is_estimated_where_the_speed_changes() -> None:
    """Beside landmarks that are known, only a change of the velocity tells the latency from the position."""
    late, noise = 0.02, replace(NOISE, latency=0.03)
    observer, pose, stds = begun(np.diag([0.05**2] * 3 + [0.3**2] * 3), noise), AT, []
    for k in range(1, 91):
        pace = 1.0 if k <= 45 else 0.2
        step = gone(pace * DT / 10.0)
        pose = composed(pose, step)
        bearings = {n: direction(composed(pose, gone(-pace * late)), LANDMARKS[n]) for n in range(5)}
        moving = tick(observer, k, step, bearings, dt=DT / 10.0)
        observer.update(replace(moving, velocity=pace * V, angular_velocity=pace * W))
        stds.append(np.sqrt(observer.P[11, 11]))
    assert stds[40] > 0.5 * stds[0]
    assert stds[-1] < 0.5 * stds[40]
    assert abs(observer.members["v"][ERRORS, 2] - late) < 3.0 * stds[-1]


def test_a_declared_walk_of_the_mounting_is_added_in_time() -> None:
    noise = replace(NOISE, camera_orientation_walk=0.002)
    observer = begun(covariance(np.random.default_rng(3), 0.001, 0.01), noise)
    for k in range(1, 21):
        observer.update(tick(observer, k, dt=DT))
    mounting = observer.P[6 * MOUNTING : 6 * MOUNTING + 6, 6 * MOUNTING : 6 * MOUNTING + 6].diagonal()
    assert_allclose(mounting[:3], 0.002**2 * 20 * DT, rtol=1e-6)
    assert (mounting[3:] < 1e-12).all()


def test_the_map_s_error_stays_in_a_pose_that_many_frames_correct() -> None:
    """Of one landmark for a thousand frames nothing is learned beyond its accuracy."""
    observer = begun(np.diag([1e-12] * 3 + [1.0] * 3), replace(NOISE, velocity=1e-3, angular_velocity=1e-4), 0.1)
    for k in range(1, 301):
        observer.update(tick(observer, k, bearings={0: direction(AT, LANDMARKS[0])}))
    line = LANDMARKS[0] - AT[1] - AT[0] @ LEVER_ARM
    across = AT[0].T @ null_space(line[None])
    assert np.linalg.eigvalsh(across.T @ observer.P[3:6, 3:6] @ across)[0] > 0.9 * 0.1**2
