"""The posterior Cramer-Rao lower bound of a scenario: no observer of the same measurements does better on average.

Source: Tichavsky, Muravchik and Nehorai, Posterior Cramer-Rao bounds for discrete-time nonlinear filtering, IEEE
Transactions on Signal Processing 46(5), 1998, on the stacked left errors of all vehicles (R = Rhat Exp(theta),
p = phat + Rhat rho), linearised at the truth:

    J_{k+1} = (F_k J_k^-1 F_k^T + Q_k)^-1 + sum over visible (i, j) of H_ij^T N_ij^-1 H_ij.

Noise that is not Gaussian, as the paper's on the image plane, counts with its covariance: then it is the bound of what
is linear in the measurements. Without noise of bearings there is none, and every entry is NaN.

The edges are those that were realised, so the bound is conditional on them: average it over seeds. It is first order in
the orientation, meaningful below about 10 deg, and does not count what "not seen" tells. It bounds the problem in which
everybody has all data, whatever was delivered.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import skew
from coopenv.observers.recording import Recording


@dataclass(frozen=True)
class Bound:
    """Lower bounds on the standard deviations at each tick."""

    t: Array  # (K,) s
    position: Array  # (K, N) m: sqrt(trace) of the position's block
    orientation: Array  # (K, N) deg: sqrt(trace) of the orientation's block
    covariance: Array  # (K, N, 6, 6) left errors, rad and m

    def position_rms(self, after: float = 0.0) -> Array:
        """Return (N,) the root mean square of the position's bound from a time on, m."""
        return np.asarray(np.sqrt(np.mean(self.position[self.t >= after] ** 2, axis=0)))


def cramer_rao(recording: Recording, joint: bool = True) -> Bound:
    """Return the bound of a record: of its truth, visible edges, noise and initial covariance.

    It is joint, over all vehicles, whose poses are all unknown, or that of each vehicle alone, as if its neighbours'
    poses were known exactly.
    """
    N = len(recording.setups)
    M, F = information(recording, joint), transitions(recording)
    groups = [range(N)] if joint else [[i] for i in range(N)]
    return _bound(recording, _covariances(recording, F, M, groups).reshape(recording.ticks, N, 6, 6))


def cramer_rao_ancestors(recording: Recording) -> Bound:
    """Return, for each vehicle, the joint bound over it and its ancestors: all whose messages can reach it.

    It counts what these vehicles measure and nothing else. A decentralised observer whose messages follow the graph
    knows no more, whereas the bound over all vehicles also counts what followers could tell their leaders.
    """
    N = len(recording.setups)
    F = transitions(recording)
    blocks = np.empty((recording.ticks, N, 6, 6))
    families = [ancestors(recording, i) for i in range(N)]
    for family in set(families):
        P = _covariances(recording, F, information(recording, observers=family), [family])[:, 0]
        for i in (i for i in range(N) if families[i] == family):
            blocks[:, i] = P[:, family.index(i)]
    return _bound(recording, blocks)


def ancestors(recording: Recording, vehicle: int) -> tuple[int, ...]:
    """Return a vehicle, its neighbours, theirs, and so on, sorted."""
    found, waiting = set(), {vehicle}
    while waiting:
        i = waiting.pop()
        found.add(i)
        targets = recording.setups[i].targets - recording.setups[i].landmarks
        waiting |= {int(j) for j in targets if j >= 0} - found
    return tuple(sorted(found))


def _covariances(recording: Recording, F: Array, M: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Return (K, g, n, 6, 6) the bounds of g groups of n vehicles, those of a group estimated together.

    F and M (K, 6N, 6N) are the transitions and the information of all.
    """
    part = (6 * np.asarray(groups)[..., None] + np.arange(6)).reshape(len(groups), -1)
    F, M = (A[:, part[:, :, None], part[:, None, :]] for A in (F, M))
    F_T = np.swapaxes(F, -1, -2)
    noise = [np.diag(np.concatenate([recording.setups[i].noise.odometry(recording.dt) for i in g])) for g in groups]
    P = np.array([block_diag(*(recording.start_covariance[i] for i in group)) for group in groups])
    own = np.arange(part.shape[1]).reshape(-1, 6)
    rows, columns = own[:, :, None], own[:, None, :]
    blocks = np.empty((recording.ticks, len(groups), len(own), 6, 6))
    blocks[0] = P[:, rows, columns]
    identity = np.eye(part.shape[1])
    for k in range(1, recording.ticks):
        P = F[k] @ P @ F_T[k] + noise
        if recording.due[k]:
            # (P^-1 + M)^-1 without the inverse of P, which may be ill-conditioned: P (I + M P)^-1
            P = np.linalg.solve(identity + P @ M[k], P)
            P = (P + np.swapaxes(P, -1, -2)) / 2
        blocks[k] = P[:, rows, columns]
    return blocks


def _bound(recording: Recording, blocks: Array) -> Bound:
    if any(setup.noise.bearing == 0.0 for setup in recording.setups):
        blocks = np.full_like(blocks, np.nan)
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


def information(recording: Recording, joint: bool = True, observers: Collection[int] | None = None) -> Array:
    """Return sum of H^T N^-1 H (K, 6N, 6N) over the visible edges at each tick, linearised at the truth.

    `joint`: a neighbour's pose is unknown, too; `observers`: whose measurements count, None: everybody's.
    """
    R, p = recording.truth.rotation, recording.truth.position
    K, N = R.shape[:2]
    L = recording.landmarks.shape[1]
    M = np.zeros((K, 6 * N, 6 * N))
    minus = np.broadcast_to(-np.eye(3), (K, 3, 3))
    for i, setup in enumerate(recording.setups):
        if observers is not None and i not in observers:
            continue
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
            weight = recording.visible[:, i, target, None, None] * setup.noise.bearing_information(u)
            Hi = across @ np.concatenate([skew(a), minus], axis=-1)
            Hi_t = np.swapaxes(Hi, -1, -2) @ weight
            M[:, own, own] += Hi_t @ Hi
            if j < 0 or not joint:
                continue
            other = slice(6 * j, 6 * j + 6)
            Hj = across @ Rt @ R[:, j] @ np.hstack([-skew(marker), np.eye(3)])
            Hj_t = np.swapaxes(Hj, -1, -2) @ weight
            M[:, other, other] += Hj_t @ Hj
            M[:, own, other] += Hi_t @ Hj
            M[:, other, own] += Hj_t @ Hi
    return M
