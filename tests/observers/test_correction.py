"""Corrections by bearings, and the gate before them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import logm
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from coopenv.estimation.poses import right_jacobian
from coopenv.observers import Coordinates, Estimate, Recording, SensorNoise, run
from coopenv.observers.correction import LARGEST, InnovationGate, Judgement, iterated, judged
from coopenv.observers.pose_filters import SPREAD, LeftInvariant, Mekf, MekfCovariance, Ukf, sigma_points
from coopenv.observers.uncertain_pose import INVARIANT, LEFT, RIGHT, UncertainPose, recentring
from coopenv.runs.recorder import record
from tests.helpers.recordings import completed
from tests.observers.test_filters import QUIET, derivative, kalman, pose, spd, tick
from tests.oracles.batch import assert_same_covariance, small_errors, small_record


@pytest.mark.parametrize("angle", [1e-5, 0.3, 2.5])
def test_right_jacobian_is_the_derivative_of_the_exponential(angle: float) -> None:
    w = angle * np.array([0.6, -0.48, 0.64])
    numeric = derivative(lambda d: (Rotation.from_rotvec(w).inv() * Rotation.from_rotvec(w + d)).as_rotvec(), 3, 1e-6)
    assert_allclose(right_jacobian(w), numeric, atol=1e-8)


@pytest.mark.parametrize("kind", [LEFT, RIGHT])
def test_recentring_is_the_derivative_of_the_error_that_is_left(kind: int) -> None:
    start = UncertainPose(kind, *pose(4), np.eye(6))
    dx = np.array([0.3, -0.2, 0.4, 1.0, -0.5, 2.0])
    moved = start.moved(dx, start.P)
    coordinates = Coordinates.LEFT if kind == LEFT else Coordinates.RIGHT

    def left(d: np.ndarray) -> np.ndarray:
        truth = start.moved(dx + d, start.P)
        return coordinates.error(truth.R, truth.p, moved.R, moved.p)

    assert_allclose(recentring(kind, dx), derivative(left), atol=1e-7)


def test_recentring_of_the_invariant_error() -> None:
    start = UncertainPose(INVARIANT, *pose(4), np.eye(6))
    dx = np.array([0.1, -0.2, 0.1, 1.0, -0.5, 2.0])
    G, d = recentring(INVARIANT, dx), 1e-6 * np.arange(1.0, 7.0)
    one, other = start.moved(dx + d, start.P), start.moved(dx, start.P)
    again = other.moved(G @ d, start.P)
    assert_allclose(again.p, one.p, atol=1e-9)
    assert_allclose(again.R, one.R, atol=1e-9)
    assert np.abs(G - np.eye(6)).max() > 0.1


def test_the_update_by_a_linear_measurement_is_the_kalman_update() -> None:
    rng = np.random.default_rng(0)
    P, H, N, r = spd(rng, 6), rng.normal(size=(4, 6)), spd(rng, 4), rng.normal(size=4)
    look = lambda at: (r - H @ at, H, N)  # noqa: E731
    for found, expected in zip(iterated(P, look, np.linalg.norm)[:3], kalman(P, H, N, r), strict=True):
        assert_allclose(found, expected, atol=1e-9)


def test_the_iterated_one_ends_at_the_most_probable_state() -> None:
    """A bearing in the plane to a point nearby, which is far from linear."""
    P, N, measured = np.diag([1.0, 1.0]), np.array([[1e-3]]), 1.2

    def angle(x: np.ndarray) -> float:
        return float(np.arctan2(2.0 - x[1], 1.0 - x[0]))

    def look(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d = np.array([1.0, 2.0]) - at
        return np.array([measured - angle(at)]), np.array([[d[1], -d[0]]]) / (d @ d), N

    dx, *_ = iterated(P, look, np.linalg.norm)
    best = minimize(lambda x: x @ np.linalg.solve(P, x) + (measured - angle(x)) ** 2 / N[0, 0], [0.0, 0.0], tol=1e-12)
    assert_allclose(dx, best.x, atol=1e-3)


# Filters on SE(3)


LARGE = np.array([1.1, -0.7, 0.9, 3.0, -2.0, 5.0])


def matrix(state: UncertainPose) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = state.R, state.p
    return T


def invariant_error(truth: UncertainPose, estimate: UncertainPose) -> np.ndarray:
    X = logm(np.linalg.inv(matrix(estimate)) @ matrix(truth)).real
    return np.array([X[2, 1], X[0, 2], X[1, 0], *X[:3, 3]])


def test_moving_by_an_error_of_any_size_makes_that_error() -> None:
    state = UncertainPose(INVARIANT, *pose(0), np.eye(6))
    assert_allclose(invariant_error(state.moved(LARGE, state.P), state), LARGE, atol=1e-9)


def test_prediction_of_a_large_error_is_linear() -> None:
    """Group affinity: the outer product of one error is carried exactly, which first order would miss by metres."""
    state, t = UncertainPose(INVARIANT, *pose(1), np.outer(LARGE, LARGE)), tick(2, QUIET)
    after = state.predicted(t)
    error = invariant_error(state.moved(LARGE, state.P).predicted(t), after)
    assert_allclose(after.P, np.outer(error, error), atol=1e-8)


@pytest.mark.parametrize("name", ["left_invariant", "ukf"])
def test_a_neighbour_counts_as_in_the_filter_of_left_errors(name: str) -> None:
    """With small errors all filters that take the neighbour's covariance as noise are the same."""
    made = small_record()
    expected, result = run("mekf_covariance", made), run(name, made)
    std = np.sqrt(expected.covariance[-1][:, range(6), range(6)])
    assert_allclose((result.position - expected.position)[-1] / std[:, 3:], 0.0, atol=0.01)
    assert_same_covariance(result.covariance[-1], expected.covariance[-1])
    assert_allclose(result.nis[-1], expected.nis[-1], rtol=0.01)
    assert (result.nis_dof[-1] == expected.nis_dof[-1]).all()


