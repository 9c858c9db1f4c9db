"""Buffers of the cars' latest messages: interpolated samples, and conditions.

Samples are odometry, motion capture, moving landmarks and camera frames. A condition is the reason for which a car
is not armed, or is stopped.
"""

import threading
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.link.transport import Arrival, Transport
from coopenv.cars.messages.codec import decode, stamp_of
from coopenv.cars.messages.readings import CarStatus, Detections, Twist, read
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.deployment import Remote
from coopenv.cars.settings.profile import SVEA, CarProfile, Role
from coopenv.cars.settings.sensors import Correction
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
        """Stamp, ns, of the older of the last velocity and the last turn rate; None: one of them has never come."""
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


ROLES = (Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)
TOLERANCES = {"image_size": 0.5, "focal_length": 2.0, "principal_point": 2.0, "distortion": 0.02}
"""Largest difference between a camera's own calibration and the environment's: pixels; each distortion coefficient."""


class Condition(NamedTuple):
    """Last message of a car about its condition."""

    status: CarStatus = CarStatus()
    stamp: int = -1  # ns, clock of the car
    since: float = float("-inf")  # s, steady: when the condition held


@dataclass(eq=False, repr=False)
class StatusBoard:
    """Last condition of each car, and the reasons to stop it since arming."""

    transport: Transport
    cars: tuple[str, ...]
    remote: Remote
    needed: bool  # True if cars must send the conditions of their profile
    profile: CarProfile = SVEA

    def __post_init__(self) -> None:
        """Subscribe to the conditions of the cars."""
        self._lock, self._clock = threading.Lock(), self.transport.clock
        self._conditions_needed = tuple(map(Role, self.profile.conditions)) if self.needed else ()
        self._topics = {self.profile.topic_of(car, role): (car, role) for car in self.cars for role in ROLES}
        self._conditions = {key: Condition() for key in self._topics.values()}
        self._begun: dict[tuple[str, Role], Condition] = {}  # as they were at arming
        self._happened: dict[str, str] = {}
        self.calibrations: dict[str, Calibration] = {}
        """Calibrations of the cars that publish theirs."""
        for topic in self._topics:
            self.transport.subscribe(topic, self._take)

    def begin(self) -> None:
        """Take the present conditions as the reference for changes."""
        with self._lock:
            self._begun, self._happened = dict(self._conditions), {}

    def obstacles(self, car: str, least: float, used: Calibration, right: Correction | None = None) -> Iterator[str]:
        """Yield reasons not to arm a car by its conditions.

        Args:
            car: its name.
            least: share of its battery that it needs.
            used: calibration of its camera, which its own has to agree with.
            right: constants that take the place of its own (None: none do).
        """
        remote, state = self._conditions[car, Role.REMOTE].status, self._conditions[car, Role.STATE].status
        battery = self._conditions[car, Role.BATTERY].status.battery
        yield from filter(None, (self._silent(car, role) for role in self._conditions_needed))
        if why := self._driven(remote):
            yield why
        if Role.STATE in self._conditions_needed and not state.armed:
            yield "its autopilot is not armed"
        if battery is None and Role.BATTERY in self._conditions_needed and least > 0.0:
            yield "its battery publishes no charge (safety.min_battery = 0 needs none)"
        if battery is not None and battery < least:
            yield f"its battery is at {100 * battery:.0f} %, {100 * least:.0f} % are needed"
        published = self.calibrations.get(car)
        if published is not None and right is not None:
            published = right.lens(published)
        for name, tolerance in TOLERANCES.items() if published is not None else ():
            a, b = getattr(published, name), getattr(used, name)
            if len(a) != len(b) or (np.abs(np.subtract(a, b)) > tolerance).any():
                wrong = "correct its CameraInfo, or [camera] of the environment"
                yield f"its camera publishes {name} = {list(a)}, the environment has {list(b)}: {wrong}"

    def happened(self, car: str) -> str:
        """Return the reason to stop an armed car by its conditions since arming; empty: none."""
        silent = self._silent(car, Role.REMOTE) if Role.REMOTE in self._conditions_needed else ""
        return self._happened.get(car) or silent

    def _take(self, arrival: Arrival) -> None:
        key = car, role = self._topics[arrival.topic]
        topic = self.profile.topics[role]
        try:
            message = decode(arrival.payload, topic.type)
            value, stamp = read(role, message, vision=self.profile.vision), stamp_of(message)
        except CoopenvError:
            return
        delay = (arrival.received - stamp) * 1e-9
        with self._lock:
            if isinstance(value, Calibration):
                self.calibrations[car] = value
                return
            new = stamp > self._conditions[key].stamp and abs(delay) <= (topic.max_age or 0.0)
            if isinstance(value, CarStatus) and new:
                self._conditions[key] = Condition(value, stamp, self._clock.seconds() - max(delay, 0.0))
                if key in self._begun and (why := self._changed(role, self._begun[key].status, value)):
                    self._happened.setdefault(car, why)

    def _driven(self, status: CarStatus) -> str:
        """Return the reason by the remote control not to drive a car; empty: none."""
        pulses, usual = status.pulses or (), self.profile.pulses
        if self.remote.drives(pulses, usual):
            return "is driven by remote control"
        return self.remote.fault(pulses, usual) if Role.REMOTE in self._conditions_needed else ""

    def _changed(self, role: Role, then: CarStatus, now: CarStatus) -> str:
        if role is Role.REMOTE:
            if why := self._driven(now):
                return why
            if self.remote.switched(now.pulses or (), then.pulses or (), self.profile.pulses):
                return "the mode switch of its remote control was moved"
        if now.armed is False and (self.needed or then.armed):
            return "its autopilot is no longer armed"
        if then.mode is not None and now.mode != then.mode:
            return f"its autopilot went from mode {shown(then.mode)} to {shown(now.mode)}"
        return ""

    def _silent(self, car: str, role: Role) -> str:
        age = self._clock.seconds() - self._conditions[car, role].since
        if age <= (self.profile.topics[role].max_age or 0.0):
            return ""
        words = "was received" if age == float("inf") else f"for {age:.2f} s"
        return f"no usable message {words} on {self.profile.topic_of(car, role)}"
