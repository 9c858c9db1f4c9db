"""Uniform observability of (A_i, C*_i) along the record of a run: the condition of the paper's theorem.

For vehicle i and the targets j that it sees at a tick, the rows of C*_i = C_i(0, p_i, t) are [-Pi_g S(R_i^T
pbar_j), Pi_g] over the state (2 lambda, p), with Pi_g = I - g g^T. The projection is even in g, so it does
not matter which way the bearing points. With A_i = blkdiag(-S(omega), -S(omega)), the transition matrix is
Phi(tau, t) = blkdiag(E, E), E = R(tau)^T R(t), and

    W(t) = (1/window) int_t^{t+window} Phi^T C*^T C* Phi dtau.

Since Phi is a rotation, C* Phi = R(tau)^T [-Pi S(pbar_j), Pi] blkdiag(R(t), R(t)) with Pi in the map frame:
the integrand is summed once along the run in map axes, and every window is a difference of two sums.

Moving the origin by c is the congruence W -> T^T W T, T = [[I, 0], [S(c), I]]. It leaves the rank of W, so
whether there is observability at all, but not the eigenvalues: far from the origin the smallest one falls as
1/|c|^2 with the same geometry, and the rows mix rad and m. The verdict is therefore taken about the vehicle's
own position, in a unit of length that the geometry brings along (`Observability.local_eigenvalue`).

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
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from coopenv.estimation.poses import Array, skew
from coopenv.estimation.trajectory import RecordedGeometry
from coopenv.estimation.trajectory import Trajectory as Trajectory  # until 0.10 here, too

DEFAULT_WINDOW = 1.0
DEFAULT_THRESHOLD = 1e-4


class ObservabilityInterval(NamedTuple):
    """A stretch [start, end] (s) of equal verdict."""

    start: float
    end: float
    observable: bool


@dataclass(frozen=True)
class Observability:
    """The Gramian's figures for M windows of N vehicles.

    The default threshold of 1e-4 on `local_eigenvalue` mu: with bearing noise sigma (rad) and n camera ticks
    in the window, least squares leaves a standard deviation of L sigma / sqrt(n mu) in the worst direction, L
    being the rms range of the targets. At mu = 1e-4 that is 100 / sqrt(n) times the lateral error L sigma of
    one bearing, or 0.6 m at 60 Hz, 3 mrad and 15 m: below it the window has less information than odometry keeps.
    Exact degeneracies (two targets, all targets on one line, the vehicle resting on their danger cylinder)
    give rounding, 1e-12 or less; three well-spread targets give 1e-3 to 0.5.
    """

    t: np.ndarray  # (M,) s, start of each window
    window: float  # s, shortened to the record if that is shorter
    threshold: float  # on `local_eigenvalue`
    min_eigenvalue: np.ndarray  # (M, N) of W as in the theorem, about the map origin; mixed units
    condition_number: np.ndarray  # (M, N) of W as in the theorem; inf where singular to rounding
    local_eigenvalue: np.ndarray  # (M, N) smallest, about the vehicle and with lambda scaled by L: no unit, no origin
    vehicles: np.ndarray  # (N,) names

    @property
    def observable(self) -> np.ndarray:
        """(M, N) bool: the verdict of each window."""
        return self.local_eigenvalue >= self.threshold

    def selected(self, vehicles: Sequence[int], windows: Any = slice(None)) -> Self:
        """Return the figures of some vehicles, and of some windows, alone."""
        columns = ("min_eigenvalue", "condition_number", "local_eigenvalue")
        cut = {name: getattr(self, name)[windows][:, [*vehicles]] for name in columns}
        return replace(self, t=self.t[windows], vehicles=self.vehicles[[*vehicles]], **cut)

    def intervals(self, vehicle: int) -> list[ObservabilityInterval]:
        """Return one vehicle's stretches of equal verdict in order; the last ends with its last window."""
        if not len(self.t):
            return []
        verdict = self.observable[:, vehicle]
        first = np.flatnonzero(np.diff(verdict, prepend=~verdict[0]))
        ends = [*self.t[first[1:]], self.t[-1] + self.window]
        return [
            ObservabilityInterval(float(self.t[k]), float(end), bool(verdict[k]))
            for k, end in zip(first, ends, strict=True)
        ]


