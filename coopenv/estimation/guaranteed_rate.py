"""The rate at which the paper's observer is guaranteed to converge, at every instant of a run.

Source: Wong et al., Beyond Line-of-Sight: Cooperative Localization Using Vision and V2X Communication; the observer is
that of Hamel and Samson, Riccati observers for the nonstationary PnP problem, IEEE TAC 63(3), 2018. Near the truth its
error obeys x' = (A - k P M) x with M = C*^T Q C* and P' = A P + P A^T - P M P + V. Two rates follow:

- frozen: k lambda_min(P M), that of the slowest direction as if P and M stayed as they are. It vanishes whenever the
  bearings of one instant do not suffice, and while P still falls the error may fall more slowly.
- guaranteed: of the Lyapunov function x^T P^-1 x, whose square root falls no more slowly than
  lambda_min(L^T (k - 1/2) M L + 1/2 L^-1 V L^-T), P = L L^T. Its infimum along the trajectory is the theorem's
  promise, and may lie far below the rate that fits a whole run.

Everything is taken along the truth. In map axes A vanishes, and the prediction leaves P as it is but for V, which is
isotropic. As in the theorem, neighbours count as known, and lambda and p are about the map's origin.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.observability import Scene
from coopenv.estimation.rotations import skew

WINDOW = 5.0
"""s, over which decay is measured."""


class Rates(NamedTuple):
    """Rates (K, N) in 1/s at every tick of a record; frozen ones are 0 where too little is seen."""

    t: Array  # (K,) s
    guaranteed: Array
    frozen: Array


def convergence_rates(
    scene: Scene, k: Sequence[float], q: Array, V: tuple[float, float], P0: tuple[float, float]
) -> Rates:
    """Return the rates of the paper's observer along a record.

    Args:
        scene: true positions and what was seen.
        k: gain of each vehicle (N,), above 0.5.
        q: weight of each target (T,).
        V: diagonal of V over 2 lambda and over p.
        P0: that of P(0).
    """
    vehicles = range(len(k))
    M = np.stack([weighted_information(scene, i, q) for i in vehicles], axis=1)
    drift, gain = np.diag(np.repeat(V, 3)), np.asarray(k, float)[:, None, None]
    P, identity = np.tile(np.diag(np.repeat(np.array(P0, float), 3)), (len(k), 1, 1)), np.eye(6)
    guaranteed, frozen = np.empty(M.shape[:2]), np.empty(M.shape[:2])
    for n, dt in enumerate(np.diff(scene.t, prepend=scene.t[0])):
        P = P + drift * dt
        # The bearings of a tick act until the next one: P^-1 grows by M dt.
        P = np.linalg.solve(identity + dt * P @ M[n], P)
        P = (P + np.swapaxes(P, 1, 2)) / 2
        L = np.linalg.cholesky(P)
        pulled = np.swapaxes(L, 1, 2) @ M[n] @ L
        grown = np.linalg.solve(L, np.linalg.solve(L, drift).swapaxes(1, 2))  # L^-1 V L^-T
        guaranteed[n] = np.linalg.eigvalsh((gain - 0.5) * pulled + 0.5 * grown)[:, 0]
        frozen[n] = gain[:, 0, 0] * np.linalg.eigvalsh(pulled)[:, 0]
    return Rates(scene.t, guaranteed, np.maximum(frozen, 0.0))


def weighted_information(scene: Scene, i: int, q: Array) -> Array:
    """Return M = C*^T Q C* (K, 6, 6) of one vehicle in map axes, about the map's origin; q (T,) are the weights."""
    known = np.isfinite(scene.target_position).all(axis=-1)
    place = np.where(known[..., None], scene.target_position, 0.0)
    offset = place - scene.position[:, i, None]
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    bearing = offset / np.where(distance > 0, distance, 1.0)
    weight = np.where(scene.visible[:, i] & known & (distance[..., 0] > 0), q, 0.0)
    across = np.eye(3) - bearing[..., :, None] * bearing[..., None, :]
    rows = np.concatenate([-across @ skew(place), across], axis=-1)
    return np.asarray(np.einsum("kt,ktai,ktaj->kij", weight, rows, rows))


def least_mean(t: Array, rates: Array, window: float = WINDOW) -> tuple[float, float]:
    """Return the least mean of rates (K,) over any window, and when that begins, s; NaN of a shorter record."""
    total = np.concatenate([[0.0], np.cumsum(np.diff(t) * (rates[1:] + rates[:-1]) / 2)])
    start = np.flatnonzero(t <= t[-1] - window + 1e-9)
    if not len(start):
        return float("nan"), float("nan")
    end = np.minimum(np.searchsorted(t, t[start] + window - 1e-9), len(t) - 1)
    mean = (total[end] - total[start]) / (t[end] - t[start])
    return float(mean.min()), float(t[start[np.argmin(mean)]])


def slowest_decay(t: Array, error: Array, window: float = WINDOW) -> tuple[float, float]:
    """Return the least rate, 1/s, at which an error (K,) fell over windows one after the other, and when that began, s.

    The rate of a window is the least-squares slope of -log(error), negative where the error grew. Windows count until
    the error first comes within three times its noise floor, the median over the last fifth of the record; NaN where
    that is in the first.
    """
    floor = float(np.median(error[-max(1, len(error) // 5) :]))
    low = np.flatnonzero(~(error > max(3.0 * floor, np.finfo(float).tiny)))
    end = float(t[low[0]]) if len(low) else float(t[-1])
    found = []
    for start in np.arange(float(t[0]), end - window + 1e-9, window):
        within = (t >= start - 1e-9) & (t <= start + window + 1e-9)
        found.append((-float(np.polyfit(t[within], np.log(error[within]), 1)[0]), float(start)))
    return min(found, default=(float("nan"), float("nan")))
