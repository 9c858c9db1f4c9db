"""The figures by which drivers are judged, each with its interval, and the differences of two on the same worlds.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13 (percentile interval); Davison and
Hinkley, Bootstrap Methods and their Application, 1997, 3.8 (resampling of clusters).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from coopenv.estimation import Outcome
from coopenv.estimation.metrics import LEVEL, Interval, wilson_interval
from coopenv.evaluation.episodes import Episodes
from coopenv.scenario.terms import LOST, SETTLED_FROM

RESAMPLES = 2000
_BINS = 2000


@dataclass(frozen=True)
class Ratio:
    """The sum of a quantity over worlds by the sum of another: a mean, a share, or, with `root`, a root mean square."""

    total: np.ndarray
    """(W,)."""
    count: np.ndarray
    """(W,)."""
    root: bool = False

    @property
    def value(self) -> float:
        """The figure of all worlds."""
        return float(self.resampled(np.ones((1, len(self.count))))[0])

    @property
    def worlds(self) -> int:
        """Number of worlds with a value."""
        return int(np.count_nonzero(self.count))

    def resampled(self, counts: np.ndarray) -> np.ndarray:
        """Return the figure, (R,), for multiplicities of the worlds, (R, W); NaN where none has a value."""
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (counts @ self.total) / (counts @ self.count)
        return np.asarray(np.sqrt(mean) if self.root else mean)


class Quantile:
    """A quantile over the values of all worlds together."""

    def __init__(self, values: np.ndarray, world: np.ndarray, worlds: int, share: float, bins: int = _BINS) -> None:
        """Count values, (M,), of worlds, (M,) in 0..worlds-1, in fine bins.

        The bins hold equally many values, and a quantile is interpolated within its bin: the interval is then that of
        the values themselves but for one part in `bins` of their rank.
        """
        self._share = share
        self.value = float(np.quantile(values, share)) if len(values) else np.nan
        """The figure of all worlds."""
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)) if len(values) else np.zeros(2))
        self._edges = np.append(edges, edges[-1])  # the largest value may be that of many lost vehicles: its own bin
        some = len(edges)
        place = np.clip(np.searchsorted(self._edges, values, side="right") - 1, 0, some - 1)
        self._seen = np.bincount(world * some + place, minlength=worlds * some).reshape(worlds, some).astype(float)

    @property
    def worlds(self) -> int:
        """Number of worlds with a value."""
        return int(np.count_nonzero(self._seen.any(axis=1)))

    def resampled(self, counts: np.ndarray) -> np.ndarray:
        """Return the figure, (R,), for multiplicities of the worlds, (R, W); NaN where none has a value."""
        reached = np.cumsum(counts @ self._seen, axis=1)
        wanted = self._share * reached[:, -1:]
        place = np.argmax(reached >= wanted, axis=1)[:, None]
        end = np.take_along_axis(reached, place, axis=1)
        begin = np.where(place > 0, np.take_along_axis(reached, np.maximum(place - 1, 0), axis=1), 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            inside = np.where(end > begin, (wanted - begin) / (end - begin), 0.0)
        low, high = self._edges[place], self._edges[place + 1]
        return np.asarray(np.where(reached[:, -1:] > 0, low + inside * (high - low), np.nan)[:, 0])


Statistic = Ratio | Quantile
"""A figure of many worlds that can be computed anew with each world counted several times, or not at all."""


def resamples(worlds: int, seed: int, count: int = RESAMPLES) -> np.ndarray:
    """Return the counts (count, worlds) of each world in bootstrap draws with replacement, as many draws as worlds."""
    generator = np.random.default_rng([seed, worlds])
    return generator.multinomial(worlds, np.full(worlds, 1.0 / worlds), size=count).astype(float)


def interval(values: np.ndarray) -> Interval:
    """Return the 95 % percentile interval of resampled figures (R,); NaN where there are none."""
    known = values[np.isfinite(values)]
    if not len(known):
        return Interval(np.nan, np.nan)
    low, high = np.quantile(known, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return Interval(float(low), float(high))


COLLIDED = Outcome.COLLIDED
LOSSES = 0.02
"""Step of the share of lost vehicles by which drivers are ranked before their errors."""
SCORE = 2
"""Version of e50 and e95, for files: 1, without number, left lost vehicles out."""
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


def _over_moments(counted: np.ndarray, values: np.ndarray, root: bool = False) -> Ratio:
    """Return the mean of values (K, W, N) over the moments that count."""
    return Ratio(np.where(counted, values, 0.0).sum(axis=(0, 2)), counted.sum(axis=(0, 2)), root)


def scored_errors(
    episodes: Episodes, start: float = SETTLED_FROM, vehicles: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position errors (M,) that a driver is judged by, m, and the world (M,) of each.

    They are the errors of vehicles under way, at most `LOST`, and `LOST` for the rest of the way of every lost vehicle
    (`Episodes.lost_for`).

    Args:
        episodes: the record.
        start: time from which errors count, s.
        vehicles: the driven vehicles that count.
    """
    counted = _counted(episodes, start)[..., vehicles]
    errors = np.minimum(episodes.position_error[..., vehicles][counted], LOST)
    first = int(np.ceil(start / episodes.period - 1e-6)) - 1
    early = np.maximum(first - episodes.under_way.sum(axis=0), 0)  # lost before the start
    lost = np.maximum(episodes.lost_for - early, 0)[:, vehicles].sum(axis=1)
    worlds = np.concatenate([np.nonzero(counted)[1], np.repeat(np.arange(episodes.worlds), lost)])
    return np.append(errors, np.full(lost.sum(), LOST, errors.dtype)), worlds


