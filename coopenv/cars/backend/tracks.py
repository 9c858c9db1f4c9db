"""Samples of one body at any time between: odometry, motion capture, moving landmarks, camera frames."""

from bisect import bisect_right
from collections import Counter, deque
from operator import itemgetter

import numpy as np

from coopenv.cars.readings import Detections, Twist
from coopenv.estimation.poses import Array, exp_so3, exp_translation, log_so3

MOST_SAMPLES = 512
"""Velocities and turn rates that wait for a tick: five seconds of an IMU."""


class Odometer:
    """Held velocities (m/s) and turn rates (rad/s) of one car, each (3,); times in ns on one clock."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._waiting: deque[tuple[int, int, Array]] = deque()  # since when; 0: velocity, 1: turn rate; the value
        self._held = [np.zeros(3), np.zeros(3)]  # at the last time asked for
        self.twist = [np.zeros(3), np.zeros(3)]
        """The newest velocity and turn rate; zero where none has come."""
        self._stamps: dict[int, int] = {}

    @property
    def stamp(self) -> int | None:
        """When the older one of the last velocity and the last turn rate was taken; None: one has never come."""
        return min(self._stamps.values()) if len(self._stamps) == 2 else None

    def put(self, stamp: int, twist: Twist) -> None:
        """Take a sample of the velocity, of the turn rate, or of both, newer than all before of the same sensor."""
        for part, value in enumerate((twist.linear, twist.angular)):
            if value is not None:
                self._waiting.append((stamp, part, value))
                self.twist[part], self._stamps[part] = value, stamp
        while len(self._waiting) > MOST_SAMPLES:
            _, part, value = self._waiting.popleft()
            self._held[part] = value

    def increment(self, begin: int, end: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and translation (3,) in m from `begin` to `end`, and forget what was before."""
        R, p, now = np.eye(3), np.zeros(3), begin
        due = sorted((sample for sample in self._waiting if sample[0] <= end), key=itemgetter(0))
        self._waiting = deque(sample for sample in self._waiting if sample[0] > end)
        for since, part, value in due:
            if since > now:
                R, p = self._go(R, p, since - now)
                now = since
            self._held[part] = value
        return self._go(R, p, end - now) if end > now else (R, p)

    def _go(self, R: Array, p: Array, duration: int) -> tuple[Array, Array]:
        v, w = self._held
        seconds = duration * 1e-9
        turn, step = exp_so3(w * seconds), exp_translation(w * seconds, v * seconds)
        return R.dot(turn), p + R.dot(step)


MOST_POSES = 256
LONGEST_GAP = 100_000_000  # ns between two poses over which anything is interpolated, and beyond the last one
UNKNOWN = (np.full((3, 3), np.nan), np.full(3, np.nan))


class PoseTrack:
    """The last poses of one body; times in ns on one clock."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Array, Array]] = deque(maxlen=MOST_POSES)

    def put(self, stamp: int, rotation: Array, position: Array) -> None:
        """Take a pose, newer than all before: the rotation (3, 3), body to map, and the position (3,), m."""
        self._poses.append((stamp, rotation, position))

    def at(self, time: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and position (3,) at a time, NaN where too little is known about it."""
        poses = self._poses
        if not poses or not poses[0][0] <= time <= poses[-1][0] + LONGEST_GAP:
            return UNKNOWN
        if len(poses) == 1 or time == poses[-1][0]:
            return poses[-1][1:]
        after = min(bisect_right(poses, time, key=lambda pose: pose[0]), len(poses) - 1)  # beyond the last: as before
        (t0, R0, p0), (t1, R1, p1) = poses[after - 1], poses[after]
        if t1 - t0 > LONGEST_GAP:
            return UNKNOWN
        share = (time - t0) / (t1 - t0)
        return R0 @ exp_so3(share * log_so3(R0.T @ R1)), p0 + share * (p1 - p0)


KEPT = 64  # positions: a second of them


class PlaceTrack:
    """The last positions of one landmark; times in ns on one clock."""

    def __init__(self) -> None:
        self._places: deque[tuple[int, Array]] = deque(maxlen=KEPT)

    @property
    def stamp(self) -> int:
        """Time of the last position; -1: none was received."""
        return self._places[-1][0] if self._places else -1

    def put(self, stamp: int, position: Array) -> None:
        """Take a position (3,), m; one that is not newer than all before is left out."""
        if stamp > self.stamp:
            self._places.append((stamp, position))

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


MOST_WAITING = 2
"""Frames that may wait after a tick has taken one: clocks of cameras and ticks drift past each other, so that now and
then two come within a tick. More mean that the computer lags behind, and the oldest are left out."""


class FrameQueue:
    """The queue of one car; times in ns on one clock."""

    def __init__(self, refused: Counter[str]) -> None:
        """Begin with nothing; frames that are not used are counted in `refused`."""
        self._refused = refused
        self._waiting: deque[tuple[int, Detections]] = deque(maxlen=MOST_WAITING + 1)
        self._skipped = 0  # because too many waited, since the last one was taken

    def put(self, stamp: int, frame: Detections) -> None:
        """Take a frame, newer than all before; the oldest one makes room."""
        self._skipped += len(self._waiting) > MOST_WAITING
        self._waiting.append((stamp, frame))

    def take(self, after: int, until: int) -> tuple[int, Detections] | None:
        """Return the oldest frame exposed after a time and by another one; None: there is none."""
        if self._skipped:
            self._refused["frame left out"] += self._skipped
            self._skipped = 0
        while self._waiting and self._waiting[0][0] <= after:
            self._waiting.popleft()
            self._refused["frame out of order"] += 1
        if not self._waiting or self._waiting[0][0] > until:
            return None
        return self._waiting.popleft()

    def forget(self, now: int) -> None:
        """Leave out all frames exposed by now, uncounted."""
        self._skipped = 0
        while self._waiting and self._waiting[0][0] <= now:
            self._waiting.popleft()
