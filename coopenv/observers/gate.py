"""Which bearings of a frame a filter believes: one gate for the whole zoo, on unless told otherwise.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation, 2001, section 5.4: the
normalised innovation squared r^T S^-1 r of an honest bearing has a chi-square distribution of 2 degrees of freedom. S
counts the prior, the sender's covariance where the filter uses one, and the bearing's noise. A target must also be
where the bearing points, and not behind (cheirality).

A filter that is sure of a wrong pose would refuse what contradicts it for ever. Trackers give up a track when what
fits it stays away, and hold a new one for tentative until it is confirmed (Blackman and Popoli, Design and analysis of
modern tracking systems, 1999, chapter 6). So does this gate: it opens, which means that it takes everything, where the
prior is so wide that a linearised innovation has no meaning, and where most bearings are refused; it closes when few
would be. Targets mistaken now and then, and one sender of two or more that lies, do not open it; a lie that is told
while it is open is believed.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled import MATRICES, MATRIX, compiled
from coopenv.observers.lines import normalised

LARGEST = 13.8155  # 0.999 of a chi-square of 2: -2 log 0.001
WIDE = 0.5  # rad^2, trace of S: about 30 degrees per axis. Chosen
AVERAGING = 1.0  # s, over which the share of refused bearings is averaged. Chosen
LOST_SHARE, FOUND_SHARE = 0.6, 0.1
"""Averaged shares of refused bearings above which the gate opens, and below which it closes. Chosen: one wrong target
of two does not open it, and one of three does not let it close."""


class Gate:
    """The gate of one vehicle."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self.share = 0.0  # of refused bearings, averaged
        self.is_open = False
        self.time = 0.0  # s, of the last frame

    def passed(self, time: float, residual: Array, S: Array, in_front: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (m,) which bearings of a frame to take.

        Args:
            time: s.
            residual: (m, 2) rad, in the tangent planes.
            S: (m, 2, 2) rad^2, their covariances; where one is none, or not a number, its bearing is never taken.
            in_front: (m,) whether the targets are where the bearings point.
        """
        definite, fits, refused, widest = judged(residual, S, in_front)
        self.share += (refused - self.share) * min(1.0, max(0.0, time - self.time) / AVERAGING)
        if widest > WIDE:
            self.share = 1.0
        self.time = time
        self.is_open = self.share > (FOUND_SHARE if self.is_open else LOST_SHARE)
        taken: NDArray[np.bool_] = definite if self.is_open else fits
        return taken


@compiled(MATRIX, MATRICES, types.Array(types.boolean, 1, "A", readonly=True))
def judged(
    residual: Array, S: Array, in_front: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], float, float]:
    """Return (m,) which S are covariances, (m,) which bearings fit, the share of the others, and the largest trace."""
    squared = normalised(residual, S)
    definite = squared >= 0.0
    fits = definite & (squared <= LARGEST) & in_front
    widest = np.max(S[:, 0, 0] + S[:, 1, 1])
    return definite, fits, 1.0 - np.count_nonzero(fits) / len(fits), widest