def test_sigma_points_have_the_moments() -> None:
    P = spd(np.random.default_rng(3), 6)
    xi = sigma_points(P)
    assert_allclose(xi.sum(0), 0.0, atol=1e-12)
    assert_allclose(xi.T @ xi / (2 * SPREAD), P, atol=1e-12)
    flat = np.diag([1.0, 2.0, 0.0, 0.0, 3.0, 0.0])
    assert_allclose(sigma_points(flat).T @ sigma_points(flat) / (2 * SPREAD), flat, atol=1e-12)


def test_sigma_points_count_the_curvature_that_a_derivative_misses() -> None:
    """After one frame at 60 degrees and 3 m, the filter of derivatives is far surer of the position."""
    made = small_record(1)
    truth = UncertainPose(INVARIANT, made.truth.rotation[1, 0], made.truth.position[1, 0], np.eye(6))
    start = truth.moved(np.array([0.0, 0.0, 1.05, 3.0, 0.0, 0.0]), truth.P)
    noise = SensorNoise(0.0, 0.0, made.dt, 0.02)
    still = replace(made.tick(1, 0, {}), rotation=np.eye(3), translation=np.zeros(3), noise=noise)

    def after_one_frame(own: Mekf) -> Estimate:
        own.reset((start.R, start.p), np.diag([0.5] * 3 + [9.0] * 3))
        return own.update(still)

    unscented, linear = after_one_frame(Ukf(made.setups[0])), after_one_frame(LeftInvariant(made.setups[0]))
    assert np.trace(unscented.covariance[3:, 3:]) > 2.0 * np.trace(linear.covariance[3:, 3:])
    squared = []
    for estimate in (unscented, linear):
        e = Coordinates.LEFT.error(truth.R, truth.p, estimate.rotation, estimate.position)
        squared.append(e @ np.linalg.solve(estimate.covariance, e))
    assert squared[0] < 0.5 * squared[1]


S = 1e-4 * np.eye(2)
ALL = np.ones(3, bool)
GATED = [
    "mekf",
    "mekf_covariance",
    "covariance_intersection",
    "split_covariance_intersection",
    "iterated_ekf",
    "left_invariant",
    "right_invariant",
    "ukf",
    "pairwise",
    "schmidt_kalman",
    "centralised",
]


