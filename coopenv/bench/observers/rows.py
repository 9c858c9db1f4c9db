"""The leaderboard's rows: one observer, one vehicle, one variant, summed up over all seeds.

Standard errors of root mean squares are to first order (delta method).

Errors are held against the bound of the same stretch, so that a slow start counts where measurements allow a quick one.
Standard errors are over the seeds; those of root mean squares to first order (delta method), the bound taken as exact.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.format import in_parentheses, number
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.judge import RELATIVE_DELTA, Sample, Window
from coopenv.estimation.metrics import (
    CONVERGED,
    DIVERGED_ORIENTATION,
    DIVERGED_POSITION,
    LEVEL,
    SETTLED,
    Interval,
    mean_bounds,
)
from coopenv.estimation.poses import Array


def _column(meaning: str) -> Any:
    """Declare a column with what it means, which the report prints."""
    return field(metadata={"meaning": meaning})


@dataclass(frozen=True)
class Row:
    """One line of the leaderboard; NaN where there is no such figure, and throughout where a run failed."""

    environment: str = _column("environment, dataset or log file")
    variant: str = _column("nominal, a fault, or what the robots see")
    observer: str = _column("name of the observer")
    vehicle: str = _column("name of the vehicle")
    position_rmse_m: float = _column("root of the mean over seeds of the squared position error in the steady state, m")
    position_rmse_se_m: float = _column("standard error of position_rmse_m over the seeds, m")
    orientation_rmse_deg: float = _column("the same of the geodesic angle between true and estimated orientation, deg")
    orientation_rmse_se_deg: float = _column("standard error of orientation_rmse_deg over the seeds, deg")
    bound_m: float = _column("posterior Cramér-Rao bound of the position, joint over all vehicles, m")
    anees: float = _column("mean NEES in the steady state divided by its dimension; 1 for an honest covariance")
    anees_se: float = _column("standard error of anees over the seeds")
    settled_fraction: float = _column(f"share of seeds whose errors stay below {SETTLED.text} to the end")
    settle_time_s: float = _column("median over these seeds of the time from which on they do, s")
    bytes_per_s: float = _column("payload that the vehicle broadcasts, bytes per second")
    us_per_update: float = _column("median time of an update with its message, microseconds; depends on the machine")
    failure: str = _column("first vehicle that failed, when and why; empty without a failure")
    bound_ancestors_m: float = _column("the bound joint over the vehicle and all whose messages can reach it, m")
    bound_single_m: float = _column("the bound of the vehicle alone, as if its neighbours' poses were known, m")
    ratio_to_bound: float = _column("position_rmse_m / bound_m")
    ratio_to_bound_se: float = _column("standard error of ratio_to_bound, the bound taken as exact")
    ratio_to_bound_ancestors: float = _column("position_rmse_m / bound_ancestors_m")
    ratio_to_bound_ancestors_se: float = _column("standard error of ratio_to_bound_ancestors, the bound taken as exact")
    degradation: float = _column("position_rmse_m over that of the nominal variant")
    degradation_se: float = _column("standard error of degradation, seed against seed")
    position_rmse_median_m: float = _column("median over seeds of each run's RMSE, m")
    position_rmse_p90_m: float = _column("90 % quantile over seeds of each run's RMSE, m")
    converged_fraction: float = _column(f"share of seeds whose errors stay below {CONVERGED.text} to the end")
    convergence_time_s: float = _column("median over these seeds of the time from which on they do, s")
    convergence_rate_per_s: float = _column(
        "median over seeds of the Theil-Sen slope of -log of the error's descent, 1/s"
    )
    diverged_fraction: float = _column(
        f"share of seeds that end above {DIVERGED_POSITION:g} m or {DIVERGED_ORIENTATION:g} deg, or that failed"
    )
    ate_m: float = _column("absolute trajectory error over the whole run (evo's APE, nothing aligned), m")
    rpe_m: float = _column(f"relative trajectory error (evo's RPE) over {RELATIVE_DELTA:g} s, m")
    rpe_deg: float = _column(f"its angle over {RELATIVE_DELTA:g} s, deg")
    nis: float = _column("mean NIS in the steady state divided by its degrees of freedom; 1 for a consistent filter")
    anees_low: float = _column(
        f"with anees_high: where that of an honest filter lies in {LEVEL:.0%} of all instants, for as many runs "
        "(chi-square); the mean over time lies closer to 1"
    )
    anees_high: float = _column("see anees_low")
    nis_low: float = _column(
        f"with nis_high: where that of a consistent filter lies with a probability of {LEVEL:.0%} (chi-square)"
    )
    nis_high: float = _column("see nis_low")
    gramian_min_eigenvalue: float = _column(
        "smallest eigenvalue over the run of the observability Gramian over 1 s, about the map origin; mixed units"
    )
    gramian_local_eigenvalue: float = _column("the same about the vehicle, in units of the targets' range; no unit")


class Measured(NamedTuple):
    """A figure and its standard error over the seeds; NaN where there is one seed."""

    value: float
    error: float


UNKNOWN = Measured(float("nan"), float("nan"))


def mean_root(squares: Array) -> Measured:
    """Return the mean over vehicles of the root of the mean over seeds, of mean squares (S, N).

    Vehicles of one seed may depend on one another.
    """
    value, each = _linearised(squares)
    return Measured(value, standard_error(each))


def ratio(squares: Array, reference: Array) -> Measured:
    """Return `mean_root(squares)` over `mean_root(reference)`, both (S, N) of the same seeds: errors partly cancel."""
    (above, each_above), (below, each_below) = _linearised(squares), _linearised(reference)
    if not below > 0.0:
        return UNKNOWN
    value = above / below
    return Measured(value, value * standard_error(each_above / above - each_below / below) if above else 0.0)


def standard_error(values: Array) -> float:
    """Return the standard error of the mean of (S,) independent values, NaN of a single one."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def _linearised(squares: Array) -> tuple[float, Array]:
    """Return the mean root, and (S,) each seed's share in it: r = sqrt(m), dr = dm / (2 r)."""
    roots = np.sqrt(squares.mean(axis=0))
    return float(roots.mean()), (squares / np.where(roots > 0, 2.0 * roots, 1.0)).mean(axis=1)


