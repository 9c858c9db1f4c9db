"""Where a moving landmark was, as it has told, at any time between."""

from collections import deque

import numpy as np

from coopenv.backends.svea.pose_track import LONGEST_GAP
from coopenv.estimation.arrays import Array

KEPT = 64  # positions: a second of them


class PlaceTrack:
    """The last positions of one landmark; times in ns on one clock."""

    def __init__(self) -> None:
        self._places: deque[tuple[int, Array]] = deque(maxlen=KEPT)

    @property
    def stamp(self) -> int:
        """When it was at the last one; -1: it has told none."""
        return self._places[-1][0] if self._places else -1

    @property
    def last(self) -> Array:
        """(3,) where it has told last to be."""
        return self._places[-1][1]

    def put(self, stamp: int, position: Array) -> bool:
        """Take a position (3,); return False where it is older than one before."""
        if stamp <= self.stamp:
            return False
        self._places.append((stamp, position))
        return True

    def at(self, time: int) -> Array:
        """Return the position (3,) at a time: between two on the straight line, and for a while beyond the last one.

        Before the first one that is kept it is that one.
        """
        last, place = self._places[-1]
        if time > last and len(self._places) > 1:
            before, earlier = self._places[-2]
            if last - before <= LONGEST_GAP:
                going: Array = place + (place - earlier) * (min(time - last, LONGEST_GAP) / (last - before))
                return going
        stamps = np.array([stamp - time for stamp, _ in self._places], dtype=np.float64)
        places = np.array([place for _, place in self._places])
        return np.array([np.interp(0.0, stamps, axis) for axis in places.T])
