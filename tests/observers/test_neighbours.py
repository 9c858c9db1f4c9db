"""Filters that keep cross-covariances, against a joint filter of the errors with numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import right_jacobian
from coopenv.observers import Message, Received, Recording, run
from coopenv.observers.correction import NO_CONSTANTS
from coopenv.observers.frame import Frame
from coopenv.observers.linearisation import linearise
from coopenv.observers.schmidt_kalman import Pairwise, SchmidtKalman
from coopenv.observers.schmidt_kalman import considered as update
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.readings import frame_of_bearings
from tests.helpers.recordings import Tampering, completed
from tests.observers.test_filters import derivative, pose, spd
from tests.oracles.batch import assert_same_covariance, small_record

FILTERS = {"pairwise": Pairwise, "schmidt_kalman": SchmidtKalman}


def bearing(made: Recording, k: int, i: int, target: int, e: np.ndarray) -> np.ndarray:
    """Return the bearing from i to a target where the true poses of both vehicles are moved by errors (12,)."""
    R, p = made.truth.rotation[k], made.truth.position[k]
    R = [R[j] @ Rotation.from_rotvec(e[6 * j : 6 * j + 3]).as_matrix() for j in range(2)]
    p = [p[j] + made.truth.rotation[k, j] @ e[6 * j + 3 : 6 * j + 6] for j in range(2)]
    j = target - made.landmarks.shape[1]
    z = made.landmarks[k, target] if j < 0 else p[j] + R[j] @ made.setups[j].marker
    d = R[i].T @ (z - p[i]) - made.setups[i].lever_arm
    return d / np.linalg.norm(d)


def considered(made: Recording, batch: bool) -> np.ndarray:
    """Return the covariance (12, 12) of leader and follower; the leader is never corrected by the follower."""
    P = block_diag(*made.start_covariance[:2])
    for k in range(1, made.ticks):
        F = []
        for i in range(2):
            dR, dp = made.rotation[k, i], made.translation[k, i]

            def after(e: np.ndarray, dR: np.ndarray = dR, dp: np.ndarray = dp) -> np.ndarray:
                turn = Rotation.from_rotvec(e[:3]).as_matrix()
                rho = dR.T @ (e[3:] + turn @ dp - dp)
                return np.concatenate([Rotation.from_matrix(dR.T @ turn @ dR).as_rotvec(), rho])

            F.append(derivative(after))
        F = block_diag(*F)
        P = F @ P @ F.T + np.diag(np.tile(made.setups[0].noise.odometry(made.dt), 2))
        for i in range(2):
            targets = made.setups[i].targets.tolist()
            leaders = [t for t in targets if t >= 3]
            for group in [targets] if batch else [[t for t in targets if t < 3], *[[t] for t in leaders]]:
                H = np.concatenate(
                    [derivative(lambda e, t=t, i=i: bearing(made, k, i, t, e), 12) for t in group]  # noqa: B023
                )
                noise = made.setups[i].noise.bearing_std ** 2 * np.eye(len(H))
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + noise)
                K[6 * (1 - i) : 6 * (1 - i) + 6] = 0.0
                A = np.eye(12) - K @ H
                P = A @ P @ A.T + K @ noise @ K.T
    return P


@pytest.mark.parametrize("name", FILTERS)
def test_a_follower_is_a_joint_filter_that_never_corrects_its_leader(name: str) -> None:
    made = small_record(6)
    expected = considered(made, name == "schmidt_kalman")
    result = completed(name, made)
    assert_same_covariance(result.covariance[-1, 0], expected[:6, :6])
    assert_same_covariance(result.covariance[-1, 1], expected[6:, 6:])
    naive = run("mekf_covariance", made).covariance[-1, 1]
    assert np.trace(naive) < 0.999 * np.trace(result.covariance[-1, 1])  # it counts what it has counted before


@pytest.mark.parametrize("name", FILTERS)
def test_messages_of_any_content_leave_a_pose(name: str) -> None:
    """A lying sender's pose fits no cross-covariance; malformed messages are not used."""
    made = small_record(8)
    leader, own = pair(name, made)
    for k in range(1, 8):
        leader.update(made.tick(k, 0, {}))
        message = leader.message()
        if k == 5:
            message = replace(message, covariance=1e-14 * np.eye(6))
        elif k == 6:
            message = Message(message.position)
        elif k == 7:
            message = replace(message, extra={"factor": 1e9 * np.eye(6), "number": np.array([1e6])})
        found = own.update(made.tick(k, 1, {3: Received(message, 0.0)}))
        assert np.isfinite(found.position).all()
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    assert np.linalg.norm(found.position - made.truth.position[7, 1]) < 0.05


MISSHAPEN = {
    "factor": np.eye(3),
    "number": np.array(1.0),
    "targets": np.array([[3.0]]),
    "cross": np.zeros((1, 6)),
}


