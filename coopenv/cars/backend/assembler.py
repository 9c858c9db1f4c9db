"""Assembly of ticks from the samples of all cars.

A tick has a row per car. A row holds for one time of that car, its *moment*: the exposure of the camera frame of the
tick. Odometry is integrated over the real time from one moment to the next. So a late frame corrects the pose at its
exposure, and not the pose at its arrival. Without a new frame the moment goes on with the clock, as far behind it as
the last frame was, and nothing is in view. Estimates and truth of a tick hold for the moment, too; its age is the
tick's `bearing_age`.
"""

import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice, takewhile

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.binding import Binding, NeighbourInbox
from coopenv.cars.backend.buffers import FrameQueue, Odometer, PoseTrack
from coopenv.cars.bags.clocks import NEAR, OUTLYING, Delay, checked, jumps, outlying
from coopenv.cars.gate.gate import MOST_AHEAD
from coopenv.cars.link.transport import Arrival, Transport
from coopenv.cars.messages.codec import decode, stamp_of
from coopenv.cars.messages.detectors import PLACED
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist, Value, implausible, read
from coopenv.cars.messages.stated import stated
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.deployment import Deployment
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction, Sensors
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Message, sealed
from coopenv.observers.sensed import Sensed, Truth, is_due

NS = 1e-9


class _Car:
    """The samples of one car."""

    def __init__(self, refused: Counter[str]) -> None:
        self.odometer, self.frames, self.track = Odometer(), FrameQueue(refused), PoseTrack()
        self.moment = 0
        self.lag = 0  # ns by which the last frame was behind its tick
        self.exposed = 0  # when the last frame was; the begin of the episode before there is one

    def advance(self, now: int, half: int) -> Detections | None:
        """Move the moment to that of the next frame, or on with the clock; return the frame.

        Args:
            now: time of the tick.
            half: ns of half a period more behind the clock, so that the frame that comes too late for this tick is
                after the moment.
        """
        if (taken := self.frames.take(self.moment, now)) is None:
            self.moment = max(self.moment, now - self.lag - half)
            return None
        self.moment, frame = taken
        self.lag, self.exposed = now - self.moment, self.moment
        return frame


KINDS = {
    Role.TRUTH: "motion capture",
    **dict.fromkeys((Role.WHEEL, Role.IMU, Role.ODOMETRY), "odometry"),
    **dict.fromkeys((Role.DETECTIONS, Role.BEARINGS), "frame"),
}
"""Kind of a sample, by role, in counts of refused samples; other roles are messages between cars."""


