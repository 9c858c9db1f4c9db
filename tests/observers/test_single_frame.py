"""Per-frame poses: from any start, with outliers, with too little to see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coopenv.observers import Message, Received, Tick, run
from coopenv.observers.bearing_measurements import LEFT, UncertainPose
from coopenv.observers.single_frame import PerspectivePoints
from tests.observers.test_filters import QUIET, tick
from tests.oracles.batch import small_record

SIGMA = 2e-3
POINTS = np.array([[8.0, 0.0, 1.0], [0.0, 9.0, -2.0], [-7.0, -3.0, 4.0], [2.0, -8.0, -1.0], [5.0, 6.0, 5.0]])
R_TRUE, P_TRUE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.5, -0.4, 0.3])
LEVER = np.array([0.4, 0.1, 0.2])


def frame(count: int, seed: int = 0, sigma: float = SIGMA) -> Tick:
    """Return a tick at rest that sees the first points with noise."""
    d = (POINTS[:count] - P_TRUE) @ R_TRUE - LEVER
    b = d / np.linalg.norm(d, axis=1, keepdims=True)
    b += sigma * np.random.default_rng(seed).normal(size=b.shape)
    return replace(
        tick(0, replace(QUIET, bearing=SIGMA)),
        rotation=np.eye(3),
        translation=np.zeros(3),
        targets=np.arange(count),
        bearings=b / np.linalg.norm(b, axis=1, keepdims=True),
        valid=np.ones(count, bool),
        landmarks=POINTS[:count],
        lever_arm=LEVER,
    )


def started(R: np.ndarray, p: np.ndarray, variance: float = 10.0) -> PerspectivePoints:
    own = PerspectivePoints(small_record(1).setups[0])
    own.reset((R, p), variance * np.eye(6))
    return own


@pytest.mark.parametrize("count", [4, 5])
@pytest.mark.parametrize("seed", range(5))
def test_any_start_gives_the_least_squares_pose(count: int, seed: int) -> None:
    seen = frame(count, seed)

    def residuals(x: np.ndarray) -> np.ndarray:
        R = R_TRUE @ Rotation.from_rotvec(x[:3]).as_matrix()
        d = (seen.landmarks - P_TRUE - x[3:]) @ R - LEVER
        return ((d / np.linalg.norm(d, axis=1, keepdims=True) - seen.bearings) / SIGMA).ravel()

    best = least_squares(residuals, np.zeros(6))
    rng = np.random.default_rng(100 + seed)
    estimate = started(Rotation.random(None, rng).as_matrix(), rng.uniform(-10, 10, 3)).update(seen)
    expected = np.linalg.inv(best.jac.T @ best.jac)
    std = np.sqrt(np.diag(expected))
    assert_allclose((estimate.position - P_TRUE - best.x[3:]) / std[3:], 0.0, atol=0.05)
    in_body = R_TRUE @ Rotation.from_rotvec(best.x[:3]).as_matrix()
    assert_allclose(in_body @ estimate.covariance[3:, 3:] @ in_body.T, expected[3:, 3:], rtol=0.02, atol=1e-8)


def test_of_three_bearings_the_solution_nearest_to_the_prediction_is_taken() -> None:
    seen = frame(3, sigma=0.0)
    start = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix() @ R_TRUE
    estimate = started(start, P_TRUE + 0.5).update(seen)
    assert_allclose(estimate.position, P_TRUE, atol=1e-6)
    assert_allclose(estimate.rotation, R_TRUE, atol=1e-6)


def test_one_wrong_bearing_of_five_is_left_out() -> None:
    seen = frame(5)
    bearings = seen.bearings.copy()
    bearings[1] = bearings[3]
    estimate = started(R_TRUE, P_TRUE, 1e-2).update(replace(seen, bearings=bearings))
    assert np.linalg.norm(estimate.position - P_TRUE) < 0.1
    assert not np.allclose(estimate.position, P_TRUE, atol=1e-9)  # the others moved it


def test_two_bearings_leave_odometry_alone() -> None:
    estimate = started(R_TRUE, P_TRUE + 1.0).update(frame(2))
    expected = UncertainPose(LEFT, R_TRUE, P_TRUE + 1.0, 10.0 * np.eye(6)).predicted(frame(2))
    assert_allclose(estimate.position, expected.p)
    assert_allclose(estimate.covariance, expected.P)


def test_a_pose_far_from_a_sure_prediction_needs_a_second() -> None:
    own = started(R_TRUE, P_TRUE + 3.0, 1e-6)
    positions = [own.update(replace(frame(5, k), dt=0.1)).position for k in range(15)]
    far = np.linalg.norm(np.array(positions) - P_TRUE, axis=1)
    assert (far[:9] > 5.0).all() and (far[11:] < 0.1).all()


def test_points_in_a_bundle_are_too_weak() -> None:
    """Seen within a degree, three points hold no position; the start stays."""
    seen = frame(3)
    landmarks = P_TRUE + 20.0 * np.eye(3)[0] + 0.2 * np.eye(3)
    d = (landmarks - P_TRUE) @ R_TRUE - LEVER
    bundle = replace(seen, landmarks=landmarks, bearings=d / np.linalg.norm(d, axis=1, keepdims=True))
    estimate = started(R_TRUE, P_TRUE + 0.5, 0.1).update(bundle)
    assert_allclose(estimate.position, P_TRUE + 0.5)


def test_a_neighbour_s_covariance_widens_one_s_own() -> None:
    seen = frame(3)
    marks = POINTS.copy()
    sure, unsure = (
        replace(
            seen,
            targets=np.array([0, 1, 7]),
            landmarks=marks[:2],
            messages={7: Received(Message(position=marks[2], covariance=C), 0.0)},
        )
        for C in (None, 0.04 * np.eye(3))
    )
    narrow, wide = (started(R_TRUE, P_TRUE, 0.1).update(t).covariance for t in (sure, unsure))
    assert np.trace(wide) > 2.0 * np.trace(narrow)


def test_a_vehicle_that_sees_three_landmarks_is_found_in_one_frame_from_anywhere() -> None:
    made = small_record(3)
    turned = Rotation.from_rotvec([0.0, 0.0, 1.5]).as_matrix()
    lost = replace(
        made,
        start_rotation=made.start_rotation @ turned,
        start_position=made.start_position + 8.0,
        start_covariance=np.tile(np.diag([1.0] * 3 + [60.0] * 3), (5, 1, 1)),
    )
    result = run("p3p", lost)
    assert not result.failure
    assert result.position_error[1, 0] < 0.1 and result.orientation_error[1, 0] < 1.0
