"""The last guard of a covariance: a factor on what is stated and broadcast, from the means of innovations over seconds.

A filter averages noise that it takes for white. Latency, a map's errors or noise that is correlated in time stay in the
mean: each innovation is as large as stated, and their mean is not. So innovations of a source, used and refused ones,
are added up over blocks of time. The sum of n white ones, each over its standard deviation, has the variance n. Of an
innovation to another vehicle only the sensor's share of the variance is white, because the vehicle's error stays; with
shares w, the variance of the sum is at most v = sum(w) + (sum(sqrt(1 - w)))^2: the frames of a block count as few.

The squared sums over their variances are added up over `WINDOW` and over the sources. In every block the source with
the largest one is left out: one source may be faulty, which gates and monitors find. If the ratio of the total to its
expectation fails a chi-square test, it is the factor; otherwise the factor is 1. A block has as many degrees of freedom
as rows, times sum(w) / v, because an error that lasts is the same in the next block. The gain keeps the covariance as
it is: the guard does not know which assumption fails.

Source of the quantile: Wilson and Hilferty, The distribution of chi-square, Proceedings of the National Academy of
Sciences 17(12), 1931.
"""

import math

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import MOST_ROWS

LENGTHS = (1.0, 4.0)  # s, of blocks
WINDOW = 10.0  # s: time constant of the totals
MOST_DEVIATIONS = 3.29  # to which innovations are limited: one of a thousand is larger
NORMAL_QUANTILE = 4.75  # that a normal variable exceeds with a probability of 1e-6
LATENCY = 0.03
"""s, of frames, that a protection level includes although no noise declares it: two periods of a camera of 60 Hz."""
UNKNOWN = 4.0
"""Factor from which on a protection level is unknown: the stated deviations are half of what innovations show."""


def largest_total(freedom: float) -> float:
    """Return the quantile of a chi-square distribution that is exceeded with a probability of 1e-6."""
    variance = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - variance + NORMAL_QUANTILE * math.sqrt(variance)) ** 3)


def share_without_largest(count: int) -> float:
    """Return the expected sum of all but the largest of squared sums of two rows, over that of all; 1 of a single one.

    Their distribution is exponential, and the largest of n is 1 + 1/2 + ... + 1/n times their mean.
    """
    return 1.0 - sum(1.0 / n for n in range(1, count + 1)) / count if count > 1 else 1.0


class Guard:
    """The guard of one vehicle."""

    def __init__(self) -> None:
        self.factor = 1.0  # on covariances that are stated and broadcast
        self.slots: dict[int, int] = {}  # by target
        self.sums = np.zeros((len(LENGTHS), 0, 3, MOST_ROWS))
        self.begin = np.zeros(len(LENGTHS))  # s, of the blocks
        self.totals = np.zeros((len(LENGTHS), 3))  # of squared sums, of their expectations, and of degrees of freedom

    def add(self, time: float, targets: NDArray[np.int64], innovations: Array, lasting: NDArray[np.bool_]) -> None:
        """Add the innovations of a frame, and end the blocks that are complete.

        Args:
            time: s.
            targets: (m,) the sources.
            innovations: (m, 3, r) of rows over their standard deviations; shares of the sensor in the variances; roots
                of the other shares. 0 where nothing was measured.
            lasting: (m,) whether the other shares last, because the target is uncertain.
        """
        for length, begin in enumerate(self.begin.tolist()):
            if time - begin >= LENGTHS[length]:
                self.end_block(length, time)
        slots = [self.slots.setdefault(target, len(self.slots)) for target in targets.tolist()]
        if len(self.slots) > self.sums.shape[1]:
            more = len(self.slots) - self.sums.shape[1]
            self.sums = np.pad(self.sums, ((0, 0), (0, more), (0, 0), (0, 0)))
        innovations[~lasting, 1] = innovations[~lasting, 1] > 0.0
        innovations[~lasting, 2] = 0.0
        np.add.at(self.sums, (slice(None), slots, slice(None), slice(innovations.shape[2])), innovations)

    def end_block(self, length: int, time: float) -> None:
        """Add a block to its totals, and set the factor."""
        innovations, white, lasting = self.sums[length].swapaxes(0, 1)
        variance = white + lasting**2
        measured = variance > 0.0
        variance[~measured] = 1.0
        squared, rows = np.sum(innovations**2 / variance, axis=1), measured.sum(axis=1)
        count = int(np.count_nonzero(rows))
        total = squared.sum() - (squared.max() if count > 1 else 0.0)
        added = share_without_largest(count) * np.array([rows.sum(), (white / variance).sum()])
        kept = math.exp(-(time - self.begin[length]) / WINDOW)
        self.totals[length] = kept * self.totals[length] + [total, *added]
        self.sums[length], self.begin[length] = 0.0, time
        self.factor = max(1.0, *(factor_of(*totals) for totals in self.totals.tolist()))


def factor_of(total: float, expected: float, freedom: float) -> float:
    """Return the ratio of a total to its expectation if the chi-square test of that ratio fails, else 1."""
    freedom = max(freedom, 2.0)
    return total / expected if total * freedom > expected * largest_total(freedom) else 1.0
