"""The measures by which an estimate is judged, in NumPy, over any leading axes.

Position errors are in the map frame (m), orientation errors are geodesic angles (deg), and Rtilde = Rhat^T R as in the
paper. Nothing is aligned before it is compared: the maps are global, and an alignment would hide the mirrored solution
(orientation half a turn off), which a bearing-only observer without a sign test can fall into.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4 (NEES and NIS
with chi-square bounds); Wilson, Probable inference, JASA 22, 1927 (interval of a share).

Source: Sturm, Engelhard, Endres, Burgard and Cremers, A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError
from coopenv.estimation.observability import Observability, slowest_decay
from coopenv.estimation.poses import Array, Coordinates, covariance_in_map, orientation_error_deg
from coopenv.estimation.trajectory import Trajectory

STEADY_SHARE = 0.7  # the steady state is taken to begin after this share of the horizon (35 s of 50 s)
MOST_SHOWN = 12  # vehicles in figures and printed tables; of a larger fleet, the ones with the largest errors
MIRROR_ANGLE_DEG = 150.0  # an orientation error above it at the end of a run is the mirrored solution, not a slow one


class SettlingTolerance(NamedTuple):
    """Errors below which an estimate counts as, for example, converged, if it stays there."""

    name: str
    position_m: float
    orientation_deg: float

    @property
    def text(self) -> str:
        """The tolerance in words, e.g. `0.1 m and 1 deg`."""
        return f"{self.position_m:g} m and {self.orientation_deg:g} deg"

    def contains(self, position_error: np.ndarray, orientation_error: np.ndarray) -> np.ndarray:
        """Return whether both errors (m, deg) lie below the tolerance."""
        return (position_error < self.position_m) & (orientation_error < self.orientation_deg)


SETTLED = SettlingTolerance("settled", 0.5, 5.0)  # attainable under measurement noise
CONVERGED = SettlingTolerance("converged", 0.1, 1.0)
_NOT_CONVERGED = "did not converge, no rate to fit"
_FIT_SAMPLES = 400  # Theil-Sen looks at every pair: 80 000 slopes
_FIT_SAMPLES_MIN = 3
_FLICKER = 31  # ticks of a running median, which ignores single errors above half


class RateFit(NamedTuple):
    """An exponential rate (1/s, positive when the error falls), its 95 % bounds and its sample count."""

    rate: float
    low: float
    high: float
    samples: int
    remark: str = ""  # why there is no rate


def steady_start(given: float | None, horizon: float, end: float | None = None) -> float:
    """Return the start of the steady state, s: as given by the user, or after `STEADY_SHARE` of the horizon, s.

    A given start has to lie within the run, which ends at `end`, s, if it ends before the horizon.
    """
    if given is None:
        return STEADY_SHARE * horizon
    last = horizon if end is None else end
    if not 0.0 <= given < last:
        raise CoopenvError(f"steady_from {given:g} is not within the run of {last:g} s")
    return given


def live_ticks(t: np.ndarray, vehicles: int, ends: Sequence[float] | None = None) -> np.ndarray:
    """Return (N,) the number of ticks (K,) up to each vehicle's end, the tick of its end included.

    `ends` is the time of each arrival or collision, s: NaN or beyond the record for a vehicle still under way.
    """
    if ends is None:
        return np.full(vehicles, len(t))
    return np.maximum(1, np.searchsorted(t, np.asarray(ends, float) + 1e-6, side="right"))


def nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the normalised estimation error squared e^T P^-1 e of errors (..., n).

    For a consistent observer it is chi-square distributed with n degrees of freedom. The error must be in the
    coordinates of P (see `Coordinates.error`); mixing them is the usual mistake. NaN where P is not positive
    definite, as for an observer that declares no covariance.
    """
    e, P = np.asarray(error, float), np.asarray(covariance, float)
    finite = np.isfinite(P).all(axis=(-1, -2))
    P = np.where(finite[..., None, None], P, -np.eye(P.shape[-1]))
    definite = np.linalg.eigvalsh(P)[..., 0] > 0
    P = np.where(definite[..., None, None], P, np.eye(P.shape[-1]))
    weighted = np.linalg.solve(P, e[..., None])[..., 0]
    return np.where(definite, np.einsum("...i,...i->...", e, weighted), np.nan)