@pytest.mark.parametrize("part", MISSHAPEN)
@pytest.mark.parametrize("name", FILTERS)
def test_extras_of_another_shape_end_no_run(name: str, part: str) -> None:
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 0.5}), 0)
    misshapen = Tampering(lambda message: replace(message, extra={**message.extra, part: MISSHAPEN[part]}))
    found = completed(name, made, misshapen)
    assert np.isfinite(found.position).all()


def test_lost_messages_are_bridged() -> None:
    made = small_record(12)
    lost = made.inbox_tick.copy()
    lost[4:9] = lost[3]
    whole, gaps = completed("pairwise", made), completed("pairwise", replace(made, inbox_tick=lost))
    assert_allclose(np.diag(gaps.covariance[-1, 1]), np.diag(whole.covariance[-1, 1]), rtol=0.2)


def own_update(
    R: np.ndarray, p: np.ndarray, joint: np.ndarray, frame: Frame, variance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return orientation, position, joint covariance and NIS of two bearings, the second one to a neighbour."""

    def look(theta: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        there = R @ Rotation.from_rotvec(theta).as_matrix(), p + R @ rho
        residual, own, _, by_target, *_ = linearise(*there, False, frame)
        H = np.zeros((4, 12))
        H[:, :6], H[2:, 9:] = own.reshape(4, 6), by_target[1, :, 3:]
        H[:, :6] = H[:, :6] @ block_diag(right_jacobian(theta), Rotation.from_rotvec(-theta).as_matrix())
        return residual.ravel(), H

    def solved(r: np.ndarray, H: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        S = H @ joint @ H.T + variance * np.eye(4)
        K = joint @ H.T @ np.linalg.inv(S)
        K[6:] = 0.0
        return K, K @ (r + H @ at)

    r, H = look(np.zeros(3), np.zeros(3))
    nis = r @ np.linalg.solve(H @ joint @ H.T + variance * np.eye(4), r)
    at = 0.5 * solved(r, H, np.zeros(12))[1]
    r, H = look(at[:3], at[3:6])
    K, dx = solved(r, H, at)
    A = np.eye(12) - K @ H
    after = A @ joint @ A.T + variance * K @ K.T
    turned = Rotation.from_rotvec(dx[:3]).as_matrix()
    moved = block_diag(right_jacobian(dx[:3]), turned.T, np.eye(6))
    return R @ turned, p + R @ dx[3:6], moved @ after @ moved.T, nis


@pytest.mark.parametrize("miss", [0.0, 0.03])
def test_neighbours_that_are_considered_are_not_corrected(miss: float) -> None:
    """Schmidt's update: a neighbour's gain is zero, and what is left of all is the covariance of that."""
    rng = np.random.default_rng(1)
    (R, p), joint = pose(2), 1e-2 * spd(rng, 12)
    z, turn, variance = rng.uniform(-8, 8, (2, 3)), pose(3)[0], 1e-3
    d = (z - p) @ R
    bearings = d / np.linalg.norm(d, axis=1, keepdims=True) + miss * rng.normal(size=(2, 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    frame = frame_of_bearings(np.zeros(3), bearings, z, variance)
    frame[0]["rotation"][1] = turn
    found = update(R, p, joint, frame, NO_CONSTANTS, np.array([-1, 0]))
    R_after, p_after, after, nis = own_update(R, p, joint, frame, variance)
    assert_allclose(found[0], R_after, atol=1e-12)
    assert_allclose(found[1], p_after, atol=1e-12)
    assert_allclose(found[2], after[:6, :6], atol=1e-12)
    assert_allclose(found[5][0], after[:6, 6:], atol=1e-12)
    assert_allclose(found[6], nis, rtol=1e-9, atol=1e-12)
    if miss > 0.0:
        assert np.linalg.norm(p_after - p) > 0.01
    else:
        assert_allclose(found[4] @ joint[:, :6], after[:6, :6], atol=1e-12)


def pair(name: str, made: Recording) -> list[Pairwise | SchmidtKalman]:
    """Return the observers of a leader and its follower, who have started."""
    observers = [FILTERS[name](setup) for setup in made.setups[:2]]
    for i, observer in enumerate(observers):
        observer.reset((made.start_rotation[i], made.start_position[i]), made.start_covariance[i])
    return observers


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("dtype", [np.longdouble, np.float16, np.int8, bool, complex])
def test_a_factor_of_any_type_ends_no_run(name: str, dtype: type) -> None:
    made = small_record(3)
    leader, own = pair(name, made)
    sent = leader.message()
    sent = replace(sent, extra={**sent.extra, "factor": np.eye(6).astype(dtype)})
    short = replace(sent, covariance=np.eye(3))  # of another observer
    for k, message in ((1, sent), (2, short)):
        target = made.landmarks.shape[1]
        assert np.isfinite(own.update(made.tick(k, 1, {target: Received(message, 0.0)})).covariance).all()
