"""The joint belief against finite differences and the information form of the Kalman update."""

import copy

import numpy as np
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.estimation.rotations import exp_so3
from coopenv.observers.contract import SensorNoise
from coopenv.observers.robust.constants import BEND_TIME, MEMBER_BEND_TIME
from tests.oracles.robust.belief import Belief, Member, recentring
from tests.oracles.robust.tracklets import left_error

LEVER_ARM = np.array([0.3, 0.1, 0.5])
NOISE = SensorNoise(velocity=0.1, angular_velocity=0.01, odometry_period=1 / 60, bearing=0.003)


def positive(rng: np.random.Generator, n: int, scale: float = 1.0) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return scale * (A @ A.T + 0.1 * np.eye(n))


def belief(seed: int = 0) -> Belief:
    rng = np.random.default_rng(seed)
    poses = [(Rotation.random(None, rng).as_matrix(), rng.uniform(-9, 9, 3)) for _ in range(3)]
    result = Belief(0, *poses[0], positive(rng, 6, 1e-2))
    result.add([Member(n, *poses[n], odometry=(np.eye(3), np.zeros(3))) for n in (1, 2)], positive(rng, 12, 1e-2))
    result.P = positive(rng, 18, 1e-2)
    return result


def lines(b: Belief, points: list[np.ndarray]) -> np.ndarray:
    """Directions (3, 3) to a landmark and to points of the two members, body frame, written out anew."""
    z = [np.array([4.0, -3.0, 2.0]), *(m.p + m.R @ point for m, point in zip(b.members[1:], points, strict=True))]
    d = np.array([b.own.R.T @ (x - b.own.p) - LEVER_ARM for x in z])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_jacobian_is_the_derivative_of_the_residual():
    b, points = belief(), [np.zeros(3), np.array([0.4, -0.2, 0.1])]
    z = np.array([[4.0, -3.0, 2.0], *(m.p + m.R @ point for m, point in zip(b.members[1:], points, strict=True))])
    sight = b.sight(lines(b, points), LEVER_ARM, z, [1, 2], points)
    assert_allclose(sight.residual, 0.0, atol=1e-12)
    assert sight.ahead.all()
    for e in np.eye(18):
        moved = copy.deepcopy(b)
        moved.shift(1e-6 * e)
        change = b.sight(lines(moved, points), LEVER_ARM, z, [1, 2], points).residual / 1e-6
        assert_allclose(sight.H @ e, change, atol=1e-6)


def test_what_is_not_linear_has_the_variance_that_is_added() -> None:
    """Drawn errors of position turn lines of sight by more than their linearisation says."""
    rng, b = np.random.default_rng(0), belief()
    b.P = block_diag(1e-12 * np.eye(3), 0.2 * np.eye(3), 1e-12 * np.eye(3), positive(rng, 3, 0.03), np.eye(6))
    points = [np.zeros(3)] * 2
    z = np.array([[4.0, -3.0, 2.0], *(m.p for m in b.members[1:])])
    sight = b.sight(lines(b, points), LEVER_ARM, z, [1, 2], points)
    left = []
    for x in rng.multivariate_normal(np.zeros(18), b.P, 4000):
        moved = copy.deepcopy(b)
        moved.shift(x)
        seen = b.sight(lines(moved, points)[:2], LEVER_ARM, z[:2], [1], points[:1])
        left.append(seen.residual - sight.H[:2] @ x)
    variance = np.square(left).sum(axis=-1).mean(axis=0)
    assert_allclose(sight.bend[:2] / [1.0, MEMBER_BEND_TIME / BEND_TIME], variance, rtol=0.5)


def test_targets_behind_are_not_ahead():
    b = belief()
    z = np.array([[4.0, -3.0, 2.0]])
    seen = lines(b, [np.zeros(3)] * 2)[:1]
    assert not b.sight(-seen, LEVER_ARM, z).ahead.any()
    assert b.sight(seen, LEVER_ARM, z).ahead.all()


