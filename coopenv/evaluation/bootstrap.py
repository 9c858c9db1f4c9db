"""Intervals by resampling whole worlds, as vehicles and moments of one world are not independent.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13 (percentile interval); Davison and
Hinkley, Bootstrap Methods and their Application, 1997, 3.8 (resampling of clusters).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from coopenv.estimation.consistency import LEVEL, Interval

RESAMPLES = 2000
_BINS = 2000


class Statistic(Protocol):
    """A figure of many worlds that can be computed anew with each world counted several times, or not at all."""

    @property
    def value(self) -> float:
        """The figure of all worlds."""

    @property
    def worlds(self) -> int:
        """How many worlds have something to say."""

    def resampled(self, counts: np.ndarray) -> np.ndarray:
        """Return the figure, (R,), for worlds that count so often, (R, W); NaN where none says anything."""


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
        """See `Statistic`."""
        return float(self.resampled(np.ones((1, len(self.count))))[0])

    @property
    def worlds(self) -> int:
        """See `Statistic`."""
        return int(np.count_nonzero(self.count))

    def resampled(self, counts: np.ndarray) -> np.ndarray:
        """See `Statistic`."""
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (counts @ self.total) / (counts @ self.count)
        return np.asarray(np.sqrt(mean) if self.root else mean)


class Quantile:
    """A quantile of what all worlds have seen together."""

    def __init__(self, values: np.ndarray, world: np.ndarray, worlds: int, share: float, bins: int = _BINS) -> None:
        """Count values, (M,), of worlds, (M,) in 0..worlds-1, in fine bins.

        The bins hold equally many values, and a quantile is interpolated within its bin: the interval is then that of
        the values themselves but for one part in `bins` of their rank.
        """
        self._share = share
        self.value = float(np.quantile(values, share)) if len(values) else np.nan
        """See `Statistic`."""
        edges = np.quantile(values, np.linspace(0.0, 1.0, bins + 1)) if len(values) else np.zeros(2)
        self._edges = np.unique(edges)
        some = max(1, len(self._edges) - 1)
        place = np.clip(np.searchsorted(self._edges, values, side="right") - 1, 0, some - 1)
        self._seen = np.bincount(world * some + place, minlength=worlds * some).reshape(worlds, some).astype(float)

    @property
    def worlds(self) -> int:
        """See `Statistic`."""
        return int(np.count_nonzero(self._seen.any(axis=1)))

    def resampled(self, counts: np.ndarray) -> np.ndarray:
        """See `Statistic`."""
        if len(self._edges) < 2:
            return np.where(counts @ self._seen[:, 0] > 0, self.value, np.nan)
        reached = np.cumsum(counts @ self._seen, axis=1)
        wanted = self._share * reached[:, -1:]
        place = np.argmax(reached >= wanted, axis=1)[:, None]
        end = np.take_along_axis(reached, place, axis=1)
        begin = np.where(place > 0, np.take_along_axis(reached, np.maximum(place - 1, 0), axis=1), 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            inside = np.where(end > begin, (wanted - begin) / (end - begin), 0.0)
        low, high = self._edges[place], self._edges[place + 1]
        return np.asarray(np.where(reached[:, -1:] > 0, low + inside * (high - low), np.nan)[:, 0])


def resamples(worlds: int, seed: int, count: int = RESAMPLES) -> np.ndarray:
    """Return how often every world is drawn, (count, worlds), when as many as there are are drawn with replacement."""
    generator = np.random.default_rng([seed, worlds])
    return generator.multinomial(worlds, np.full(worlds, 1.0 / worlds), size=count).astype(float)


def interval(values: np.ndarray, level: float = LEVEL) -> Interval:
    """Return the percentile interval of resampled figures (R,); NaN where there are none."""
    known = values[np.isfinite(values)]
    if not len(known):
        return Interval(np.nan, np.nan)
    low, high = np.quantile(known, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return Interval(float(low), float(high))
