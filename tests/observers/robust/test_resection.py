"""A pose from one frame, against the truth and a Monte Carlo of its covariance."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.estimation.rotations import exp_so3
from tests.oracles.robust.belief import Belief, Member
from tests.oracles.robust.resection import resect
from tests.oracles.robust.sight import View
from tests.oracles.robust.tracklets import left_error

R, P = Rotation.random(None, np.random.default_rng(3)).as_matrix(), np.array([1.0, -2.0, 0.5])
LANDMARKS = np.array([[8.0, 1.0, 2.0], [3.0, 9.0, -1.0], [-4.0, -3.0, 5.0]])
MEMBER = np.array([-6.0, 7.0, 1.0])
STD = 0.003


def frame(points: np.ndarray, rng: np.random.Generator, std: float) -> np.ndarray:
    d = (points - P) @ R
    b = d / np.linalg.norm(d, axis=1, keepdims=True) + std * rng.normal(size=d.shape)
    return b / np.linalg.norm(b, axis=1, keepdims=True)


def solved(rng: np.random.Generator, std: float, member_error: np.ndarray, member_P: np.ndarray, landmarks: int):
    """Resect from 10 degrees and a metre off, with a landmark less replaced by a member."""
    start = Belief(0, R @ exp_so3(np.array([0.1, -0.1, 0.1])), P + np.array([0.6, -0.5, 0.6]), np.eye(6))
    start.add([Member(1, np.eye(3), MEMBER + member_error)], member_P)
    z = LANDMARKS[:landmarks]
    bearings = frame(np.vstack([z, MEMBER]), rng, std)

    def look():
        member = start.members[1]
        sight = start.sight(bearings, np.zeros(3), np.vstack([z, member.p]), [1], [np.zeros(3)])
        every = np.ones(len(bearings), bool)
        return View(sight, np.full(len(bearings), max(std, 1e-6) ** 2), np.zeros(len(bearings)), every, 0.0)

    return start, resect(start, look)


def test_exact_bearings_give_the_exact_pose():
    start, worked = solved(np.random.default_rng(0), 0.0, np.zeros(3), 1e-12 * np.eye(6), 3)
    assert worked
    assert_allclose(start.own.R, R, atol=1e-6)
    assert_allclose(start.own.p, P, atol=1e-6)


def test_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(1)
    member_P = np.diag([1e-8] * 3 + [0.05**2, 0.02**2, 0.04**2])
    errors, nees = [], []
    for _ in range(400):
        member_error = rng.normal(size=3) * np.sqrt(np.diag(member_P)[3:])
        start, worked = solved(rng, STD, member_error, member_P, 2)
        assert worked
        # with the member's own error in it: error = truth against estimate
        e = np.concatenate(
            [
                left_error(start.own.R, start.own.p, R, P),
                left_error(np.eye(3), MEMBER + member_error, np.eye(3), MEMBER),
            ]
        )
        used = np.r_[0:6, 9:12]
        nees.append(e[used] @ np.linalg.solve(start.P[np.ix_(used, used)], e[used]))
        errors.append(e)
    # chi-square of 9, over 400 draws: 9 +- 4 standard errors of sqrt(18 / 400)
    assert abs(np.mean(nees) - 9.0) < 4 * np.sqrt(18 / 400)


def test_two_bearings_are_too_few():
    assert not solved(np.random.default_rng(0), STD, np.zeros(3), 1e-4 * np.eye(6), 1)[1]
