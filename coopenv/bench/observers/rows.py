"""The leaderboard's rows: one observer, one vehicle, one variant, one stretch of time, summed up over all seeds.

Errors are held against the bound of the same stretch, so that a slow start counts where measurements allow a quick one.
Standard errors are over the seeds; those of root mean squares to first order (delta method), the bound taken as exact.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.bench.observers.convergence import Basin, Draw, basins_of
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.judge import RELATIVE_DELTA, START, JudgedRun, TimeWindow
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


class Measured(NamedTuple):
    """A figure and its standard error over the seeds; NaN where there is one seed."""

    value: float
    error: float

    def over(self, known: float) -> "Measured":
        """Return the ratio to a number that has no error; NaN where the number is none above 0."""
        return Measured(self.value / known, self.error / known) if known > 0.0 else UNKNOWN


UNKNOWN = Measured(math.nan, math.nan)
NOWHERE = Interval(math.nan, math.nan)


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
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else math.nan


def _linearised(squares: Array) -> tuple[float, Array]:
    """Return the mean root, and (S,) each seed's share in it: r = sqrt(m), dr = dm / (2 r)."""
    roots = np.sqrt(squares.mean(axis=0))
    return float(roots.mean()), (squares / np.where(roots > 0, 2.0 * roots, 1.0)).mean(axis=1)


class Total(NamedTuple):
    """One observer in one variant, over all vehicles and seeds; NaN where a run failed."""

    rmse: Measured
    """Position RMSE, m, its mean over the vehicles."""
    degradation: Measured
    """`rmse` over that of the nominal variant; NaN without one."""


def total(own: Sequence[JudgedRun], nominal: Sequence[JudgedRun], vehicles: Any = slice(None), w: int = -1) -> Total:
    """Sum up samples of the same seeds over vehicles, in the window `w`; without samples `nominal` nothing degrades."""
    squares, reference = (np.array([s.measured("position_mse")[vehicles, w] for s in some]) for some in (own, nominal))
    return Total(mean_root(squares), ratio(squares, reference) if nominal else UNKNOWN)