def analyse_observability(
    scene: RecordedGeometry,
    window: float = DEFAULT_WINDOW,
    threshold: float = DEFAULT_THRESHOLD,
    more: Array | None = None,
) -> Observability:
    """Evaluate W(t) for every camera tick at which a whole window begins.

    True poses and the visibility of the run are used: the question is the available information, not its use
    of it. Neighbours count as known, as in the theorem, which takes the vehicles one after the other along
    the graph. The window is in s; the threshold is the verdict on the local eigenvalue, see `Observability`.
    `more` (K, N, 6, 6) is information beside that of bearings, map axes, about the map's origin.
    """
    window = min(window, float(scene.t[-1] - scene.t[0]))
    start, W, anchor = _windows_about_anchor(scene, window, more)
    eigenvalues = np.linalg.eigvalsh(_move_origin(W, -anchor))
    smallest, largest = eigenvalues[..., 0], eigenvalues[..., -1]
    regular = smallest > np.finfo(float).eps * largest
    condition = np.where(regular, largest / np.where(regular, smallest, 1.0), np.inf)
    local = _scaled(_move_origin(W, scene.position[start] - anchor))
    return Observability(
        t=scene.t[start],
        window=window,
        threshold=threshold,
        min_eigenvalue=np.maximum(smallest, 0.0),
        condition_number=condition,
        local_eigenvalue=np.maximum(np.linalg.eigvalsh(local)[..., 0], 0.0),
        vehicles=scene.vehicles,
    )