NOWHERE = Interval(float("nan"), float("nan"))


class Total(NamedTuple):
    """One observer in one variant, over all vehicles and seeds; NaN where a run failed."""

    rmse: Measured
    """Position RMSE, m, its mean over the vehicles."""
    degradation: Measured
    """`rmse` over that of the nominal variant; NaN without one."""


def grouped(samples: Sequence[Sample]) -> dict[tuple[str, str], list[Sample]]:
    """Return samples, which stand by variant and observer, by these."""
    return {key: list(own) for key, own in groupby(samples, lambda sample: (sample.variant, sample.observer))}


def mean_of(rows: Sequence[Row], column: str) -> float:
    """Return the mean of a column."""
    return float(np.mean([getattr(row, column) for row in rows]))


def rows_of(environment: str, samples: Sequence[Sample]) -> list[Row]:
    """Sum up samples over seeds, in the order of variants and observers in which they come."""
    groups = grouped(samples)
    return [
        _row(environment, i, own, groups.get((NOMINAL, observer), []))
        for (_, observer), own in groups.items()
        for i in range(len(own[0].scene.vehicles))
    ]


def totals_of(samples: Sequence[Sample]) -> dict[tuple[str, str], Total]:
    """Sum up samples over seeds and vehicles, by variant and observer."""
    groups = grouped(samples)
    return {key: _total(own, groups.get((NOMINAL, key[1]), [])) for key, own in groups.items()}


def _total(own: Sequence[Sample], nominal: Sequence[Sample], vehicles: slice = slice(None)) -> Total:
    squares, reference = (np.array([s.measured("position_mse", vehicles) for s in some]) for some in (own, nominal))
    return Total(mean_root(squares), ratio(squares, reference) if nominal else UNKNOWN)