class Assembler:
    """Makes ticks of samples; the result depends on the order of calls alone."""

    def __init__(self, binding: Binding) -> None:
        """Begin with nothing; `binding` are vehicles and markers of the cars."""
        self.binding = binding
        scenario, topics = binding.scenario, binding.profile.topics
        camera = Role.BEARINGS if binding.profile.sees_frames else Role.DETECTIONS
        self._late, self._silent = topics[camera].max_age_ns, topics[Role.ODOMETRY].max_age_ns
        self._half = round(1e9 / scenario.rates.camera) // 2
        self._ratio = (scenario.rates.observer or scenario.rates.camera) / scenario.rates.camera
        self._to_body = [camera.to_body() for camera in scenario.cameras]
        self._origin = np.array(scenario.map.origin)
        self._begin = 0
        self._newest: dict[tuple[str, Role], int] = {}
        self.refused: Counter[str] = Counter()
        """Samples that were not used, by reason."""
        self._cars = [_Car(self.refused) for _ in scenario.vehicles]
        self._inbox = NeighbourInbox(binding, self.refused)

    def put(self, sample: Sample) -> bool:
        """Take a sample; return whether it is of a known car, plausible, and newer than all before of it."""
        key = car, role = sample.car, sample.role
        why = ""
        if car not in self.binding.leaders and car not in self.binding.cars:
            why = "unknown car"
        elif sample.stamp > sample.received + MOST_AHEAD:
            why = "stamp in the future"
        elif sample.stamp <= self._newest.get(key, -1):
            why = f"{KINDS.get(role, 'message')} out of order"
        elif implausible(sample):
            why = "velocity of no car"
        if why:
            self.refused[why] += 1
            return False
        self._newest[key] = sample.stamp
        value = sample.value
        if isinstance(value, CarPose | Message) and value.position is not None:
            value = replace(value, position=value.position - self._origin)
        if car in self.binding.cars:
            self._put_vehicle(self.binding.cars[car], role, sample.stamp, value)
        elif isinstance(value, CarPose) and role in (Role.ESTIMATE, Role.POINT):
            self._inbox.put_landmark(self.binding.leaders[car], sample.stamp, sample.received, value)
        return True

    def _put_vehicle(self, vehicle: int, role: Role, stamp: int, value: Value) -> None:
        car = self._cars[vehicle]
        if isinstance(value, Twist):
            car.odometer.put(stamp, value)
        elif isinstance(value, Detections):
            self.refused["detections left out"] += value.dropped
            car.frames.put(stamp, value)
        elif role is Role.TRUTH:
            if isinstance(value, CarPose) and value.rotation is not None:
                car.track.put(stamp, value.rotation, value.position)
        elif isinstance(value, CarPose | Message) and vehicle not in self.binding.local:
            self._inbox.put_vehicle(vehicle, role, stamp, value)

    def begin(self, now: int) -> Sensed:
        """Return tick 0 at a time in ns; earlier samples give the present state of the cars."""
        self._begin = now
        for car in self._cars:
            car.frames.forget(now)  # no tick took frames since the last episode
            car.moment, car.lag, car.exposed = now - self._half, 0, now
        self._inbox.forget()
        return self.tick(0, now)

    def moment(self, vehicle: int) -> int:
        """Return the time in ns for which the present tick of a vehicle holds, on the receiver's clock."""
        return self._cars[vehicle].moment

    def tick(self, index: int, now: int) -> Sensed:
        """Return tick number `index` at a time in ns."""
        N, T = len(self._cars), len(self.binding.scenario.target_names)
        rotation, translation = np.tile(np.eye(3), (N, 1, 1)), np.zeros((N, 3))
        velocity, angular_velocity = np.zeros((N, 3)), np.zeros((N, 3))
        bearings, visible = np.full((N, T, 3), np.nan), np.zeros((N, T), bool)
        odometry_age, bearing_age = np.full(N, np.inf), np.zeros(N)
        missing, late = np.zeros(N, bool), np.zeros(N, bool)
        truth = Truth(np.full((N, 3, 3), np.nan), np.full((N, 3), np.nan))
        for i, car in enumerate(self._cars):
            before = car.moment
            frame = car.advance(now, self._half)
            rotation[i], translation[i] = car.odometer.increment(before, car.moment)
            truth.rotation[i], truth.position[i] = car.track.at(car.moment)
            if i not in self.binding.local:
                missing[i] = True
                continue
            stamp = car.odometer.stamp
            age = np.inf if stamp is None else max(now - stamp, 0)
            missing[i], odometry_age[i] = age > self._silent, age * NS
            velocity[i], angular_velocity[i] = car.odometer.twist
            bearing_age[i] = (now - car.exposed) * NS
            if frame is not None:
                late[i] = car.lag > self._late
                self._see(i, frame, now, bearings[i], visible[i])
        exposed = sum(self.moment(i) for i in self.binding.local) // len(self.binding.local)
        return Sensed(
            index=index,
            dt=1.0 / self.binding.scenario.rates.camera,
            due=bool(is_due(index, self._ratio)),
            time=(now - self._begin) * NS,
            rotation=rotation,
            translation=translation,
            velocity=velocity,
            angular_velocity=angular_velocity,
            bearings=bearings,
            visible=visible,
            landmarks=sealed(self._inbox.places(now, exposed)),
            odometry_age=odometry_age,
            bearing_age=bearing_age,
            missing=missing,
            late=late,
            truth=truth if np.isfinite(truth.position).any() else None,
            inbox_tick=np.full((N, N), -1, dtype=np.int64) if self.binding.remote else None,
            messages=self._inbox.messages(now),
        )

    def _see(self, i: int, frame: Detections, now: int, bearings: Array, visible: NDArray[np.bool_]) -> None:
        """Write a frame's bearings into a car's row, (T, 3) and (T,)."""
        for marker, ray in zip(frame.markers, frame.bearings, strict=True):
            target = self.binding.targets.get(marker)
            if target is None or target == len(self.binding.scenario.landmarks) + i:
                self.refused["unknown marker"] += 1
            elif self._inbox.is_lost(target, now):
                self.refused["landmark of unknown position"] += 1
            else:
                bearings[target], visible[target] = self._to_body[i] @ ray, True


