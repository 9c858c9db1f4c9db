"""Which bearings of a frame a filter believes: one gate for the whole zoo, on unless told otherwise.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation, 2001, section 5.4: the
normalised innovation squared r^T S^-1 r of an honest bearing has a chi-square distribution of 2 degrees of freedom. S
counts the prior, the sender's covariance where the filter uses one, and the bearing's noise. A target must also be
where the bearing points, and not behind (cheirality).

A filter that is sure of a wrong pose would refuse what contradicts it for ever. Trackers hold a track for tentative
until it has been confirmed by measurements, and give it up when they stay away (Blackman and Popoli, Design and
analysis of modern tracking systems, 1999, chapter 6). So does this gate. It opens, which means that it takes
everything, where the prior is so wide that a linearised innovation has no meaning; from there on, as from any doubt,
until the share of refused bearings, averaged over a second, is below `TENTATIVE_SHARE`; and once that has held for some
seconds, only above `LOST_SHARE`. Targets mistaken now and then, and one sender of two or more that begins to lie later,
never open it. One that lies from the start does: no gate could tell that from a wrong start.
"""

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.observers.lines import Lines, normalised

LARGEST = 13.8155  # 0.999 of a chi-square of 2: -2 log 0.001
WIDE = 0.5  # rad^2, trace of S: about 30 degrees per axis. Chosen
AVERAGING = 1.0  # s, over which the share of refused bearings is averaged. Chosen
TENTATIVE_SHARE, LOST_SHARE = 0.2, 0.6
"""One of three is enough to doubt a pose that was never confirmed, one of two not to doubt one that was. Chosen."""
CONFIRMATION = 5.0  # s of few refusals that confirm a pose. Chosen


class Gate:
    """The gate of one vehicle."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self.share = 0.0  # of refused bearings, averaged
        self.confirmed = False
        self.time = self.doubted = 0.0  # s, of the last frame, and of the last doubt

    def passed(self, time: float, residual: Array, S: Array, in_front: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (m,) which bearings of a frame to take.

        Args:
            time: s.
            residual: (m, 2) rad, in the tangent planes.
            S: (m, 2, 2) rad^2, their covariances; where one is none, or not a number, its bearing is never taken.
            in_front: (m,) whether the targets are where the bearings point.
        """
        squared = normalised(residual, S)
        definite = squared >= 0.0
        fits = definite & (squared <= LARGEST) & in_front
        refused = 1.0 - np.count_nonzero(fits) / len(fits)
        self.share += (refused - self.share) * min(1.0, max(0.0, time - self.time) / AVERAGING)
        if (S[:, 0, 0] + S[:, 1, 1]).max() > WIDE:
            self.share = 1.0
        self.time = time
        is_open = self.share > (LOST_SHARE if self.confirmed else TENTATIVE_SHARE)
        if is_open:
            self.doubted = time
        self.confirmed = not is_open and (self.confirmed or time - self.doubted > CONFIRMATION)
        return definite if is_open else fits

    def sifted(self, time: float, P: Array, lines: Lines, in_front: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (m,) which lines to take, given the covariance P (n, n) of the error that they are linearised by."""
        return self.passed(time, lines.residual, lines.H @ P @ lines.H.transpose(0, 2, 1) + lines.N, in_front)