def residuals(*sizes: float) -> np.ndarray:
    """Return residuals of so many standard deviations."""
    return 1e-2 * np.array([[0.6 * size, -0.8 * size] for size in sizes])


def passed(gate: InnovationGate, time: float, *sizes: float, ahead: np.ndarray = ALL) -> list[bool]:
    judgement = judgement_of(residuals(*sizes), np.tile(S, (len(sizes), 1, 1)), ahead[: len(sizes)])
    return gate.passed(time, judgement).tolist()


def judgement_of(residual: np.ndarray, S: np.ndarray, ahead: np.ndarray) -> Judgement:
    """Return how bearings with residuals (m, 2) are judged."""
    every = np.ones(residual.shape, bool)
    return judged(residual, S, np.full(residual.shape, 1e-4), every, every, ahead)


def test_the_gate_refuses_one_honest_bearing_of_a_thousand() -> None:
    assert abs(chi2.sf(LARGEST, 2) - 1e-3) < 1e-7


def test_the_gate_refuses_far_bearings_and_bearings_behind() -> None:
    assert passed(InnovationGate(), 0.1, 0.0, 3.6, 3.8) == [True, True, False]
    assert passed(InnovationGate(), 0.1, 0.0, 0.0, 0.0, ahead=np.array([True, False, True])) == [True, False, True]


def test_a_covariance_that_is_none_takes_nothing() -> None:
    gate = InnovationGate()
    strange = np.array([S, np.full((2, 2), np.nan), -S])
    for k in range(300):
        kept = gate.passed(k / 60, judgement_of(residuals(0.0, 0.0, 1.0), strange, ALL))
    assert kept.tolist() == [True, False, False]


def test_a_lost_pose_opens_the_gate_and_one_wrong_bearing_of_two_does_not() -> None:
    lied, lost = InnovationGate(), InnovationGate()
    for k in range(1200):
        assert passed(lied, k / 60, 0.0, 50.0) == [True, False]
        last = passed(lost, k / 60, 0.0, 50.0, 50.0)
        assert k > 60 or last == [True, False, False]
    assert last == [True, True, True]
    for k in range(1200, 1600):
        last = passed(lost, k / 60, 0.0, 1.0, 50.0 if k > 1500 else 1.0)
    assert last == [True, True, False]  # found again, it is as strict as before


def test_a_wide_prior_has_nothing_to_refuse_with() -> None:
    gate, wide = InnovationGate(), np.tile(np.eye(2), (3, 1, 1))
    assert gate.passed(0.1, judgement_of(100.0 * residuals(5.0, 5.0, 5.0), wide, np.zeros(3, bool))).all()


def swapped(ticks: int, at: int) -> Recording:
    """Return a record in which the leader mistakes two landmarks for each other at one tick."""
    made = record(small_errors({"horizon": ticks / 60.0, "rates.odometry": 60.0}, 1e-3), 5)
    bearings = made.bearings.copy()
    bearings[at, 0, [0, 1]] = bearings[at, 0, [1, 0]]
    return replace(made, bearings=bearings)


@pytest.mark.parametrize("name", GATED)
def test_a_swap_changes_no_filter_that_has_a_gate(name: str) -> None:
    result = completed(name, swapped(30, 20))
    assert result.position_error[20, 0] < 1.5 * result.position_error[19, 0] + 0.005
    assert result.nis_dof[20, 0] == 2 or name == "centralised"


def test_a_filter_without_a_gate_takes_a_swap() -> None:
    made = swapped(30, 20)
    gated, ungated = run("mekf_covariance", made), run("mekf_covariance_ungated", made)
    assert ungated.position_error[20, 0] > 2.0 * gated.position_error[20, 0]

    class Open(MekfCovariance):
        gated = False

    assert (run(Open, made).position == ungated.position).all()


def test_a_filter_that_is_sure_of_a_wrong_pose_finds_back() -> None:
    made = swapped(180, 1)
    wrong = made.start_position + np.array([0.4, -0.3, 0.2])
    result = run("mekf_covariance", replace(made, start_position=wrong))
    assert result.position_error[30, 0] > 0.3  # it has refused what contradicts it
    assert result.position_error[-1, 0] < 0.5 * result.position_error[30, 0]