def _column(meaning: str) -> Any:
    """Declare a column with its meaning, which the report prints."""
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
    anees: float = _column("mean NEES in the steady state divided by its dimension; 1: consistent, more: overconfident")
    anees_se: float = _column("standard error of anees over the seeds")
    settled_fraction: float = _column(f"share of seeds whose errors stay below {SETTLED.text} to the end")
    settle_time_s: float = _column("median over these seeds of the time at which that begins, s")
    bytes_per_s: float = _column("payload that the vehicle broadcasts, bytes per second")
    us_per_update: float = _column("median time of an update with its message, microseconds; depends on the machine")
    failure: str = _column("first vehicle that failed, when and why; empty without a failure")
    bound_ancestors_m: float = _column("the bound joint over the vehicle and all whose messages can reach it, m")
    bound_neighbours_known_m: float = _column("the bound of the vehicle with the poses of its neighbours given, m")
    ratio_to_bound: float = _column("position_rmse_m / bound_m")
    ratio_to_bound_se: float = _column("standard error of ratio_to_bound, the bound taken as exact")
    ratio_to_bound_ancestors: float = _column("position_rmse_m / bound_ancestors_m")
    ratio_to_bound_ancestors_se: float = _column("standard error of ratio_to_bound_ancestors, the bound taken as exact")
    degradation: float = _column("position_rmse_m over that of the nominal variant")
    degradation_se: float = _column("standard error of degradation, seed against seed")
    position_rmse_median_m: float = _column("median over seeds of each run's RMSE, m")
    position_rmse_p90_m: float = _column("90 % quantile over seeds of each run's RMSE, m")
    converged_fraction: float = _column(f"share of seeds whose errors stay below {CONVERGED.text} to the end")
    convergence_time_s: float = _column("median over these seeds of the time at which that begins, s")
    convergence_rate_per_s: float = _column(
        "median over seeds of the Theil-Sen slope of -log of the error's descent, 1/s"
    )
    diverged_fraction: float = _column(
        f"share of seeds in which the errors never get below {DIVERGED_POSITION:g} m and {DIVERGED_ORIENTATION:g} deg, "
        "or exceed one of them again, and of those that failed"
    )
    worst_after_start_m: float = _column(
        f"largest position error of all seeds after {START:g} s, or above the first error, m"
    )
    verdict: str = _column("consistent, overconfident or underconfident by anees_low and anees_high; or no covariance")
    finding: str = _column("mistakes of the observer in the first seed of the first variant, such as a wrong frame")
    ate_m: float = _column("absolute trajectory error over the whole run (evo's APE, nothing aligned), m")
    rpe_m: float = _column(f"relative trajectory error (evo's RPE) over {RELATIVE_DELTA:g} s, m")
    rpe_deg: float = _column(f"its angle over {RELATIVE_DELTA:g} s, deg")
    nis: float = _column("mean NIS in the steady state divided by its degrees of freedom; 1 for a consistent filter")
    anees_low: float = _column(
        f"with anees_high: where that of a consistent filter lies in {LEVEL:.0%} of all instants, for as many runs "
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
    level_exceeded_fraction: float = _column(
        "share of the run's ticks in which the horizontal error exceeds the protection level; empty: none is stated"
    )
    angle_level_exceeded_fraction: float = _column("the same of the angle")
    level_unknown_fraction: float = _column("share of the run's ticks in which the protection level is infinite")
    level_over_e95: float = _column(
        "median over seeds of each run's median known protection level over the 95 % quantile of the horizontal error"
    )


ERRORS = {
    "position_rmse_m": "position_rmse_se_m",
    "orientation_rmse_deg": "orientation_rmse_se_deg",
    "anees": "anees_se",
    "ratio_to_bound": "ratio_to_bound_se",
    "ratio_to_bound_ancestors": "ratio_to_bound_ancestors_se",
    "degradation": "degradation_se",
}
"""Column to that of its standard error."""

BOUNDS = {
    "bound_m": "bound (joint)",
    "bound_ancestors_m": "bound (ancestors)",
    "bound_neighbours_known_m": "neighbours known",
}
"""Column to its line in tables."""


def row_of(
    environment: str, own: Sequence[JudgedRun], nominal: Sequence[JudgedRun], i: int, w: int = -1, runs: int = 1
) -> Row:
    """Sum up samples of one observer in one variant over seeds, of vehicle `i` in window `w` (-1: the steady state).

    `runs` is how many of them are independent, for the bounds of consistency.

    Columns that no `WindowRow` has are of the steady state or the whole run in any window.
    """

    def seeds(name: str) -> Array:
        values = np.array([sample.measured(name)[i] for sample in own], float)
        return values[:, w] if values.ndim > 1 else values

    def root(name: str) -> float:
        return float(np.sqrt(np.mean(seeds(name) ** 2)))

    position, anees, dof = total(own, nominal, slice(i, i + 1), w), seeds("anees"), seeds("nis_dof").sum()
    bounds = [float(np.sqrt(np.mean([sample.scene.bounds[kind, i, w] for sample in own]))) for kind in range(3)]
    measured = {
        "position_rmse_m": position.rmse,
        "orientation_rmse_deg": mean_root(seeds("orientation_mse")[:, None]),
        "anees": Measured(float(np.mean(anees)), standard_error(anees)),
        "ratio_to_bound": position.rmse.over(bounds[0]),
        "ratio_to_bound_ancestors": position.rmse.over(bounds[1]),
        "degradation": position.degradation,
    }
    each = np.sqrt(seeds("position_mse"))
    honest = mean_bounds(own[0].nees_dof, runs) if np.isfinite(anees).all() else NOWHERE
    freedom = dof * runs // len(own)
    consistent = mean_bounds(int(freedom)) if freedom > 0 else NOWHERE
    return Row(
        environment=environment,
        variant=own[0].variant,
        observer=own[0].observer,
        vehicle=own[0].scene.vehicles[i],
        **{column: figure.value for column, figure in measured.items()},
        **{ERRORS[column]: figure.error for column, figure in measured.items()},
        **dict(zip(BOUNDS, bounds, strict=True)),
        settled_fraction=float(np.mean(np.isfinite(seeds("settle_time")))),
        settle_time_s=median_of(seeds("settle_time")),
        bytes_per_s=float(np.mean(seeds("bytes_per_s"))),
        us_per_update=median_of(seeds("us_per_update")),
        failure=next((sample.failure for sample in own if sample.failure), ""),
        position_rmse_median_m=float(np.quantile(each, 0.5)),
        position_rmse_p90_m=float(np.quantile(each, 0.9)),
        converged_fraction=float(np.mean(np.isfinite(seeds("converge_time")))),
        convergence_time_s=median_of(seeds("converge_time")),
        convergence_rate_per_s=median_of(seeds("rate")),
        diverged_fraction=float(np.mean(seeds("diverged"))),
        worst_after_start_m=float(np.max(seeds("worst"))),
        verdict="" if any(sample.failure for sample in own) else verdict_of(float(np.mean(anees)), honest),
        finding=", ".join(own[0].findings),
        ate_m=root("ate"),
        rpe_m=root("rpe"),
        rpe_deg=root("rpe_orientation"),
        nis=float(seeds("nis").sum() / dof) if dof > 0 else math.nan,
        anees_low=honest.low,
        anees_high=honest.high,
        nis_low=consistent.low,
        nis_high=consistent.high,
        gramian_min_eigenvalue=float(np.min([sample.scene.gramians[0, i] for sample in own])),
        gramian_local_eigenvalue=float(np.min([sample.scene.gramians[1, i] for sample in own])),
        level_exceeded_fraction=float(np.mean(seeds("level_exceeded"))),
        angle_level_exceeded_fraction=float(np.mean(seeds("angle_level_exceeded"))),
        level_unknown_fraction=float(np.mean(seeds("level_unknown"))),
        level_over_e95=median_of(seeds("level_over_e95")),
    )


def median_of(values: Iterable[float | None]) -> float:
    """Return the median of what is finite, NaN where nothing is."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


@dataclass(frozen=True)
class WindowRow:
    """One observer, one vehicle, one variant, one stretch of time; NaN where there is no such figure."""

    environment: str
    variant: str
    observer: str
    vehicle: str
    window: str
    """Name of the window, for example `5-10 s` or `steady`."""
    from_s: float
    to_s: float
    position_rmse_m: float
    position_rmse_se_m: float
    bound_ancestors_m: float
    ratio_to_bound_ancestors: float
    ratio_to_bound_ancestors_se: float
    anees: float
    anees_se: float


def window_row_of(environment: str, own: Sequence[JudgedRun], i: int, w: int) -> WindowRow:
    """Sum up samples of one observer in one variant over seeds: vehicle `i` in window `w`."""
    window = own[0].scene.windows[w]
    known = vars(row_of(environment, own, (), i, w)) | {
        "window": window.name,
        "from_s": window.start,
        "to_s": window.end,
    }
    return WindowRow(**{column.name: known[column.name] for column in fields(WindowRow)})


NO_COVARIANCE, CONSISTENT, OVERCONFIDENT, UNDERCONFIDENT = VERDICTS = (
    "no covariance",
    "consistent",
    "overconfident",
    "underconfident",
)


def verdict_of(anees: float, consistent: Interval) -> str:
    """Return the verdict on a covariance by its ANEES and the interval of a consistent filter; NaN: none is stated."""
    if math.isnan(anees):
        return NO_COVARIANCE
    return OVERCONFIDENT if anees > consistent.high else UNDERCONFIDENT if anees < consistent.low else CONSISTENT


def verdict_on(rows: Sequence[Row]) -> str:
    """Return the worst verdict on an observer's vehicles, and of how many: an overconfident one comes first."""
    found = [row.verdict for row in rows]
    worst = next((word for word in (OVERCONFIDENT, UNDERCONFIDENT, NO_COVARIANCE) if word in found), CONSISTENT)
    return worst if len(set(found)) == 1 else f"{worst} {found.count(worst)}/{len(found)}"


class Spread(NamedTuple):
    """A figure over all vehicles: its median, and the worst with its standard error and vehicle."""

    median: float
    worst: float
    error: float
    vehicle: str


def spread(rows: Sequence[Row] | Sequence[WindowRow], column: str) -> Spread:
    """Return the median over vehicles of a column, and its worst: the largest, or of ANEES the farthest from 1."""
    values = np.array([getattr(row, column) for row in rows], float)
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return Spread(math.nan, math.nan, math.nan, "")
    off = np.abs(np.log(np.maximum(values[known], 1e-300))) if column == "anees" else values[known]
    worst = rows[int(known[np.argmax(off)])]
    error = getattr(worst, ERRORS[column])
    return Spread(float(np.median(values[known])), float(getattr(worst, column)), float(error), worst.vehicle)


@dataclass(frozen=True, eq=False)
class Leaderboard:
    """Results of observers on the same records, summed up over seeds."""

    environment: str
    """Name of the environment, dataset or log file."""
    observers: tuple[str, ...]
    variants: Mapping[str, str]
    """The variants that were run, with a description each."""
    seeds: tuple[int, ...]
    samples: Sequence[JudgedRun] = field(repr=False)
    """One observer on one record each, by variant, observer, seed."""
    recorded: bool = False
    """True if all seeds have the same recording and draw the initial estimates only."""
    draws: Sequence[Draw] = field(default=(), repr=False)
    """Draws of initial estimates, by observer, where basins were studied."""
    sensor_sets: tuple[str, ...] = ()
    """Variants in which some sensors alone measure."""

    @property
    def sampled(self) -> str:
        """Sample of the standard errors."""
        return "drawn starts of one recording" if self.recorded else "seeds"

    @property
    def runs(self) -> int:
        """Number of independent records."""
        return 1 if self.recorded else len(self.seeds)

    @cached_property
    def groups(self) -> dict[tuple[str, str], list[JudgedRun]]:
        """The samples of all seeds, by variant and observer."""
        return {key: list(own) for key, own in groupby(self.samples, lambda sample: (sample.variant, sample.observer))}

    @cached_property
    def rows(self) -> list[Row]:
        """One row per variant, observer and vehicle."""
        return [
            row_of(self.environment, own, self.groups.get((NOMINAL, observer), []), i, runs=self.runs)
            for (_, observer), own in self.groups.items()
            for i in range(len(self.vehicles))
        ]

    @cached_property
    def window_rows(self) -> list[WindowRow]:
        """One row per variant, observer, window and vehicle; the last window is the steady state."""
        return [
            window_row_of(self.environment, own, i, w)
            for own in self.groups.values()
            for w in range(len(self.windows))
            for i in range(len(self.vehicles))
        ]

    @cached_property
    def totals(self) -> dict[tuple[str, str], Total]:
        """Over all vehicles, by variant and observer."""
        return {key: total(own, self.groups.get((NOMINAL, key[1]), [])) for key, own in self.groups.items()}

    @cached_property
    def basins(self) -> list[Basin]:
        """The draws summed up, one per observer."""
        return basins_of(self.environment, self.draws)

    @cached_property
    def ranked(self) -> list[str]:
        """The observers by their error in the first variant, failed ones last."""
        first = next(iter(self.variants))
        error = {name: self.totals[first, name].rmse.value for name in self.observers}
        return sorted(self.observers, key=lambda name: (error[name] != error[name], error[name]))

    @property
    def title(self) -> str:
        """Title of the comparison, on one line."""
        first, last = self.seeds[0], self.seeds[-1]
        whole = len(self.seeds) > 1 and self.seeds == tuple(range(first, last + 1))
        seeds = f"{first} to {last}" if whole else ", ".join(map(str, self.seeds))
        return f"{self.environment}, seed{'s' if len(self.seeds) > 1 else ''} {seeds}"

    def rows_in(self, variant: str, observer: str) -> list[Row]:
        """Return the rows of one observer in one variant, a vehicle each."""
        return [row for row in self.rows if (row.variant, row.observer) == (variant, observer)]

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Names of the vehicles."""
        return self.samples[0].scene.vehicles

    @property
    def windows(self) -> tuple[TimeWindow, ...]:
        """The stretches of the run that are judged one by one, the steady state last."""
        return self.samples[0].scene.windows

    def windows_in(self, variant: str, observer: str, window: TimeWindow) -> list[WindowRow]:
        """Return the rows of one observer in one variant and window, a vehicle each."""
        wanted = (variant, observer, window.name)
        return [row for row in self.window_rows if (row.variant, row.observer, row.window) == wanted]

    def bounds_in(self, variant: str) -> dict[str, list[float]]:
        """Return the bounds that are known of each vehicle in a variant, by column."""
        first = self.rows_in(variant, self.observers[0])
        found = {column: [float(getattr(row, column)) for row in first] for column in BOUNDS}
        return {column: values for column, values in found.items() if np.isfinite(values).all()}

    def samples_in(self, variant: str) -> dict[str, list[JudgedRun]]:
        """Return the samples of one variant of every observer that did not fail, the best first."""
        own = {name: self.groups[variant, name] for name in self.ranked}
        return {name: samples for name, samples in own.items() if not any(sample.failure for sample in samples)}


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