def _windows_about_anchor(
    scene: RecordedGeometry, window: float, more: Array | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return start ticks (M,), W in map axes (M, N, 6, 6), and the points (N, 3) in m that it is taken about.

    A point amid the vehicle's path keeps the running sums, and so the rounding of their differences, small.
    """
    anchor = scene.position.mean(axis=0)
    t, vehicles = scene.t, range(scene.position.shape[1])
    rate = np.stack([_information_of(scene, i, anchor[i]) for i in vehicles], axis=1)
    rate = rate if more is None else rate + _move_origin(more, anchor)
    step = np.diff(t)[:, None, None, None]
    total = np.concatenate([np.zeros_like(rate[:1]), np.cumsum(0.5 * step * (rate[1:] + rate[:-1]), axis=0)])
    slack = 1e-6 * max(window, np.finfo(float).tiny)
    start = np.arange(np.searchsorted(t, t[-1] - window + slack, side="right") if window > 0 else 0)
    end = np.searchsorted(t, t[start] + window - slack)
    length = (t[end] - t[start])[:, None, None, None]
    return start, (total[end] - total[start]) / length, anchor


def _information_of(scene: RecordedGeometry, i: int, anchor: np.ndarray, q: Array | float = 1.0) -> np.ndarray:
    """Return C*^T Q C* (K, 6, 6) of one vehicle in map axes, about a point (3,); q (T,) are weights of targets."""
    ever = scene.visible[:, i].any(axis=0)  # a target that is never seen adds nothing
    known = np.isfinite(scene.target_position[:, ever]).all(axis=-1)  # (K, S) for the S others
    place = np.where(known[..., None], scene.target_position[:, ever], 0.0)
    offset = place - scene.position[:, i, None]  # (K, S, 3)
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    bearing = offset / np.where(distance > 0, distance, 1.0)
    seen = scene.visible[:, i, ever] & known & (distance[..., 0] > 0)
    projection = (np.eye(3) - bearing[..., :, None] * bearing[..., None, :]) * np.where(
        seen, np.broadcast_to(q, ever.shape)[ever], 0.0
    )[..., None, None]
    lever = skew(place - anchor)  # (K, S, 3, 3)
    cross = lever @ projection  # = (-Pi S)^T Pi
    rate = np.empty((len(scene.position), 6, 6))
    rate[:, :3, :3] = -(cross @ lever).sum(axis=1)
    rate[:, :3, 3:] = cross.sum(axis=1)
    rate[:, 3:, :3] = np.swapaxes(rate[:, :3, 3:], -1, -2)
    rate[:, 3:, 3:] = projection.sum(axis=1)
    return rate


def _move_origin(W: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return T^T W T, T = [[I, 0], [S(shift), I]]: W about a point `shift` (m) further in map axes."""
    T = np.broadcast_to(np.eye(6), (*shift.shape[:-1], 6, 6)).copy()
    T[..., 3:, :3] = skew(shift)
    return np.asarray(np.swapaxes(T, -1, -2) @ W @ T)


def _scaled(W: np.ndarray) -> np.ndarray:
    """Return W over (2 lambda L, p), L^2 = tr W_lambda / tr W_p: the targets' mean square range."""
    lever = np.trace(W[..., :3, :3], axis1=-2, axis2=-1)
    count = np.trace(W[..., 3:, 3:], axis1=-2, axis2=-1)
    length = np.sqrt(np.where(count > 0, lever, 1.0) / np.where(count > 0, count, 1.0))
    scale = np.ones((*length.shape, 6))
    scale[..., :3] = 1.0 / length[..., None]
    return np.asarray(scale[..., :, None] * W * scale[..., None, :])


WINDOW = 5.0
"""s, over which decay is measured."""


class ConvergenceRates(NamedTuple):
    """Rates (K, N) in 1/s at every tick of a record; frozen ones are 0 where too little is seen."""

    t: Array  # (K,) s
    guaranteed: Array
    frozen: Array


def convergence_rates(
    scene: RecordedGeometry, k: Sequence[float], q: Array, V: tuple[float, float], P0: tuple[float, float]
) -> ConvergenceRates:
    """Return the rates of the paper's observer along a record.

    Args:
        scene: true positions and visibility.
        k: gain of each vehicle (N,), above 0.5.
        q: weight of each target (T,).
        V: diagonal of V over 2 lambda and over p.
        P0: that of P(0).
    """
    vehicles = range(len(k))
    M = np.stack([_information_of(scene, i, np.zeros(3), q) for i in vehicles], axis=1)
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
    return ConvergenceRates(scene.t, guaranteed, np.maximum(frozen, 0.0))


def least_mean(t: Array, rates: Array) -> tuple[float, float]:
    """Return the least mean of rates (K,) over any `WINDOW`, and when that begins, s; NaN of a shorter record."""
    total = np.concatenate([[0.0], np.cumsum(np.diff(t) * (rates[1:] + rates[:-1]) / 2)])
    start = np.flatnonzero(t <= t[-1] - WINDOW + 1e-9)
    if not len(start):
        return float("nan"), float("nan")
    end = np.minimum(np.searchsorted(t, t[start] + WINDOW - 1e-9), len(t) - 1)
    mean = (total[end] - total[start]) / (t[end] - t[start])
    return float(mean.min()), float(t[start[np.argmin(mean)]])


def slowest_decay(t: Array, error: Array) -> tuple[float, float]:
    """Return the least rate, 1/s, at which an error (K,) fell over windows one after the other, and when that began, s.

    The rate of a window is the least-squares slope of -log(error), negative where the error grew. Windows count until
    the error first comes within three times its noise floor, the median over the last fifth of the record; NaN where
    that is in the first.
    """
    floor = float(np.median(error[-max(1, len(error) // 5) :]))
    low = np.flatnonzero(~(error > max(3.0 * floor, np.finfo(float).tiny)))
    end = float(t[low[0]]) if len(low) else float(t[-1])
    found = []
    for start in np.arange(float(t[0]), end - WINDOW + 1e-9, WINDOW):
        within = (t >= start - 1e-9) & (t <= start + WINDOW + 1e-9)
        found.append((-float(np.polyfit(t[within], np.log(error[within]), 1)[0]), float(start)))
    return min(found, default=(float("nan"), float("nan")))