def _row(environment: str, i: int, own: Sequence[Sample], nominal: Sequence[Sample]) -> Row:
    def over_seeds(name: str) -> Array:
        return np.array([sample.measured(name, i) for sample in own], float)

    def bound(name: str) -> float:
        return float(np.sqrt(np.mean([getattr(sample.scene, name)[i] for sample in own])))

    position, degradation = _total(own, nominal, slice(i, i + 1))
    orientation = mean_root(over_seeds("orientation_mse")[:, None])
    each, dof = np.sqrt(over_seeds("position_mse")), over_seeds("nis_dof").sum()
    settle, converge = over_seeds("settle_time"), over_seeds("converge_time")
    joint, family = bound("bound_mse"), bound("bound_ancestors_mse")
    anees = over_seeds("anees")
    honest = mean_bounds(own[0].nees_dof, len(own)) if np.isfinite(anees).all() else NOWHERE
    consistent = mean_bounds(int(dof)) if dof > 0 else NOWHERE
    return Row(
        environment=environment,
        variant=own[0].variant,
        observer=own[0].observer,
        vehicle=own[0].scene.vehicles[i],
        position_rmse_m=position.value,
        position_rmse_se_m=position.error,
        orientation_rmse_deg=orientation.value,
        orientation_rmse_se_deg=orientation.error,
        bound_m=joint,
        anees=float(np.mean(anees)),
        anees_se=standard_error(anees),
        settled_fraction=float(np.mean(np.isfinite(settle))),
        settle_time_s=_median(settle),
        bytes_per_s=float(np.mean([sample.bytes_per_s[i] for sample in own])),
        us_per_update=_median(np.array([sample.us_per_update[i] for sample in own])),
        failure=next((sample.failure for sample in own if sample.failure), ""),
        bound_ancestors_m=family,
        bound_single_m=bound("bound_single_mse"),
        ratio_to_bound=position.value / joint,
        ratio_to_bound_se=position.error / joint,
        ratio_to_bound_ancestors=position.value / family,
        ratio_to_bound_ancestors_se=position.error / family,
        degradation=degradation.value,
        degradation_se=degradation.error,
        position_rmse_median_m=float(np.quantile(each, 0.5)),
        position_rmse_p90_m=float(np.quantile(each, 0.9)),
        converged_fraction=float(np.mean(np.isfinite(converge))),
        convergence_time_s=_median(converge),
        convergence_rate_per_s=_median(over_seeds("rate")),
        diverged_fraction=float(np.mean(over_seeds("diverged"))),
        ate_m=float(np.sqrt(np.mean(over_seeds("ate") ** 2))),
        rpe_m=float(np.sqrt(np.mean(over_seeds("rpe") ** 2))),
        rpe_deg=float(np.sqrt(np.mean(over_seeds("rpe_orientation") ** 2))),
        nis=float(over_seeds("nis").sum() / dof) if dof > 0 else float("nan"),
        anees_low=honest.low,
        anees_high=honest.high,
        nis_low=consistent.low,
        nis_high=consistent.high,
        gramian_min_eigenvalue=float(np.min([sample.scene.gramian[i] for sample in own])),
        gramian_local_eigenvalue=float(np.min([sample.scene.gramian_local[i] for sample in own])),
    )


