"""Filters with the correct unobservable directions: rank of the observability matrix, and the transformed filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.observers import Recording, Tick, run
from coopenv.observers.centralised import Centralised
from coopenv.observers.consistent_ekf import FirstEstimatesEkf, ObservabilityConstrainedEkf
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.oracles.continuous import skew


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
            P, self.P = self.P, np.zeros_like(self.P)
            poses, first = self.poses, getattr(self, "first", None)
            columns = []
            for axis in range(len(P)):  # F column by column, from F D F^T - Q of rank-one D, with the noise left out
                self.poses, self.first = poses, first
                self.P = np.zeros_like(P)
                self.P[axis, axis] = 1.0
                super().predict([replace(t, noise=replace(t.noise, velocity=0.0, angular_velocity=0.0)) for t in ticks])
                columns.append(self.P[:, axis] / np.sqrt(self.P[axis, axis]))
            whole = np.stack(columns, axis=1) @ whole
            self.poses, self.first, self.P = poses, first, P
            super().predict(ticks)

        def correct(self, ticks: list[Tick], seen: dict[int, np.ndarray]) -> None:
            self.used: list[np.ndarray] = []
            super().correct(ticks, seen)
            rows.extend(H @ whole for H in self.used[-len(seen) :])

        def linearise(self, i: int, tick: Tick, mask: np.ndarray):  # type: ignore[no-untyped-def]
            linear, in_front = super().linearise(i, tick, mask)
            self.used.append(linear.H.reshape(-1, linear.H.shape[-1]))
            return linear, in_front

    Watched.joint = True
    assert not run(Watched, made).failure
    values = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    return int((values < 1e-7 * values[0]).sum())


def test_bearings_between_vehicles_leave_six_directions_unobservable() -> None:
    made = without_landmarks()
    assert unobservable_dimension(FirstEstimatesEkf, made) == 6
    assert unobservable_dimension(ObservabilityConstrainedEkf, made) == 6
    assert unobservable_dimension(Centralised, made) < 6


def transform(p: np.ndarray) -> np.ndarray:
    return block_diag(*[np.block([[np.eye(3), np.zeros((3, 3))], [skew(x), np.eye(3)]]) for x in p])


def test_it_is_the_filter_in_transformed_coordinates() -> None:
    """arXiv 2303.01205: in xi = T e the propagation is the identity, and T is taken at the present estimate."""
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 0.5}), 4)
    L, N = made.landmarks.shape[1], len(made.setups)

    class Ungated(FirstEstimatesEkf):
        def reset(self, poses, covariances) -> None:  # type: ignore[no-untyped-def]
            super().reset(poses, covariances)
            for gate in self.gates:
                gate.passed = lambda time, residual, S, front: np.ones(len(residual), bool)  # type: ignore[method-assign]

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
    result = run(Ungated, made)
    assert not result.failure
    assert_allclose(result.position[-1], p, atol=1e-6)
    assert_allclose(result.rotation[-1], R, atol=1e-6)


@pytest.mark.parametrize("name", ["first_estimates_ekf", "observability_constrained_ekf"])
def test_with_landmarks_it_tracks(name: str) -> None:
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 5.0}), 0)
    result = run(name, made)
    assert not result.failure
    assert (result.position_rmse(3.0)[:3] < 0.3).all()
