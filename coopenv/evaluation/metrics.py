"""The figures by which drivers are judged, each with its interval, and the differences of two on the same worlds."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coopenv.estimation.consistency import Interval, wilson_interval
from coopenv.estimation.outcomes import Outcome
from coopenv.evaluation.bootstrap import Quantile, Ratio, Statistic, interval, resamples
from coopenv.evaluation.episodes import Episodes

COLLIDED = Outcome.COLLIDED
SETTLED_FROM = 3.0
"""s from which on errors count: before it they are those of the initial estimate."""
FEW_TARGETS = 3
"""Fewer bearings than these do not determine a pose."""


class Metric(NamedTuple):
    """One figure of a driver."""

    meaning: str
    unit: str
    of: Callable[[Episodes], Statistic]
    is_share: bool = False


def _per_vehicle(values: np.ndarray) -> Ratio:
    """Return the mean over vehicles of (W, N); NaN do not count."""
    known = np.isfinite(values)
    return Ratio(np.where(known, values, 0.0).sum(axis=1), known.sum(axis=1))


def _share(episodes: Episodes, holds: np.ndarray) -> Ratio:
    """Return the mean of something (W, N) over the vehicles that are there."""
    return _per_vehicle(np.where(episodes.present, holds, np.nan))


def _counted(episodes: Episodes, start: float) -> np.ndarray:
    """Return (K, W, N) which moments count from a time on, s."""
    return np.asarray(episodes.under_way & (episodes.time >= start - 1e-9)[:, None, None])


def _quantile(name: str, share: float, start: float) -> Callable[[Episodes], Statistic]:
    def of(episodes: Episodes) -> Statistic:
        counted = _counted(episodes, start)
        return Quantile(getattr(episodes, name)[counted], np.nonzero(counted)[1], episodes.worlds, share)

    return of


def _rmse(name: str, start: float) -> Callable[[Episodes], Statistic]:
    def of(episodes: Episodes) -> Statistic:
        counted = _counted(episodes, start)
        squares = np.where(counted, getattr(episodes, name).astype(float) ** 2, 0.0)
        return Ratio(squares.sum(axis=(0, 2)), counted.sum(axis=(0, 2)), root=True)

    return of


def _few_targets(episodes: Episodes) -> Statistic:
    counted = _counted(episodes, SETTLED_FROM)
    few = counted & (episodes.targets_in_view < FEW_TARGETS)
    return Ratio(few.sum(axis=(0, 2)), counted.sum(axis=(0, 2)))


def _errors(quantity: str, unit: str, name: str, prefix: str = "") -> dict[str, Metric]:
    """Return median, 95th percentile and root mean square of an error, from 3 s on and over whole episodes."""
    found = {}
    for when, start in (("", SETTLED_FROM), ("_episode", 0.0)):
        span = f"from {SETTLED_FROM:g} s on" if start else "over the whole episode"
        for short, share, word in (("e50", 0.5, "Median"), ("e95", 0.95, "95th percentile")):
            meaning = f"{word} of the {quantity} error {span}"
            found[f"{prefix}{short}{when}_{unit}"] = Metric(meaning, unit, _quantile(name, share, start))
        meaning = f"Root mean square of the {quantity} error {span}"
        found[f"{prefix}rmse{when}_{unit}"] = Metric(meaning, unit, _rmse(name, start))
    return found


METRICS: dict[str, Metric] = {
    "arrival_rate": Metric("Share of vehicles that arrive", "1", lambda e: _share(e, e.arrivals[-1] > 0), True),
    "collision_rate": Metric("Share of vehicles that collide", "1", lambda e: _share(e, e.outcome == COLLIDED), True),
    "travel_time_s": Metric("Time to the first arrival, over arrivals", "s", lambda e: _per_vehicle(e.travel_time)),
    **_errors("position", "m", "position_error"),
    **_errors("orientation", "deg", "orientation_error", "orientation_"),
    "few_targets_share": Metric(
        f"Share of time from {SETTLED_FROM:g} s on with fewer than {FEW_TARGETS} targets in view", "1", _few_targets
    ),
    "return": Metric("Sum of the rewards of a vehicle", "1", lambda e: _share(e, e.reward.sum(axis=0, dtype=float))),
}
"""Over vehicle-steps of vehicles under way, or over vehicles; all vehicles of all worlds together."""


@dataclass(frozen=True)
class Result:
    """A figure of a driver with its 95 % interval over worlds."""

    metric: str
    """Its name in `METRICS`, which has its unit."""
    mean: float
    """Over all worlds together."""
    ci_low: float
    """Lower end of the interval."""
    ci_high: float
    """Its upper end."""
    n: int
    """Worlds that the figure is of."""


@dataclass(frozen=True)
class Difference:
    """How much larger a figure of a driver is than that of another one on the same worlds."""

    metric: str
    """Its name in `METRICS`, which has its unit."""
    difference: float
    """This driver's figure minus the other one's."""
    ci_low: float
    """Lower end of the 95 % interval of the difference over worlds."""
    ci_high: float
    """Its upper end."""
    relative: float
    """Difference by the other one's figure; NaN where that is 0."""
    relative_ci_low: float
    """Lower end of the interval of that quotient."""
    relative_ci_high: float
    """Its upper end."""
    n: int
    """Worlds that the figures are of, the smaller number of both."""


def score(episodes: Episodes, seed: int = 0) -> list[Result]:
    """Return the figures of a driver, in the order of `METRICS`; the seed is that of the resampling."""
    counts, results = resamples(episodes.worlds, seed), []
    for name, metric in METRICS.items():
        statistic = metric.of(episodes)
        low, high = interval(statistic.resampled(counts)) if statistic.worlds > 1 else (np.nan, np.nan)
        if metric.is_share and low == high:  # nothing to resample: all worlds say the same
            low, high = _certain(statistic.value, statistic.worlds)
        results.append(Result(name, statistic.value, low, high, statistic.worlds))
    return results


def _certain(share: float, worlds: int) -> Interval:
    """Return the interval of a share that was the same in every world; vehicles of a world count as one trial."""
    low, high = wilson_interval(round(share * worlds), worlds)
    return Interval(min(low, share), max(high, share))


def compare_paired(episodes: Episodes, other: Episodes, seed: int = 0) -> list[Difference]:
    """Return by how much the figures of a driver differ from another's on the same worlds.

    Travel times are compared over the vehicles that arrive with both.
    """
    counts, found = resamples(episodes.worlds, seed), []
    both = np.isfinite(episodes.travel_time) & np.isfinite(other.travel_time)
    for name, metric in METRICS.items():
        pair: list[Statistic] = [metric.of(episodes), metric.of(other)]
        if name == "travel_time_s":
            pair = [_per_vehicle(np.where(both, e.travel_time, np.nan)) for e in (episodes, other)]
        (value, base), (drawn, drawn_base) = [s.value for s in pair], [s.resampled(counts) for s in pair]
        with np.errstate(divide="ignore", invalid="ignore"):
            change, share = drawn - drawn_base, np.where(drawn_base != 0.0, drawn / drawn_base - 1.0, np.nan)
        relative = value / base - 1.0 if base else np.nan
        n = min(s.worlds for s in pair)
        found.append(Difference(name, value - base, *interval(change), relative, *interval(share), n))
    return found