def settling_time(
    t: np.ndarray, position_error: np.ndarray, orientation_error: np.ndarray, tolerance: SettlingTolerance = CONVERGED
) -> np.ndarray:
    """Return the first time (...), s, from which errors (K, ...) in m and deg stay below a tolerance until the end.

    NaN where the last tick is not below both, so that a passing visit does not count as settled.
    """
    below = tolerance.contains(position_error, orientation_error)
    settled = np.logical_and.accumulate(below[::-1], axis=0)[::-1]
    return np.where(settled[-1], np.asarray(t, float)[np.argmax(settled, axis=0)], np.nan)


def settling_times(
    trajectory: Trajectory, ends: Sequence[float] | None = None, tolerance: SettlingTolerance = CONVERGED
) -> np.ndarray:
    """Return the settling time (N,) s of every vehicle, judged up to its end; see `settling_time`, `live_ticks`."""
    t, live = trajectory.t, live_ticks(trajectory.t, len(trajectory.vehicles), ends)
    errors = zip(live, trajectory.position_error.T, trajectory.orientation_error.T, strict=True)
    return np.array([settling_time(t[:n], position[:n], angle[:n], tolerance) for n, position, angle in errors])


def steady_mean(t: np.ndarray, values: np.ndarray, steady_from: float) -> np.ndarray:
    """Return the mean of values (K, ...) over the ticks with t > steady_from; NaN if there are none."""
    return mean_or_nan(values[t > steady_from])


def steady_rmse(t: np.ndarray, error: np.ndarray, steady_from: float) -> np.ndarray:
    """Return the root mean square of errors (K, ...) over the ticks with t > steady_from; NaN if none."""
    with np.errstate(over="ignore"):  # of an observer that has diverged
        return np.asarray(np.sqrt(steady_mean(t, np.square(np.asarray(error, float)), steady_from)))


def mean_targets_in_view(visible: np.ndarray) -> np.ndarray:
    """Return (...) targets measured per tick, on average, of `visible` (K, ..., T)."""
    return mean_or_nan(np.sum(visible, axis=-1))


def mirrored(orientation_error: np.ndarray) -> np.ndarray:
    """Return whether a run (K, ...) ends with an orientation error above `MIRROR_ANGLE_DEG`."""
    return np.asarray(orientation_error[-1] > MIRROR_ANGLE_DEG)


