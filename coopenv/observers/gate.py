"""Which bearings of a frame a filter believes: one gate for the whole zoo, on unless told otherwise.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation, 2001, section 5.4: the
normalised innovation squared r^T S^-1 r of an honest bearing has a chi-square distribution of 2 degrees of freedom. S
counts the prior, the sender's covariance where the filter uses one, and the bearing's noise. A target must also be
where the bearing points, and not behind (cheirality).

A filter that is sure of a wrong pose would refuse every bearing for ever. Of a track whose gate stays empty, trackers
hold that the track is lost and not that all measurements are false (Blackman and Popoli, Design and analysis of modern
tracking systems, 1999, section 6.2), and so does this gate: where more than half of the bearings have been refused in
every frame for longer than `PATIENCE`, it takes all of them until a majority fits again. Bearings that are wrong one at
a time never open it; one's only neighbour that lies does, as no vehicle could tell.
"""

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.observers.lines import Lines, Pose, Sight, ahead, normalised

LARGEST = 13.8155  # 0.999 of a chi-square of 2: -2 log 0.001
PATIENCE = 1.0  # s. Chosen: longer than anything that is in a vehicle's way for a moment


class Gate:
    """The gate of one vehicle."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what was refused."""
        self.since: float | None = None  # s, from when on a majority was refused in every frame

    def passed(self, time: float, squared: Array, in_front: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (m,) which bearings of a frame at a time in s to take.

        Args:
            time: s.
            squared: (m,) normalised innovations squared.
            in_front: (m,) whether the targets are where the bearings point.
        """
        definite = squared >= 0.0  # not where a covariance is none, or not a number
        fits = definite & (squared <= LARGEST) & in_front
        if 2 * int(fits.sum()) >= len(fits):
            self.since = None
            return fits
        if self.since is None:
            self.since = time
        return definite if time - self.since > PATIENCE else fits

    def sifted(self, time: float, P: Array, lines: Lines, in_front: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (m,) which lines to take, given the covariance P (n, n) of the error that they are linearised by."""
        S = lines.H @ P @ lines.H.transpose(0, 2, 1) + lines.N
        return self.passed(time, normalised(lines.residual, S), in_front)
