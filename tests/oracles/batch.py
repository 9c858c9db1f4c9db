"""The most probable trajectory of a whole record by one non-linear least squares: what a filter of small errors gives.

Written in residuals of the measurements, without any Jacobian of the filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coopenv.observers import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario


def small_errors(overrides: dict[str, object], size: float = 1e-4, turning: bool = True) -> Scenario:
    """Return busy_intersection with initial errors of this size, turning vehicles, cameras and markers off centre."""
    start = {
        "position": None,
        "position_radius": size,
        "orientation_angle": size,
        "orientation_offset_wxyz": [1.0, 0.0, 0.0, 0.0],
    }
    changes: dict[str, object] = {"noise.bearing.model": "isotropic", "vehicles.*.initial_estimate": start}
    if turning:
        changes |= {"camera.position": [0.4, 0.1, 0.2], "vehicles.*.marker": [0.3, -0.2, 0.5]}
        for i in range(5):
            angular = [0.2, -0.1, 1.0 + i]
            changes[f"vehicles.{i}.motion"] = {"kind": "constant", "linear": [3.0, 0.5, 0.1], "angular": angular}
    return load_scenario("busy_intersection", changes | overrides)


@cache
def small_record(ticks: int = 4) -> Recording:
    """Return a short record with noise so small that second-order terms vanish, and a matching start covariance."""
    scenario = small_errors(
        {
            "horizon": ticks / 60.0,
            "rates.odometry": 60.0,
            "noise.odometry_rate": "sample",
            "noise.velocity": 6e-3,
            "noise.angular_velocity": 6e-3,
            "noise.bearing.rate": "sample",
            "noise.bearing.scale": 2e-4,
        }
    )
    made = record(scenario, 3)
    return replace(made, start_covariance=np.tile(np.eye(6) * 1e-8, (5, 1, 1)))


@cache
def small_solution(
    ticks: int, vehicles: tuple[int, ...] = (0, 1, 2, 3, 4)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `solve` finds of a small record."""
    return solve(small_record(ticks), vehicles)


def solve(recording: Recording, vehicles: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotations (n, 3, 3), positions (n, 3) and left covariances (n, 6, 6) of these vehicles at the last tick.

    Only landmarks and the vehicles of the list are measured.
    """
    K, n, L = recording.ticks, len(vehicles), recording.landmarks.shape[1]
    truth = recording.truth
    R0 = truth.rotation[:, list(vehicles)]
    p0 = truth.position[:, list(vehicles)]
    noise = recording.setups[0].noise
    scale_w = noise.angular_velocity * recording.dt
    scale_v = noise.velocity * recording.dt

    def poses(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e = x.reshape(K, n, 6)
        turn = Rotation.from_rotvec(e[..., :3].reshape(-1, 3)).as_matrix().reshape(K, n, 3, 3)
        return R0 @ turn, p0 + (R0 @ e[..., 3:, None])[..., 0]

    def residuals(x: np.ndarray) -> np.ndarray:
        R, p = poses(x)
        out = []
        for c, i in enumerate(vehicles):
            start = np.sqrt(recording.start_covariance[i, 0, 0])
            Rs, ps = recording.start_rotation[i], recording.start_position[i]
            out += [Rotation.from_matrix(Rs.T @ R[0, c]).as_rotvec() / start, Rs.T @ (p[0, c] - ps) / start]
            for k in range(1, K):
                dR, dp = recording.rotation[k, i], recording.translation[k, i]
                out.append(Rotation.from_matrix(dR.T @ R[k - 1, c].T @ R[k, c]).as_rotvec() / scale_w)
                out.append((R[k - 1, c].T @ (p[k, c] - p[k - 1, c]) - dp) / scale_v)
                for target in recording.setups[i].targets:
                    j = int(target) - L
                    if j >= 0 and j not in vehicles:
                        continue
                    z = recording.landmarks[k, target] if j < 0 else None
                    if z is None:
                        d = vehicles.index(j)
                        z = p[k, d] + R[k, d] @ recording.setups[j].marker
                    line = R[k, c].T @ (z - p[k, c]) - recording.setups[i].lever_arm
                    out.append((line / np.linalg.norm(line) - recording.bearings[k, i, target]) / noise.bearing)
        return np.concatenate(out)

    found = least_squares(residuals, np.zeros(6 * K * n), method="lm", x_scale=1e-4, diff_step=1e-3)
    R, p = poses(found.x)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    last = covariance[-6 * n :, -6 * n :].reshape(n, 6, n, 6)
    return R[-1], p[-1], np.stack([last[c, :, c] for c in range(n)])


def assert_same_covariance(found: np.ndarray, expected: np.ndarray, atol: float = 2e-3) -> None:
    """Compare covariances (..., n, n) in units of the expected standard deviations."""
    std = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    scale = std[..., :, None] * std[..., None, :]
    assert_allclose(found / scale, expected / scale, atol=atol)
