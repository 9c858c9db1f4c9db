"""The zoo's filters against numerical derivatives, a batch least squares and textbook forms of the Kalman update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.estimation.compiled import adjoint
from coopenv.observers import Coordinates, Run, SensorNoise, Tick, run
from coopenv.observers.correction import gain, joseph
from coopenv.observers.covariance_intersection import CovarianceIntersection, best_split_weight, best_weight
from coopenv.observers.frame import UsableMeasurements
from coopenv.observers.linearisation import linearise
from coopenv.observers.registry import find
from coopenv.observers.uncertain_pose import LEFT, RIGHT, UncertainPose
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.readings import frame_of_bearings
from tests.helpers.recordings import completed
from tests.oracles.batch import assert_same_covariance, small_record, small_solution

STATES = {Coordinates.LEFT: LEFT, Coordinates.RIGHT: RIGHT}


def spd(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.3 * np.eye(n)


def kalman(P: np.ndarray, H: np.ndarray, N: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The error, the covariance and the normalised innovation squared of an update."""
    K, dx, nis = gain(P, H, N, residual)
    return dx, joseph(P, K, H, N), nis


def pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return Rotation.random(None, np.random.default_rng(seed)).as_matrix(), rng.uniform(-5, 5, 3)


def tick(seed: int, noise: SensorNoise) -> Tick:
    """Return a tick of a tenth of a second, in which a vehicle moves."""
    rng = np.random.default_rng(seed)
    turn, way = Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)
    return replace(small_record(1).tick(1, 0, {}), dt=0.1, rotation=turn, translation=way, noise=noise)


QUIET = SensorNoise(0.0, 0.0, 0.1, 0.0)


def derivative(f, n: int = 6, h: float = 1e-6) -> np.ndarray:
    return np.stack([(f(h * e) - f(-h * e)) / (2 * h) for e in np.eye(n)], axis=-1)


@pytest.mark.parametrize("coordinates", STATES)
def test_moving_by_an_error_makes_that_error(coordinates: Coordinates) -> None:
    state = UncertainPose(STATES[coordinates], *pose(0), np.eye(6))
    e = np.array([0.3, -0.2, 0.5, 1.0, 2.0, -3.0])
    moved = state.moved(e, state.P)
    assert_allclose(coordinates.error(moved.R, moved.p, state.R, state.p), e, atol=1e-12)


@pytest.mark.parametrize("coordinates", STATES)
def test_bearing_jacobian_is_the_derivative_of_the_predicted_bearing(coordinates: Coordinates) -> None:
    """The residual falls by H dx when the estimate moves by dx, to first order at a noise-free bearing."""
    state, c = UncertainPose(STATES[coordinates], *pose(1), np.eye(6)), np.array([0.2, 0.1, -0.3])
    z = np.random.default_rng(2).uniform(-8, 8, (4, 3))
    d = (z - state.p) @ state.R - c
    bearings = d / np.linalg.norm(d, axis=1, keepdims=True)
    right, frame = coordinates is Coordinates.RIGHT, frame_of_bearings(c, bearings, z, 1.0)

    def residual(dx: np.ndarray) -> np.ndarray:
        moved = state.moved(dx, state.P)
        return linearise(moved.R, moved.p, right, frame)[0]

    H = linearise(state.R, state.p, right, frame)[1]
    numeric = -derivative(residual, h=1e-6)
    # the tangent basis turns with the estimate, which a zero residual does not feel
    assert_allclose(H, numeric, atol=1e-7)


@pytest.mark.parametrize("coordinates", STATES)
def test_prediction_carries_the_covariance_by_numerical_derivatives(coordinates: Coordinates) -> None:
    P, t = spd(np.random.default_rng(3), 6), tick(4, QUIET)
    state = UncertainPose(STATES[coordinates], *pose(5), P)
    after = state.predicted(t)

    def error(dx: np.ndarray) -> np.ndarray:
        truth = state.moved(dx, P).predicted(t)
        return coordinates.error(truth.R, truth.p, after.R, after.p)

    F = derivative(error)
    assert_allclose(after.P, F @ P @ F.T, atol=1e-6)
    assert np.abs(after.P - P).max() > 0.1 or coordinates is Coordinates.RIGHT


