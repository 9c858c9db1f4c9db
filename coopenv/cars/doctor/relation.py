"""The relation of two streams that measure the same motion: a factor with its standard error, and what it explains.

Changes over intervals are compared, so that noise averages out and an offset between the streams costs little. Errors
of neighbouring intervals are dependent: scores are summed over blocks ("sandwich").
Source: White, Maximum likelihood estimation of misspecified models, Econometrica 50, 1982.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.bags.clocks import BLOCK, CUT, SampledSignal
from coopenv.estimation.poses import Array

Numbers = NDArray[Any]

INTERVAL, HOP = 1.0, 0.1
"""s over which changes are taken, and between the beginnings of two of them."""
FEWEST, MOST = 40, 600  # intervals
SIGNIFICANT = 6.0
"""Standard errors of a contradiction: 2e-9 of right streams exceed it if errors are normal, and 2e-4 if errors have the
tails of Student's t with 9 degrees of freedom, as of ten blocks (20 s)."""

GROSS = 0.5
"""Relative size of a wrong sign or unit, which a short drive shows: the least of them, 1 / 3.6, differs by 0.72."""


class Relation(NamedTuple):
    """y = factor x + offsets, of real or planar (complex) changes."""

    factor: complex
    error: float
    explained: float
    """Share of the variance of y."""
    short: bool = False
    """Whether there are fewer than two blocks for each factor, whose errors are not known."""

    def differs(self, practical: float) -> bool:
        """Return whether the factor is not 1: by more than a practical size, and than its error allows."""
        least = max(practical, GROSS) if self.short else practical
        return abs(self.factor - 1.0) > max(least, SIGNIFICANT * self.error)


def intervals(*signals: SampledSignal) -> tuple[Array, Array]:
    """Return begins and ends (n,) of intervals within all signals, s; none: they do not overlap."""
    first = max(float(signal.times[0]) for signal in signals)
    last = min(float(signal.times[-1]) for signal in signals) - INTERVAL
    begin = np.arange(first, last, max(HOP, (last - first) / MOST)) if last > first else np.zeros(0)
    return begin, begin + INTERVAL


def relation(time: Array, y: Numbers, x: Numbers, *others: Numbers) -> Relation | None:
    """Return the factor of x in y, both (n,); None: too few, or no changes of x.

    Beside it, other changes (n,) have real factors, and real ones a constant. Outliers do not count: residuals beyond
    three times their 90 % quantile.
    """
    planar = np.iscomplexobj(y)
    terms = [x, 1j * x, *others] if planar else [x, np.ones(len(x)), *others]
    there = np.isfinite(y) & np.isfinite(np.stack(terms)).all(axis=0)
    if there.sum() < FEWEST or np.ptp(x[there].real) == 0.0 == np.ptp(x[there].imag):
        return None
    time, y, columns = time[there], y[there], np.stack(terms, axis=-1)[there]
    if planar:  # real equations for both coordinates, one after the other
        time, y = np.tile(time, 2), np.concatenate([y.real, y.imag])
        columns = np.concatenate([columns.real, columns.imag])
    kept = np.ones(len(y), dtype=bool)
    for _ in range(3):
        solution = np.linalg.lstsq(columns[kept], y[kept])[0]
        rest = y - columns @ solution
        kept = np.abs(rest) <= CUT * np.quantile(np.abs(rest), 0.9) + 1e-12
    spread = (y - (0.0 if planar else y[kept].mean()))[kept]
    left = float(rest[kept] @ rest[kept]) / max(float(spread @ spread), 1e-300)
    inverse = np.linalg.pinv(columns[kept].T @ columns[kept])
    block = ((time[kept] - time[0]) / BLOCK).astype(int)
    scores = np.stack([np.bincount(block, column * rest[kept]) for column in columns[kept].T], axis=-1)
    deviations = np.sqrt(np.maximum((inverse @ scores.T @ scores @ inverse).diagonal(), 0.0))
    factor = complex(*solution[:2]) if planar else complex(solution[0])
    short = bool(time[-1] - time[0] < 2.0 * len(terms) * BLOCK)
    return Relation(factor, float(deviations[: 1 + planar].max()), 1.0 - left, short)
