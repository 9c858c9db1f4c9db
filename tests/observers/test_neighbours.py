"""Filters that keep cross-covariances, against a joint filter of the errors with numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.observers import Message, Received, Recording, run
from coopenv.observers.pairwise import Pairwise
from coopenv.observers.schmidt_kalman import SchmidtKalman
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.observers.test_filters import derivative
from tests.oracles.batch import small_record

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
    result = run(name, made)
    assert not result.failure
    std = np.sqrt(np.diag(expected))
    for i in range(2):
        own = slice(6 * i, 6 * i + 6)
        scale = np.outer(std[own], std[own])
        assert_allclose(result.covariance[-1, i] / scale, expected[own, own] / scale, atol=2e-3)
    naive = run("mekf_covariance", made).covariance[-1, 1]
    assert np.trace(naive) < 0.999 * np.trace(result.covariance[-1, 1])  # it counts what it has counted before


@pytest.mark.parametrize("name", FILTERS)
def test_messages_of_any_content_leave_a_pose(name: str) -> None:
    """What a liar tells of itself fits no cross-covariance; what is malformed is not used."""
    made = small_record(8)
    own = FILTERS[name](made.setups[1])
    own.reset((made.start_rotation[1], made.start_position[1]), made.start_covariance[1])
    leader = FILTERS[name](made.setups[0])
    leader.reset((made.start_rotation[0], made.start_position[0]), made.start_covariance[0])
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
    class Misshapen:
        def applies(self, vehicle: int, time: float) -> bool:
            return vehicle == 1

        def told(self, observer: object, message: Message) -> Message:
            return replace(message, extra={**message.extra, part: MISSHAPEN[part]})

    made = record(load_scenario("busy_intersection_tracking", {"horizon": 0.5}), 0)
    found = run(name, made, Misshapen())
    assert not found.failure
    assert np.isfinite(found.position).all()


def test_lost_messages_are_bridged() -> None:
    made = small_record(12)
    lost = made.inbox_tick.copy()
    lost[4:9] = lost[3]
    whole, gaps = run("pairwise", made), run("pairwise", replace(made, inbox_tick=lost))
    assert not gaps.failure
    assert_allclose(np.diag(gaps.covariance[-1, 1]), np.diag(whole.covariance[-1, 1]), rtol=0.2)