def fit_exponential_rate(t: np.ndarray, error: np.ndarray, noise_floor: float | None = None) -> RateFit:
    """Fit error ~ exp(-rate t) to the final descent of one error (K,), robustly (Theil-Sen).

    The fit takes the ticks after the error (its running median) was last above half of its initial value, up to
    the first within three times the noise floor: before, the transient is not exponential (P falls as 1/t);
    after, there is only noise. The bounds assume independent residuals, which neighbouring ticks are not: they
    are a lower limit of the uncertainty. Without a descent of at least three samples that stands out of the scatter the
    rate is NaN, with a remark. The noise floor is by default the median over the last fifth of the record.
    """
    from scipy.ndimage import median_filter  # here, as loading them takes 0.4 s
    from scipy.stats import theilslopes

    t, error = np.asarray(t, float), np.asarray(error, float)
    if not np.isfinite(error).all():
        return _no_rate("error is not finite")
    half = 0.5 * error[0]
    if half < np.finfo(float).tiny:
        return _no_rate("no initial error")
    floor = float(np.median(error[-max(1, len(error) // 5) :])) if noise_floor is None else noise_floor
    start = int(np.flatnonzero(median_filter(error, _FLICKER, mode="nearest") > half)[-1]) + 1
    if start == len(error) or 3 * floor >= half:
        where = "above" if floor > error[0] else f"at {100 * floor / error[0]:.0f} % of"
        return _no_rate(f"error ends {where} its initial value")
    low = np.flatnonzero(error[start:] <= max(3 * floor, np.finfo(float).tiny))
    index = np.arange(start, start + low[0] if low.size else len(error))
    if len(index) < _FIT_SAMPLES_MIN:
        if start <= _FIT_SAMPLES_MIN:
            return _no_rate(f"error fell below half {_within(start)}", len(index))
        return _no_rate(f"error fell from half to the noise floor {_within(len(index) + 1)}", len(index))
    index = index[:: math.ceil(len(index) / _FIT_SAMPLES)]
    slope, _, slope_low, slope_high = theilslopes(np.log(error[index]), t[index], alpha=0.95)
    fall = np.log(half / error[index].min())
    if slope_high >= 0 or -slope * (t[index[-1]] - t[index[0]]) < 0.5 * fall:
        return _no_rate("error falls no faster than it scatters", len(index))
    return RateFit(float(-slope), float(-slope_high), float(-slope_low), len(index))


def _within(ticks: int) -> str:
    return f"within {ticks} tick{'s' if ticks > 1 else ''}"


def _no_rate(reason: str, samples: int = 0) -> RateFit:
    return RateFit(math.nan, math.nan, math.nan, samples, f"{reason}, no rate to fit")


def observability_of(observability: Observability, vehicle: int, end: float = math.inf) -> Observability:
    """Return the figures of one vehicle alone, without the windows that reach beyond its end (s; NaN: none)."""
    late = observability.t + observability.window > end + 1e-6
    return observability.selected([vehicle], ~late)


def shown_vehicles(trajectory: Trajectory, steady_from: float, ends: Sequence[float] | None = None) -> list[int]:
    """Return the vehicles that figures and tables show: all, or the `MOST_SHOWN` of the largest steady position RMSE.

    The largest comes first; an estimate without a finite error counts as the largest. Vehicles that end before the
    steady state follow, by their last error. `steady_from` and `ends` as of `summarise`.
    """
    count, t = len(trajectory.vehicles), trajectory.t
    if count <= MOST_SHOWN:
        return [*range(count)]
    live = live_ticks(t, count, ends)
    rmse = [steady_rmse(t[:n], trajectory.position_error[:n, i], steady_from) for i, n in enumerate(live)]
    last = trajectory.position_error[live - 1, np.arange(count)]
    steady = t[live - 1] > steady_from
    order = np.lexsort([-np.nan_to_num(error, nan=np.inf) for error in (last, rmse)] + [~steady])
    return [int(i) for i in order[:MOST_SHOWN]]


def shown_note(count: int) -> str:
    """Return in words the choice of `shown_vehicles` from a fleet; empty if it is all vehicles."""
    return f"{MOST_SHOWN} worst of {count} vehicles, by RMSE of the position" if count > MOST_SHOWN else ""


def summarise(trajectory: Trajectory, steady_from: float, ends: Sequence[float] | None = None) -> list[dict[str, Any]]:
    """Return one dict of plain Python values per vehicle, units in the keys; missing values are NaN or None.

    Steady RMSE and mean NEES are over the ticks after `steady_from`, s; nothing counts after `ends`, see `live_ticks`.
    """
    rows = []
    for vehicle, ticks in enumerate(live_ticks(trajectory.t, len(trajectory.vehicles), ends)):
        t = trajectory.t[:ticks]
        position = trajectory.position_error[:ticks, vehicle]
        orientation = trajectory.orientation_error[:ticks, vehicle]
        slowest, slowest_from = slowest_decay(t, position)
        fit, mirror = fit_exponential_rate(t, position), bool(mirrored(orientation))
        rows.append(
            {
                "vehicle": str(trajectory.vehicles[vehicle]),
                "initial_position_error_m": float(position[0]),
                "initial_orientation_error_deg": float(orientation[0]),
                "settle_time_s": float(settling_time(t, position, orientation, SETTLED)),
                "convergence_time_s": float(settling_time(t, position, orientation, CONVERGED)),
                "steady_position_rmse_m": float(steady_rmse(t, position, steady_from)),
                "steady_orientation_rmse_deg": float(steady_rmse(t, orientation, steady_from)),
                "mean_targets_in_view": float(mean_targets_in_view(trajectory.visible[:ticks, vehicle])),
                "nees_dof": trajectory.nees_dof,
                "mean_nees": float(steady_mean(t, trajectory.nees[:ticks, vehicle], steady_from)),
                "final_position_error_m": float(position[-1]),
                "final_orientation_error_deg": float(orientation[-1]),
                "rate_per_s": fit.rate,
                "rate_remark": (_NOT_CONVERGED if fit.remark and mirror else fit.remark) or None,
                "slowest_rate_per_s": slowest,
                "slowest_rate_from_s": slowest_from,
                "mirrored": mirror,
            }
        )
    return rows


def mean_or_nan(values: np.ndarray) -> np.ndarray:
    """Return the mean over the first axis, NaN when it is empty."""
    return np.mean(values, axis=0) if len(values) else np.full(values.shape[1:], np.nan)


LEVEL = 0.95
DIVERGED_POSITION, DIVERGED_ORIENTATION = 5.0, 30.0  # m and deg


class Interval(NamedTuple):
    """Low and high end."""

    low: float
    high: float


def mean_bounds(dof: int, runs: int = 1) -> Interval:
    """Return the interval of the mean over independent runs of a chi-square of `dof` degrees, divided by `dof`.

    For ANEES the runs are Monte Carlo runs at one instant: ticks of one run are correlated, so the bounds do not hold
    for a mean over time. For NIS, which is white over time, a run may be a tick. `LEVEL` is the probability of lying
    inside.
    """
    from scipy.stats import chi2  # here, as loading it takes 0.4 s

    total = dof * runs
    return Interval(*(float(end) / total for end in chi2.interval(LEVEL, total)))


def wilson_interval(successes: int, trials: int) -> Interval:
    """Return the interval of a probability of which `successes` in `trials` were seen; all of [0, 1] without trials."""
    if trials == 0:
        return Interval(0.0, 1.0)
    from scipy.stats import binomtest

    return Interval(*binomtest(successes, trials).proportion_ci(LEVEL, "wilson"))


def diverged(position_error: Array, orientation_error: Array) -> np.ndarray:
    """Return whether runs with these errors (K, ...), m and deg, are never below both limits, or exceed one again.

    Ticks that are NaN do not count; a run of which nothing is known diverges.
    """
    below = (position_error <= DIVERGED_POSITION) & (orientation_error <= DIVERGED_ORIENTATION)
    exceeds = (position_error > DIVERGED_POSITION) | (orientation_error > DIVERGED_ORIENTATION)
    return np.asarray((exceeds & np.logical_or.accumulate(below, axis=0)).any(axis=0) | ~below.any(axis=0))


def position_std(covariance: Array, coordinates: Coordinates, rotation: Array, position: Array) -> Array:
    """Return sqrt(trace) (...) of the covariance of the position in the map that P (..., 6, 6) states, m."""
    in_map = covariance_in_map(coordinates, rotation, position, covariance)
    variance = np.trace(in_map[..., :3, :3], axis1=-2, axis2=-1)
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))  # not every P that is stated is a covariance


class RelativeError(NamedTuple):
    """Root mean squares over pairs of poses; NaN where there is no pair."""

    position: float  # m
    orientation: float  # deg


def absolute_error(position: Array, position_estimate: Array) -> float:
    """Return ATE: the root mean square of |p - phat| in m, of positions (K, 3), over the ticks with known truth."""
    known = np.isfinite(position).all(axis=-1)
    if not known.any():
        return float("nan")
    difference = position[known] - position_estimate[known]
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))


