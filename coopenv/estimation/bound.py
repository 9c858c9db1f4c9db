"""The posterior Cramer-Rao lower bound of a scenario: no observer of the same measurements does better on average.

Source: Tichavsky, Muravchik and Nehorai, Posterior Cramer-Rao bounds for discrete-time nonlinear filtering, IEEE
Transactions on Signal Processing 46(5), 1998, on the stacked left errors of all vehicles (R = Rhat Exp(theta),
p = phat + Rhat rho), linearised at the truth:

    J_{k+1} = (F_k J_k^-1 F_k^T + Q_k)^-1 + sum over visible (i, j) of H_ij^T H_ij / sigma^2.

The edges are those that were realised, so the bound is conditional on them: average it over seeds. It is first order in
the orientation, meaningful below about 10 deg, and does not count what "not seen" tells. It bounds the problem in which
everybody has all data, whatever was delivered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coopenv.estimation.observers.base import Array
from coopenv.estimation.observers.rotations import skew
from coopenv.estimation.observers.runner import Recording


@dataclass(frozen=True)
class Bound:
    """Lower bounds on the standard deviations at each tick."""

    t: Array  # (K,) s
    position: Array  # (K, N) m: sqrt(trace) of the position's block
    orientation: Array  # (K, N) deg: sqrt(trace) of the orientation's block
    covariance: Array  # (K, N, 6, 6) left errors, rad and m

    def position_rms(self, after: float = 0.0) -> Array:
        """Return (N,) the root mean square of the position's bound from a time on, m."""
        return np.sqrt(np.mean(self.position[self.t >= after] ** 2, axis=0))


def cramer_rao(recording: Recording, joint: bool = True) -> Bound:
    """Return the bound of a record with its realised visibility.

    Args:
        recording: of which the truth, the visible edges, the noise and the initial covariance are used.
        joint: over all vehicles, whose poses are all unknown; False: each vehicle alone, as if its neighbours' poses
            were known exactly.
    """
    K, N = recording.ticks, len(recording.setups)
    M = information(recording, joint)
    F = transitions(recording)
    noise = np.concatenate([setup.noise.odometry(recording.dt) for setup in recording.setups])
    P = np.zeros((6 * N, 6 * N))
    for i, covariance in enumerate(recording.start_covariance):
        P[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = covariance
    blocks = np.empty((K, N, 6, 6))
    own = np.arange(6 * N).reshape(N, 6)
    rows, columns = own[:, :, None], own[:, None, :]
    blocks[0] = P[rows, columns]
    identity = np.eye(6 * N)
    for k in range(1, K):
        P = F[k] @ P @ F[k].T
        P[np.diag_indices(6 * N)] += noise
        if recording.due[k]:
            # (P^-1 + M)^-1 without the inverse of P, which may be ill-conditioned: P (I + M P)^-1
            P = np.linalg.solve(identity + P @ M[k], P)
            P = (P + P.T) / 2
        blocks[k] = P[rows, columns]
    trace = np.trace(blocks[..., 3:, 3:], axis1=-2, axis2=-1)
    angle = np.trace(blocks[..., :3, :3], axis1=-2, axis2=-1)
    return Bound(recording.t, np.sqrt(trace), np.degrees(np.sqrt(angle)), blocks)


def transitions(recording: Recording) -> Array:
    """Return F (K, 6N, 6N) of the stacked left errors over the true motion into each tick; F[0] is the identity."""
    R, p = recording.truth.rotation, recording.truth.position
    K, N = R.shape[:2]
    E = np.swapaxes(R[1:], -1, -2) @ R[:-1]
    step = (np.swapaxes(R[:-1], -1, -2) @ (p[1:] - p[:-1])[..., None])[..., 0]
    F = np.tile(np.eye(6 * N), (K, 1, 1))
    for i in range(N):
        a, b, c = 6 * i, 6 * i + 3, 6 * i + 6
        F[1:, a:b, a:b] = F[1:, b:c, b:c] = E[:, i]
        F[1:, b:c, a:b] = -E[:, i] @ skew(step[:, i])
    return F


def information(recording: Recording, joint: bool = True) -> Array:
    """Return sum of H^T H / sigma^2 (K, 6N, 6N) over the visible edges at each tick, linearised at the truth."""
    R, p = recording.truth.rotation, recording.truth.position
    K, N = R.shape[:2]
    L = recording.landmarks.shape[1]
    M = np.zeros((K, 6 * N, 6 * N))
    minus = np.broadcast_to(-np.eye(3), (K, 3, 3))
    for i, setup in enumerate(recording.setups):
        own = slice(6 * i, 6 * i + 6)
        Rt = np.swapaxes(R[:, i], -1, -2)
        for target in setup.targets:
            j = int(target) - L
            marker = recording.setups[j].marker if j >= 0 else np.zeros(3)
            z = recording.landmarks[:, target] if j < 0 else p[:, j] + R[:, j] @ marker
            a = (Rt @ (z - p[:, i])[..., None])[..., 0]
            d = a - setup.lever_arm
            distance = np.maximum(np.linalg.norm(d, axis=-1), 1e-9)
            u = d / distance[:, None]
            across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / distance[:, None, None]
            weight = recording.visible[:, i, target] / setup.noise.bearing_std**2
            Hi = across @ np.concatenate([skew(a), minus], axis=-1)
            Hi_t = np.swapaxes(Hi, -1, -2) * weight[:, None, None]
            M[:, own, own] += Hi_t @ Hi
            if j < 0 or not joint:
                continue
            other = slice(6 * j, 6 * j + 6)
            Hj = across @ Rt @ R[:, j] @ np.hstack([-skew(marker), np.eye(3)])
            Hj_t = np.swapaxes(Hj, -1, -2) * weight[:, None, None]
            M[:, other, other] += Hj_t @ Hj
            M[:, own, other] += Hi_t @ Hj
            M[:, other, own] += Hj_t @ Hi
    return M
