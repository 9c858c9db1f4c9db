"""Poses of one body as motion capture tells them, at any time between."""

from bisect import bisect_right
from collections import deque
from itertools import islice

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import exp_so3, log_so3
from coopenv.svea.samples import Pose

MOST_POSES = 256
LONGEST_GAP = 100_000_000  # ns between two poses over which anything is interpolated, and beyond the last one
UNKNOWN = (np.full((3, 3), np.nan), np.full(3, np.nan))


class PoseTrack:
    """The last poses of one body; times in ns on one clock."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Array, Array]] = deque(maxlen=MOST_POSES)

    @property
    def stamp(self) -> int | None:
        """When the last one was taken; None: there is none."""
        return self._poses[-1][0] if self._poses else None

    def put(self, stamp: int, pose: Pose) -> bool:
        """Take a pose; return False where it is older than one before, or has no rotation."""
        if pose.rotation is None or (self._poses and stamp <= self._poses[-1][0]):
            return False
        self._poses.append((stamp, pose.rotation, pose.position))
        return True

    def at(self, time: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and position (3,) at a time, NaN where too little is known about it."""
        after = bisect_right(self._poses, time, key=lambda pose: pose[0])
        if after == 0:
            return UNKNOWN
        before, R, p = self._poses[after - 1]
        if after == len(self._poses):
            near = time - before
            if near > LONGEST_GAP:
                return UNKNOWN
            if after == 1 or near == 0:
                return R, p
            earlier, R0, p0 = self._poses[after - 2]  # goes on as it went
            return self._between((earlier, R0, p0), (before, R, p), time)
        return self._between((before, R, p), next(islice(self._poses, after, None)), time)

    @staticmethod
    def _between(first: tuple[int, Array, Array], second: tuple[int, Array, Array], time: int) -> tuple[Array, Array]:
        (t0, R0, p0), (t1, R1, p1) = first, second
        if t1 - t0 > LONGEST_GAP:
            return UNKNOWN
        share = (time - t0) / (t1 - t0)
        return R0 @ exp_so3(share * log_so3(R0.T @ R1)), p0 + share * (p1 - p0)