def relative_error(
    rotation: Array, position: Array, rotation_estimate: Array, position_estimate: Array, delta: int
) -> RelativeError:
    """Return RPE: the root mean square over pairs (k, k + delta) of E = (P_k^-1 P_k+)^-1 (Phat_k^-1 Phat_k+).

    Rotations (K, 3, 3) are body to map, positions (K, 3) in the map, m; pairs whose truth is NaN are left out, and they
    do not overlap: k = 0, delta, 2 delta, ... Relative errors of different deltas, in ticks, cannot be compared.
    """
    start = np.arange(0, max(len(position) - delta, 0), delta)
    known: NDArray[np.bool_] = np.isfinite(np.concatenate([rotation, position[..., None]], axis=-1)).all(axis=(-1, -2))
    start = start[known[start] & known[start + delta]]
    if not len(start):
        return RelativeError(float("nan"), float("nan"))
    R, p = _moved(rotation, position, start, start + delta)
    R_hat, p_hat = _moved(rotation_estimate, position_estimate, start, start + delta)
    # E = (R^T R_hat, R^T (p_hat - p)), and the rotation keeps the length
    distance, angle = np.linalg.norm(p_hat - p, axis=-1), orientation_error_deg(R, R_hat)
    return RelativeError(float(np.sqrt(np.mean(distance**2))), float(np.sqrt(np.mean(angle**2))))


def _moved(R: Array, p: Array, begin: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return P_begin^-1 P_end as rotations (n, 3, 3) and positions (n, 3)."""
    back = np.swapaxes(R[begin], -1, -2)
    return back @ R[end], (back @ (p[end] - p[begin])[..., None])[..., 0]