def test_correction_adds_information():
    rng, b = np.random.default_rng(1), belief()
    H, noise, residual = rng.normal(size=(4, 18)), rng.uniform(0.1, 1.0, 4), rng.normal(size=4)
    expected = np.linalg.inv(np.linalg.inv(b.P) + H.T @ np.diag(1 / noise) @ H)
    dx, before = expected @ H.T @ (residual / noise), copy.deepcopy(b.members)
    b.correct(H, noise, residual)
    G = recentring(dx)
    assert_allclose(b.P, G @ expected @ G.T, rtol=1e-8, atol=1e-12)
    for n, (old, new) in enumerate(zip(before, b.members, strict=True)):
        assert_allclose(new.R, old.R @ exp_so3(dx[6 * n : 6 * n + 3]), atol=1e-10)
        assert_allclose(new.p, old.p + old.R @ dx[6 * n + 3 : 6 * n + 6], atol=1e-10)


def test_recentring_is_the_derivative_of_errors_about_a_moved_pose():
    b, moved = belief(), belief()
    dx = 0.3 * np.random.default_rng(3).normal(size=18)
    moved.shift(dx)
    there = [left_error(m.R, m.p, *pose_of(b, n, dx)) for n, m in enumerate(moved.members)]
    assert_allclose(there, 0.0, atol=1e-9)
    for e in np.eye(18):
        poses = [pose_of(b, n, dx + 1e-6 * e) for n in range(3)]
        change = [left_error(m.R, m.p, *pose) for m, pose in zip(moved.members, poses, strict=True)]
        assert_allclose(recentring(dx) @ e, np.concatenate(change) / 1e-6, atol=1e-5)


def pose_of(b: Belief, n: int, dx: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose of a member with errors dx."""
    m = b.members[n]
    return m.R @ exp_so3(dx[6 * n : 6 * n + 3]), m.p + m.R @ dx[6 * n + 3 : 6 * n + 6]


def test_informing_is_correcting_by_an_equivalent_measurement():
    rng, one = np.random.default_rng(2), belief()
    other = copy.deepcopy(one)
    index = np.arange(6, 12)
    G, y = rng.normal(size=(4, 6)), rng.normal(size=4)  # information of rank 4 only
    H = np.zeros((4, 18))
    H[:, index] = G
    one.inform(index, G.T @ G, G.T @ y)
    other.correct(H, np.ones(4), y)
    assert_allclose(one.P, other.P, atol=1e-12)
    for a, c in zip(one.members, other.members, strict=True):
        assert_allclose(a.R, c.R, atol=1e-12)
        assert_allclose(a.p, c.p, atol=1e-12)


def test_a_member_follows_its_own_odometry():
    b = belief()
    start = copy.deepcopy(b.members[1])
    turn, step = exp_so3(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0])
    b.follow(1, turn, step, 0.5, NOISE)
    assert_allclose(b.members[1].R, start.R @ turn, atol=1e-12)
    assert_allclose(b.members[1].p, start.p + start.R @ step, atol=1e-12)
    assert_allclose(b.members[1].v, step / 0.5)
    # an error before is an error after, moved along the path
    e = 1e-6 * np.array([1.0, 2.0, -1.0, 0.5, 0.2, -0.4])
    moved = belief()
    moved.shift(np.concatenate([np.zeros(6), e]))
    moved.follow(1, turn, step, 0.5, NOISE)
    theta = Rotation.from_matrix(b.members[1].R.T @ moved.members[1].R).as_rotvec()
    rho = b.members[1].R.T @ (moved.members[1].p - b.members[1].p)
    flat = belief()
    flat.P = np.zeros((18, 18))
    flat.P[6:12, 6:12] = np.outer(e, e) * 1e12
    flat.follow(1, turn, step, 0.5, NOISE)
    after = np.concatenate([theta, rho]) * 1e6
    grown = block_diag(np.zeros((6, 6)), np.outer(after, after), np.zeros((6, 6)))
    grown[6:12, 6:12] += np.diag(NOISE.odometry(0.5))
    assert_allclose(flat.P, grown, atol=1e-4)


def test_dropping_keeps_the_others():
    b = belief()
    P = b.P
    b.drop({1})
    keep = [*range(6), *range(12, 18)]
    assert [m.vehicle for m in b.members] == [0, 2]
    assert_allclose(b.P, P[np.ix_(keep, keep)])