def test_odometry_noise_is_the_same_in_both_coordinates() -> None:
    """From P = 0, the right covariance is the left one carried over by the numerical derivative between the errors."""
    t = tick(6, SensorNoise(0.3, 0.2, 0.1, 0.0))
    left = UncertainPose(LEFT, *pose(7), np.zeros((6, 6))).predicted(t)
    right = UncertainPose(RIGHT, *pose(7), np.zeros((6, 6))).predicted(t)

    def convert(dx: np.ndarray) -> np.ndarray:
        moved = left.moved(dx, left.P)
        return Coordinates.RIGHT.error(moved.R, moved.p, left.R, left.p)

    T = derivative(convert)
    assert_allclose(np.diag(left.P), np.repeat([(0.2 * 0.1) ** 2, (0.3 * 0.1) ** 2], 3), rtol=1e-12)
    assert_allclose(right.P, T @ left.P @ T.T, atol=1e-9)
    started = UncertainPose.start(RIGHT, left.R, left.p, spd(np.random.default_rng(0), 6))
    assert_allclose(started.P, T @ spd(np.random.default_rng(0), 6) @ T.T, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("coordinates", STATES)
def test_covariance_of_the_marker(coordinates: Coordinates) -> None:
    P, m = spd(np.random.default_rng(8), 6), np.array([0.3, -0.4, 0.8])
    state = UncertainPose(STATES[coordinates], *pose(9), P)
    J = derivative(lambda dx: (lambda s: s.p + s.R @ m)(state.moved(dx, P)))
    assert_allclose(state.point_covariance(m), J @ P @ J.T, atol=1e-7)


def test_joseph_update_is_the_information_form() -> None:
    rng = np.random.default_rng(0)
    P, N, H, r = spd(rng, 6), spd(rng, 4), rng.normal(size=(4, 6)), rng.normal(size=4)
    dx, updated, nis = kalman(P, H, N, r)
    assert_allclose(nis, r @ np.linalg.inv(H @ P @ H.T + N) @ r, rtol=1e-12)
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(N) @ H
    assert_allclose(updated, np.linalg.inv(information), atol=1e-12)
    assert_allclose(dx, np.linalg.solve(information, H.T @ np.linalg.solve(N, r)), atol=1e-12)


LEADERS = [
    "mekf",
    "mekf_covariance",
    "mekf_covariance_ungated",
    "right_invariant",
    "covariance_intersection",
    "distributed_invariant",
    "split_covariance_intersection",
    "pairwise",
    "schmidt_kalman",
    "iterated_ekf",
    "left_invariant",
    "ukf",
]


def left_covariance(result: Run, vehicle: int) -> np.ndarray:
    """Return the last covariance of a vehicle in LEFT coordinates."""
    R, p, P = result.rotation[-1, vehicle], result.position[-1, vehicle], result.covariance[-1, vehicle]
    G = np.linalg.inv(adjoint(R, p)) if result.coordinates is Coordinates.RIGHT else np.eye(6)
    return G @ P @ G.T


def assert_most_probable(name: str, vehicles: Sequence[int], ticks: int = 4) -> None:
    made = small_record(ticks)
    R, p, covariance = small_solution(ticks, tuple(vehicles))
    result = completed(name, made)
    for i in vehicles:
        std = np.sqrt(np.diag(covariance[i]))
        e = Coordinates.LEFT.error(R[i], p[i], result.rotation[-1, i], result.position[-1, i])
        assert np.abs(e / std).max() < 0.01
        start = Coordinates.LEFT.error(R[i], p[i], made.start_rotation[i], made.start_position[i])
        assert np.abs(start / std).max() > 0.1  # the measurements did something
        assert_same_covariance(left_covariance(result, i), covariance[i])


@pytest.mark.parametrize("name", LEADERS)
def test_leader_is_at_the_most_probable_trajectory(name: str) -> None:
    assert_most_probable(name, [0])


@pytest.mark.parametrize("name", ["centralised", "first_estimates_ekf", "observability_constrained_ekf"])
def test_joint_filter_is_at_the_most_probable_trajectory_of_all(name: str) -> None:
    assert_most_probable(name, range(5))


def test_covariance_intersection_covers_every_correlation() -> None:
    """Whatever joint covariance own and neighbour's errors have, the claimed covariance is not below the true one."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        joint = spd(rng, 9)
        scale = np.diag(10.0 ** rng.uniform(-1, 1, 9))
        joint = scale @ joint @ scale
        P, C, X = joint[:6, :6], joint[6:, 6:], joint[:6, 6:]
        H, G, own = rng.normal(size=(2, 6)), rng.normal(size=(2, 3)), spd(rng, 2)
        w = best_weight(H @ P @ H.T, own, G @ C @ G.T)
        if w == 1.0:
            continue
        N = own + G @ C @ G.T / (1 - w)
        K = np.stack([kalman(P / w, H, N, e)[0] for e in np.eye(2)], axis=1)
        claimed = kalman(P / w, H, N, np.zeros(2))[1]
        A, B = np.eye(6) - K @ H, K @ G
        true = A @ P @ A.T + B @ C @ B.T - A @ X @ B.T - B @ X.T @ A.T + K @ own @ K.T
        assert np.linalg.eigvalsh(claimed - true).min() > -1e-9 * np.trace(claimed)


@pytest.mark.parametrize("seed", range(20))
def test_the_weight_is_the_best_of_a_fine_grid(seed: int) -> None:
    """Covariances of a bearing over eight decades, against log det P+ by the determinant lemma."""
    rng = np.random.default_rng(seed)
    prior, own, theirs = (10.0 ** rng.uniform(-8, 0) * spd(rng, 2) for _ in range(3))
    w = np.concatenate([np.linspace(0.02, 0.99, 5000), 1.0 - np.logspace(-2, -6, 5000)])[:, None, None]
    N = own + theirs / (1 - w)
    cost = -6 * np.log(w[:, 0, 0]) + np.log(np.linalg.det(N)) - np.log(np.linalg.det(N + prior / w))
    best = best_weight(prior, own, theirs)
    if cost.min() >= 0.0:
        assert best == 1.0
    else:
        near = np.abs(w[:, 0, 0] - best).argmin()
        assert 0.02 <= best < 1.0
        assert cost[near] < cost.min() + 1e-5


def test_an_exact_neighbour_is_taken_almost_whole_and_a_useless_one_left_out() -> None:
    assert best_weight(0.01 * np.eye(2), 1e-6 * np.eye(2), np.zeros((2, 2))) == 1.0 - 1e-6
    assert best_weight(0.01 * np.eye(2), np.eye(2), 1e6 * np.eye(2)) == 1.0


@pytest.mark.parametrize("name", ["mekf_covariance", "right_invariant"])
def test_a_leader_s_covariance_counts_as_it_should_while_nothing_is_correlated(name: str) -> None:
    """After one tick, a follower knows what the joint solution of leader and follower says of it."""
    made = small_record(1)
    _, _, covariance = small_solution(1, (0, 1))
    assert_same_covariance(left_covariance(run(name, made), 1), covariance[1])
    naive = run("mekf", made).covariance[-1, 1]
    assert np.trace(naive) < 0.999 * np.trace(covariance[1])


def test_covariance_intersection_of_one_bearing_is_the_best_of_all_weights() -> None:
    made = small_record(1)
    P, C = 1e-2 * spd(np.random.default_rng(2), 6), 1e-2 * np.eye(3)
    fused = CovarianceIntersection(made.setups[1])
    fused.reset(pose(3), P)
    z, noise = np.array([[4.0, 3.0, 2.0]]), replace(made.setups[1].noise, bearing=0.01)
    tick = replace(made.tick(1, 1, {}), noise=noise)
    d = (z - fused.state.p) @ fused.state.R - tick.lever_arm
    b = d / np.linalg.norm(d)
    frame = frame_of_bearings(tick.lever_arm, b, z, 1e-4, C)
    _, (H,), _, (by_target,), *_ = linearise(fused.state.R, fused.state.p, False, frame)
    G = by_target[:, 3:]

    def log_determinant(w: float) -> float:
        N = 1e-4 * np.eye(2) + G @ C @ G.T / (1 - w)
        return -np.linalg.slogdet(w * np.linalg.inv(P) + H.T @ np.linalg.inv(N) @ H)[1]

    fused.fuse_neighbour(UsableMeasurements(*frame, np.array([None]), tick))
    best = min(log_determinant(w) for w in np.linspace(0.001, 0.999, 999))
    assert_allclose(np.linalg.slogdet(fused.state.P)[1], best, atol=0.02)
    assert best < np.linalg.slogdet(P)[1] - 0.05


def test_odometry_s_variance_is_that_of_what_is_recorded() -> None:
    """Samples at 100 Hz, ticks at 60 Hz: the density counts."""
    noise = {"noise.odometry_rate": "sample", "noise.velocity": 0.1, "noise.angular_velocity": 0.0}
    made = record(load_scenario("busy_intersection", {"horizon": 20.0, "rates.odometry": 100.0, **noise}), 0)
    error = made.translation[61:1201] - np.diff(made.truth.position[60:1201], axis=0)  # R(t) = I
    sums = error.reshape(38, 30, 5, 3).sum(axis=1)
    assert_allclose(sums.var(), 30 * made.setups[0].noise.odometry(made.dt)[3], rtol=0.2)


@pytest.mark.parametrize(
    "name", ["mekf", "covariance_intersection", "split_covariance_intersection", "pairwise", "ukf"]
)
def test_ticks_of_other_types_are_as_good(name: str) -> None:
    """Valid types of a user's own source of ticks: whole numbers, single precision, lists."""
    made = small_record(3)
    factory = find(name)
    estimates = []
    for other in (False, True):
        observer = factory(replace(made.setups[0], noise=replace(made.setups[0].noise, velocity=1)))
        observer.reset((made.start_rotation[0], made.start_position[0]), made.start_covariance[0])
        t = replace(made.tick(1, 0, {}), rotation=np.eye(3), translation=np.zeros(3), lever_arm=np.zeros(3))
        if other:
            t = replace(
                t,
                rotation=np.eye(3, dtype=np.float32),
                translation=np.zeros(3, int),
                lever_arm=[0, 0, 0],
                bearings=t.bearings.astype(np.float32),
                landmarks=t.landmarks.astype(np.float32),
                dt=np.float32(t.dt),
            )
        estimates.append(observer.update(t))
    assert_allclose(estimates[1].position, estimates[0].position, atol=1e-4)
    assert_allclose(estimates[1].covariance, estimates[0].covariance, rtol=1e-3, atol=1e-9)


# Split covariance intersection


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_split_intersection_is_consistent_for_any_correlation_of_the_dependent_parts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale = np.diag(10.0 ** rng.uniform(-1, 1, 9))
    joint = scale @ spd(rng, 9) @ scale  # of both dependent parts, correlated in any way
    P_d, C, X = joint[:6, :6], joint[6:, 6:], joint[:6, 6:]
    P_i, variance = 10.0 ** rng.uniform(-2, 2) * spd(rng, 6), 10.0 ** rng.uniform(-1, 1)
    own = variance * np.eye(2)
    H, G = rng.normal(size=(2, 6)), rng.normal(size=(2, 3))
    R_d = G @ C @ G.T
    w = best_split_weight(P_d, P_i, H, R_d + own, own)
    if w == 1.0:
        return
    P_1, P_2 = P_d / w + P_i, R_d / (1 - w) + own
    _, claimed, _ = kalman(P_1, H, P_2, np.zeros(2))
    K = P_1 @ H.T @ np.linalg.inv(H @ P_1 @ H.T + P_2)
    A, B = np.eye(6) - K @ H, K @ G
    true = A @ (P_d + P_i) @ A.T + B @ C @ B.T - A @ X @ B.T - B @ X.T @ A.T + K @ own @ K.T
    assert np.linalg.eigvalsh(claimed - true).min() > -1e-9 * np.trace(claimed)
    assert np.linalg.slogdet(claimed)[1] < np.linalg.slogdet(P_d + P_i)[1]


def test_without_dependent_parts_it_is_the_kalman_filter() -> None:
    """The first time that a follower hears its leader, nothing of its own is shared: w goes to its least."""
    rng = np.random.default_rng(0)
    P, H, R_d = spd(rng, 6), rng.normal(size=(2, 6)), spd(rng, 2)
    w = best_split_weight(np.zeros((6, 6)), P, H, R_d + np.eye(2), np.eye(2))
    assert_allclose(R_d / (1 - w), R_d, rtol=0.03)
    made = small_record(1)
    split, plain = run("split_covariance_intersection", made), run("mekf_covariance", made)
    assert_allclose(split.covariance[-1, 1], plain.covariance[-1, 1], rtol=0.03, atol=1e-12)


def test_split_intersection_is_no_less_certain_than_covariance_intersection() -> None:
    """After some frames of the same leader it claims more than plain intersection and less than what counts twice."""
    made = small_record(6)
    split, plain, naive = (
        np.linalg.slogdet(run(name, made).covariance[-1, 1])[1]
        for name in ("split_covariance_intersection", "covariance_intersection", "mekf_covariance")
    )
    assert naive < split < plain + 0.05