def _mean(start: float, episodes: Episodes) -> Statistic:
    errors, worlds = scored_errors(episodes, start)
    total = np.bincount(worlds, errors, episodes.worlds)
    return Ratio(total, np.bincount(worlds, minlength=episodes.worlds))


def _quantile(name: str, share: float, start: float, episodes: Episodes) -> Statistic:
    if name == "position_error":
        return Quantile(*scored_errors(episodes, start), episodes.worlds, share)
    counted = _counted(episodes, start)
    return Quantile(getattr(episodes, name)[counted], np.nonzero(counted)[1], episodes.worlds, share)


def _rmse(name: str, start: float, episodes: Episodes) -> Statistic:
    return _over_moments(_counted(episodes, start), getattr(episodes, name).astype(float) ** 2, root=True)


def _errors(quantity: str, unit: str, name: str, prefix: str = "") -> dict[str, Metric]:
    """Return median, 95th percentile and root mean square of an error, from 3 s on and over whole episodes."""
    found, lost = {}, f", at most {LOST:g} m, which is that of a lost vehicle" if name == "position_error" else ""
    for when, start in (("", SETTLED_FROM), ("_episode", 0.0)):
        span = f"from {SETTLED_FROM:g} s on" if start else "over the whole episode"
        for short, share, word in (("e50", 0.5, "Median"), ("e95", 0.95, "95th percentile")):
            meaning = f"{word} of the {quantity} error {span}{lost}"
            found[f"{prefix}{short}{when}_{unit}"] = Metric(meaning, unit, partial(_quantile, name, share, start))
        if lost:
            found[f"mean{when}_{unit}"] = Metric(
                f"Mean of the {quantity} error {span}{lost}", unit, partial(_mean, start)
            )
        meaning = f"Root mean square of the {quantity} error {span}"
        found[f"{prefix}rmse{when}_{unit}"] = Metric(meaning, unit, partial(_rmse, name, start))
    return found


METRICS: dict[str, Metric] = {
    "arrival_rate": Metric("Share of vehicles that arrive", "1", lambda e: _share(e, e.arrivals[-1] > 0), True),
    "collision_rate": Metric("Share of vehicles that collide", "1", lambda e: _share(e, e.outcome == COLLIDED), True),
    "travel_time_s": Metric("Time to the first arrival, over arrivals", "s", lambda e: _per_vehicle(e.travel_time)),
    **_errors("position", "m", "position_error"),
    **_errors("orientation", "deg", "orientation_error", "orientation_"),
    "few_targets_share": Metric(
        f"Share of time from {SETTLED_FROM:g} s on with fewer than {FEW_TARGETS} targets in view",
        "1",
        lambda e: _over_moments(_counted(e, SETTLED_FROM), e.targets_in_view < FEW_TARGETS),
    ),
    "return": Metric("Sum of the rewards of a vehicle", "1", lambda e: _share(e, e.reward.sum(axis=0, dtype=float))),
}
"""Over vehicle-steps of vehicles under way, or over vehicles; all vehicles of all worlds together."""


def ranking_key(figures: Mapping[str, float]) -> tuple[float, float, float]:
    """Return a key by which drivers are sorted, the best first.

    The losses come first, in steps of `LOSSES`: the share of vehicles that do not arrive, plus the share of those that
    collide. Drivers on one step are sorted by e95, and by e50 where e95 is that of lost vehicles for both.

    Args:
        figures: values of `METRICS` by name.
    """
    losses = 1.0 - figures["arrival_rate"] + figures["collision_rate"]
    e95, e50 = (float(np.nan_to_num(figures[name], nan=np.inf)) for name in ("e95_m", "e50_m"))
    return float(np.floor(losses / LOSSES + 1e-9)), e95, e50


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
    """Difference between a figure of a driver and that of a reference on the same worlds."""

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
        if metric.is_share and low == high:  # nothing to resample: all worlds agree
            # Vehicles of a world count as one trial.
            widest = wilson_interval(round(statistic.value * statistic.worlds), statistic.worlds)
            low, high = min(*widest, statistic.value), max(*widest, statistic.value)
        results.append(Result(name, statistic.value, low, high, statistic.worlds))
    return results


def compare_paired(episodes: Episodes, other: Episodes, seed: int = 0) -> list[Difference]:
    """Return the differences between the figures of two drivers on the same worlds.

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
