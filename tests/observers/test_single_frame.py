"""Observers of single frames, and filters with the correct unobservable directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coopenv.observers import Message, Received, Recording, Tick
from coopenv.observers.centralised import Centralised, FirstEstimatesEkf, ObservabilityConstrainedEkf
from coopenv.observers.frame import UsableMeasurements
from coopenv.observers.linearisation import LinearMeasurements
from coopenv.observers.pose_filters import PerspectivePoints
from coopenv.observers.uncertain_pose import LEFT, UncertainPose
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.recordings import completed
from tests.observers.test_filters import QUIET, tick
from tests.oracles.batch import small_record
from tests.oracles.continuous import skew

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


def test_a_neighbour_s_covariance_widens_the_receiver_s() -> None:
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
    result = completed("p3p", lost)
    assert result.position_error[1, 0] < 0.1 and result.orientation_error[1, 0] < 1.0


def without_landmarks(ticks: int = 20) -> Recording:
    """Return a recording with wrong starts in which vehicles measure each other alone."""
    made = record(load_scenario("ring:4", {"horizon": ticks / 60.0}), 5)
    visible = made.visible.copy()
    visible[:, :, : made.landmarks.shape[1]] = False
    return replace(made, visible=visible)


def unobservable_dimension(kind: type[Centralised], made: Recording) -> int:
    """Return the dimension of the null space of the observability matrix along the estimates of a filter."""
    rows: list[np.ndarray] = []
    whole = np.eye(6 * len(made.setups))

    class Watched(kind):  # type: ignore[misc, valid-type]
        def predict(self, ticks: list[Tick]) -> None:
            nonlocal whole
            whole = self.transition(ticks) @ whole
            super().predict(ticks)

        def correct(self, ticks: list[Tick], seen: dict[int, np.ndarray]) -> None:
            self.used: list[np.ndarray] = []
            super().correct(ticks, seen)
            rows.extend(H @ whole for H in self.used[-len(seen) :])

        def linearise(self, i: int, measured: UsableMeasurements) -> LinearMeasurements:
            linear = super().linearise(i, measured)
            self.used.append(linear.H.reshape(-1, linear.H.shape[-1]))
            return linear

    completed(Watched, made)
    values = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    return int((values < 1e-7 * values[0]).sum())


def test_bearings_between_vehicles_leave_six_directions_unobservable() -> None:
    made = without_landmarks()
    assert unobservable_dimension(FirstEstimatesEkf, made) == 6
    assert unobservable_dimension(ObservabilityConstrainedEkf, made) == 6
    assert unobservable_dimension(Centralised, made) < 6


def transform(p: np.ndarray) -> np.ndarray:
    return block_diag(*[np.block([[np.eye(3), np.zeros((3, 3))], [skew(x), np.eye(3)]]) for x in p])


def test_first_estimates_are_the_filter_in_transformed_coordinates() -> None:
    """arXiv 2303.01205: in xi = T e the propagation is the identity, and T is taken at the present estimate."""
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 0.5}), 4)
    L, N = made.landmarks.shape[1], len(made.setups)

    class Ungated(FirstEstimatesEkf):
        def reset(self, poses, covariances) -> None:  # type: ignore[no-untyped-def]
            super().reset(poses, covariances)
            for gate in self.gates:
                gate.passed = lambda time, judgement: np.ones(len(judgement[0]), bool)  # type: ignore[method-assign]

    R, p = made.start_rotation.copy(), made.start_position.copy()
    axes = block_diag(*[block_diag(x, x) for x in R])
    P = axes @ block_diag(*made.start_covariance) @ axes.T
    xi = transform(p) @ P @ transform(p).T
    for k in range(1, made.ticks):
        p = p + np.einsum("nij,nj->ni", R, made.translation[k])
        R = R @ made.rotation[k]
        T = transform(p)
        xi = xi + T @ np.diag(np.concatenate([s.noise.odometry(made.dt) for s in made.setups])) @ T.T
        rows, residuals, variance = [], [], []
        for i, setup in enumerate(made.setups):
            for target in setup.targets:
                if not made.visible[k, i, target]:
                    continue
                j = target - L
                arm = np.zeros(3) if j < 0 else R[j] @ made.setups[j].marker
                z = made.landmarks[k, target] if j < 0 else p[j] + arm
                d = z - p[i] - R[i] @ setup.lever_arm
                u = d / np.linalg.norm(d)
                E = np.linalg.svd(u[None])[2][1:] / np.linalg.norm(d)
                H = np.zeros((2, 6 * N))
                H[:, 6 * i : 6 * i + 6] = np.hstack([E @ skew(z - p[i]), -E])
                if j >= 0:
                    H[:, 6 * j : 6 * j + 6] += np.hstack([-E @ skew(arm), E])
                rows.append(H)
                residuals.append(E @ (R[i] @ made.bearings[k, i, target]) * np.linalg.norm(d))
                variance += [setup.noise.bearing_std**2] * 2
        if rows:
            H, r = np.concatenate(rows) @ np.linalg.inv(T), np.concatenate(residuals)
            K = xi @ H.T @ np.linalg.inv(H @ xi @ H.T + np.diag(variance))
            e = (np.linalg.inv(T) @ (K @ r)).reshape(N, 6)
            xi = (np.eye(6 * N) - K @ H) @ xi
            R = Rotation.from_rotvec(e[:, :3]).as_matrix() @ R
            p = p + e[:, 3:]
    result = completed(Ungated, made)
    assert_allclose(result.position[-1], p, atol=1e-6)
    assert_allclose(result.rotation[-1], R, atol=1e-6)


@pytest.mark.parametrize("name", ["first_estimates_ekf", "observability_constrained_ekf"])
def test_with_landmarks_it_tracks(name: str) -> None:
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 5.0}), 0)
    result = completed(name, made)
    assert (result.position_rmse(3.0)[:3] < 0.3).all()