BROADCAST = (Role.ESTIMATE, Role.POINT, Role.REPORT)
"""Messages between cars."""

WINDOW = 2_000_000_000  # ns that the present offset is of; a tenth of their stamps may be wrong
KEPT = 3_000  # messages of a topic, half a minute of 100 Hz, that the drift is of


class TopicClock:
    """The clock of a topic's stamps, by its last messages; estimated as that of a topic in a bag. Times in ns."""

    def __init__(self) -> None:
        """Begin without messages."""
        self._times: deque[tuple[int, int]] = deque(maxlen=KEPT)  # of reception, and stamp
        self._usual: int | None = None  # delay of the last message that was not dropped
        self.taken = self.dropped = 0
        """All messages, and messages with outlying stamps."""

    def put(self, stamp: int, received: int) -> bool:
        """Take a message; return whether its stamp fits those before. A jump of the clock fits after some messages."""
        self._times.append((received, stamp))
        self.taken += 1
        if self._usual is not None and abs(received - stamp - self._usual) > OUTLYING:
            times = np.array([*islice(self._recent(), NEAR)][::-1], dtype=np.int64)
            if outlying(times[:, 1], times[:, 0])[-1]:
                self.dropped += 1
                return False
        self._usual = received - stamp
        return True

    def _recent(self) -> Iterator[tuple[int, int]]:
        """Return the messages of the window, the last one first."""
        newest = self._times[-1][0] if self._times else 0
        return takewhile(lambda times: times[0] >= newest - WINDOW, reversed(self._times))

    @property
    def seconds(self) -> float:
        """Offset of the topic's clock behind the receiver's, transport included, s; NaN: no message yet."""
        delays = sorted(received - stamp for received, stamp in self._recent())
        return delays[len(delays) // 10] * NS if delays else float("nan")

    def line(self) -> Delay | None:
        """Return the delay at the last message and its drift since the last jump of the clock; None: no message yet."""
        received, stamps = np.array(self._times, dtype=np.int64).reshape(-1, 2).T
        found = jumps(stamps, received)
        first = max(found, default=0)
        _, delay = checked(stamps[first:], received[first:])
        if delay is None:
            return None
        last = int(received[-1])
        return replace(delay, offset=delay.at(last), middle=last, jump=found.get(first, delay.jump))

    def __str__(self) -> str:
        """Return offset, drift, jump and dropped messages in words."""
        if (delay := self.line()) is None:
            return "no message with a stamp"
        parts = [f"{abs(delay.offset) * 1e-6:.1f} ms {'ahead' if delay.offset < 0 else 'behind'}"]
        parts += [f"drifts by {1e6 * delay.drift:+.0f} us per s"] if delay.drift else []
        parts += [f"jumped by {-delay.jump * NS:+.3f} s"] if delay.jump else []
        return ", ".join([*parts, f"{self.dropped} of {self.taken} stamps dropped"])


def arrivals_of(transport: Transport, fleet: Deployment, car: str, seconds: float) -> list[Arrival]:
    """Return the messages of some time, s, on the topics that a fleet's station reads of a car."""
    arrivals = list[Arrival]()
    for role in fleet.sensors.roles:
        transport.subscribe(fleet.profile.topic_of(car, role), arrivals.append)
    time.sleep(seconds)
    return sorted(arrivals[:], key=lambda arrival: arrival.received)


def measured_clocks(arrivals: Sequence[Arrival], fleet: Deployment, car: str) -> dict[str, TopicClock]:
    """Return the clocks of the topics that a fleet's station reads of a car, by messages in order of reception."""
    profile, leads = fleet.profile, fleet.sensors.leads
    types = {profile.topic_of(car, role): profile.topics[role].type for role in fleet.sensors.roles}
    clocks = {topic: TopicClock() for topic in types}
    for arrival in arrivals:
        topic = arrival.topic
        with suppress(CoopenvError):
            stamp = stamp_of(decode(arrival.payload, types[topic])) + round(leads.get(f"/{topic}", 0.0) / NS)
            clocks[topic].put(stamp, arrival.received)
    return clocks


class Intake:
    """Reads the messages of all cars."""

    def __init__(self, binding: Binding, sensors: Sensors) -> None:
        """Collect the topics that are read."""
        self._sensors, self._profile = sensors, binding.profile
        self.rejected: dict[str, Counter[str]] = {name: Counter() for name in (*binding.cars, *binding.leaders)}
        """Messages that could not be used, by car and role."""
        right, cameras = sensors.corrections, binding.scenario.cameras
        self.calibrations = {
            name: right.get(name, Correction()).lens(Calibration.of(cameras[i])) for name, i in binding.cars.items()
        }
        """Calibrations of the environment, corrected, by car."""
        truth: tuple[Role, ...] = (Role.TRUTH,) if sensors.truth else ()
        roles = {
            name: sensors.roles if i in binding.local else (*truth, *BROADCAST) for name, i in binding.cars.items()
        }
        roles |= dict.fromkeys(binding.leaders, (Role.ESTIMATE, Role.POINT, *truth))
        self.topics = {
            binding.profile.topic_of(name, role): (name, role, self.calibrations.get(name))
            for name, some in roles.items()
            for role in some
        }
        """Car, role and camera of the topics that are read, by name."""
        self.clocks = {topic: TopicClock() for topic, (name, _, _) in self.topics.items() if name in binding.cars}

    @property
    def lenses(self) -> dict[str, Calibration]:
        """Calibrations by whose pixels the rays of cars are made."""
        role = Role(self._sensors.detections)
        pixels = self._profile.topics[role].type not in PLACED and (role is Role.DETECTIONS or self._sensors.distorted)
        return self.calibrations if pixels else {}

    def samples(self, arrival: Arrival) -> Iterator[Sample]:
        """Yield the sample of a message, or none if the message is malformed."""
        found = self.topics.get(arrival.topic)
        if found is None:
            return
        car, role, calibration = found
        try:
            message = decode(arrival.payload, self._profile.topics[role].type)
            stamp = stamp_of(message)
            vision, distorted = self._profile.vision, self._sensors.distorted
            value = read(role, message, calibration, distorted=distorted, vision=vision, any_unit=True)
        except CoopenvError:
            self.rejected[car][role.value] += 1
            return
        if isinstance(value, Twist):
            by_imu = self._sensors.odometry == "wheel+imu"
            value = self._sensors.corrections.get(car, Correction()).twist(value, role, by_imu)
        stamp += value.late if isinstance(value, Detections) else 0
        stamp += round(self._sensors.leads.get(f"/{arrival.topic}", 0.0) / NS)
        if arrival.topic in self.clocks and not self.clocks[arrival.topic].put(stamp, arrival.received):
            self.rejected[car]["outlying stamp"] += 1
            return
        yield Sample(car, role, stamp, arrival.received, value, stated(message))

    def offset_of(self, car: str) -> float:
        """Return the least offset of the topics of a car, without motion capture, s; NaN: no message yet."""
        own = (topic for topic, (name, role, _) in self.topics.items() if name == car and role is not Role.TRUTH)
        return min((found for topic in own if (found := self.clocks[topic].seconds) == found), default=float("nan"))

    def unsynchronised(self, car: str, most: float) -> Iterator[str]:
        """Yield the clocks of a car and of its topics that are off by more than `most`, s.

        Frames of a camera may be behind by their maximal age besides, which is exposure and processing.
        """
        found = [("its clock is", self.offset_of(car), most)]
        for topic, (name, role, _) in self.topics.items():
            if name == car:
                age = self._profile.topics[role].max_age if KINDS.get(role) == "frame" else None
                found.append((f"stamps of {topic} are", self.clocks[topic].seconds, most + (age or 0.0)))
        for what, offset, behind in found:
            if not -most <= offset <= behind and offset == offset:
                side, allowed = ("behind", behind) if offset > 0.0 else ("ahead of", most)
                yield f"{what} {abs(offset) * 1e3:.0f} ms {side} this computer's, {allowed * 1e3:.0f} ms are allowed"