def _median(values: Array) -> float:
    """Return the median of what is finite, NaN where nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


EDGES = (5.0, 10.0, 20.0, 35.0)
"""s; starts of up to 10 deg and 1 m are found within the first of these windows by the best observers."""

MOST_EDGES = 20
EXPECTED = f"expected 2 to {MOST_EDGES} increasing times in s, such as 5,10,20,35, or none"


def checked_edges(given: Iterable[float] | str) -> tuple[float, ...]:
    """Return the edges of windows, s, from numbers or a text with commas between; none where there are to be none.

    Raises:
        CoopenvError: they are not increasing times.
    """
    words = [] if given in ("", "none") else given.split(",") if isinstance(given, str) else list(given)
    text = given if isinstance(given, str) else ",".join(map(str, words))
    try:
        edges = tuple(float(word) for word in words)
    except (TypeError, ValueError):
        raise CoopenvError(f"--windows {shown(text)}: {EXPECTED}") from None
    times = all(0.0 <= edge < math.inf for edge in edges) and all(b > a for a, b in pairwise(edges))
    if not times or len(edges) == 1 or len(edges) > MOST_EDGES:
        raise CoopenvError(f"--windows {shown(text)}: {EXPECTED}")
    return edges


@dataclass(frozen=True)
class WindowRow:
    """One observer, one vehicle, one variant, one stretch of time; NaN where there is no such figure."""

    environment: str
    variant: str
    observer: str
    vehicle: str
    window: str
    """For example `5-10 s`, or `steady`."""
    from_s: float
    to_s: float
    position_rmse_m: float
    position_rmse_se_m: float
    bound_ancestors_m: float
    ratio_to_bound_ancestors: float
    ratio_to_bound_ancestors_se: float
    anees: float
    anees_se: float


ERRORS = {
    "position_rmse_m": "position_rmse_se_m",
    "ratio_to_bound_ancestors": "ratio_to_bound_ancestors_se",
    "anees": "anees_se",
}
"""Column to that of its standard error."""


class Spread(NamedTuple):
    """A figure over all vehicles: its median, and the worst with its standard error and vehicle."""

    median: float
    worst: float
    error: float
    vehicle: str


def spread(rows: Sequence[WindowRow], column: str) -> Spread:
    """Return the median over vehicles of a column, and its worst: the largest, or of ANEES the farthest from 1."""
    values = np.array([getattr(row, column) for row in rows], float)
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return Spread(math.nan, math.nan, math.nan, "")
    off = np.abs(np.log(np.maximum(values[known], 1e-300))) if column == "anees" else values[known]
    worst = rows[int(known[np.argmax(off)])]
    error = getattr(worst, ERRORS[column])
    return Spread(float(np.median(values[known])), float(getattr(worst, column)), float(error), worst.vehicle)


def window_rows(environment: str, samples: Sequence[Sample]) -> list[WindowRow]:
    """Sum up samples over seeds, in the order of variants and observers in which they come."""
    return [
        _window_row(environment, own, i, w)
        for own in grouped(samples).values()
        for w in range(len(own[0].scene.windows))
        for i in range(len(own[0].scene.vehicles))
    ]


def _window_row(environment: str, own: Sequence[Sample], i: int, w: int) -> WindowRow:
    def over_seeds(name: str) -> Array:
        return np.array([sample.in_windows(name)[i, w] for sample in own], float)

    window: Window = own[0].scene.windows[w]
    position, anees = mean_root(over_seeds("window_mse")[:, None]), over_seeds("window_anees")
    bound = math.sqrt(np.mean([sample.scene.window_bound_mse[i, w] for sample in own]))
    figures: dict[str, Any] = {
        "position_rmse_m": position.value,
        "position_rmse_se_m": position.error,
        "bound_ancestors_m": bound,
        "ratio_to_bound_ancestors": position.value / bound if bound > 0.0 else math.nan,
        "ratio_to_bound_ancestors_se": position.error / bound if bound > 0.0 else math.nan,
        "anees": float(np.mean(anees)),
        "anees_se": standard_error(anees),
    }
    who = (environment, own[0].variant, own[0].observer, own[0].scene.vehicles[i])
    return WindowRow(*who, window.name, window.start, window.end, **figures)


FAILED = "failed"

_NAMED = 16  # characters of an observer's name on one line


def short_name(name: str) -> str:
    """Return an observer's name, on two lines if it is long."""
    cut = name.rfind("_", 0, _NAMED) + 1 if len(name) > _NAMED else 0
    return f"{name[:cut]}\n{name[cut:]}" if cut else name


def compact(value: float, error: float) -> str:
    """Return a number with its standard error in parentheses; without it where so many digits would not fit."""
    return in_parentheses(value, error) if 1e-3 <= abs(value) < 1e4 else number(value, 2)
