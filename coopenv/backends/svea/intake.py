"""From messages to samples: decoded, checked, counted; the same for live cars and for recordings of them."""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

from coopenv.backends.svea.binding import Binding
from coopenv.errors import CoopenvError
from coopenv.scenario.sensing import Camera
from coopenv.svea.codec import decode, stamp_of
from coopenv.svea.deployment import Sensors
from coopenv.svea.reading import read
from coopenv.svea.samples import Calibration, Sample, Twist
from coopenv.svea.topics import TOPICS, Role, topic_of
from coopenv.svea.transport.base import Arrival

WINDOW = 2_000_000_000  # ns over which the least delay is looked for

SPOKEN = (Role.ESTIMATE, Role.POINT, Role.REPORT)
"""What cars tell each other."""

VELOCITY = {"wheel+imu": (Role.WHEEL, Role.IMU), "wheel": (Role.WHEEL,), "odometry": (Role.ODOMETRY,)}


def roles_of(sensors: Sensors, local: bool) -> tuple[Role, ...]:
    """Return what is read of a car that is estimated here, or of one that is not."""
    heard: tuple[Role, ...] = (Role.TRUTH,) if sensors.truth else ()
    if not local:
        return (*heard, *SPOKEN)
    return (*VELOCITY[sensors.odometry], Role(sensors.detections), *heard)


@dataclass
class ClockOffset:
    """How much later than they were stamped a car's messages come, at least; times in ns."""

    _least: deque[tuple[int, int]]  # when it was received, delay; increasing delays

    @classmethod
    def unknown(cls) -> "ClockOffset":
        """Return one that has seen no message."""
        return cls(deque())

    def put(self, stamp: int, received: int) -> None:
        """Take a message."""
        delay = received - stamp
        while self._least and self._least[-1][1] >= delay:
            self._least.pop()
        self._least.append((received, delay))
        while self._least[0][0] < received - WINDOW:
            self._least.popleft()

    @property
    def seconds(self) -> float | None:
        """Offset of the car's clock behind the receiver's, the network's delay included, s; None: nothing has come."""
        return self._least[0][1] * 1e-9 if self._least else None


class Intake:
    """Reads the messages of all cars."""

    def __init__(self, binding: Binding, sensors: Sensors) -> None:
        """Say which topics are read."""
        self._topics: dict[str, tuple[str, Role, Calibration | None]] = {}
        self._sensors = sensors
        self.offsets = {name: ClockOffset.unknown() for name in binding.cars}
        self.rejected: dict[str, Counter[str]] = {name: Counter() for name in (*binding.cars, *binding.leaders)}
        """Messages that could not be used, by car and role."""
        self.calibrations = {name: _calibration(binding.scenario.cameras[i]) for name, i in binding.cars.items()}
        """Of the environment, by car."""
        for name, vehicle in binding.cars.items():
            for role in roles_of(sensors, vehicle in binding.local):
                self._topics[topic_of(name, role)] = name, role, self.calibrations[name]
        for name in binding.leaders:
            for role in (Role.ESTIMATE, Role.POINT, *((Role.TRUTH,) if sensors.truth else ())):
                self._topics[topic_of(name, role)] = name, role, None

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics that are read."""
        return tuple(self._topics)

    def samples(self, arrival: Arrival) -> Iterator[Sample]:
        """Yield what a message tells: one sample, or none where it is not what it should be."""
        found = self._topics.get(arrival.topic)
        if found is None:
            return
        car, role, calibration = found
        try:
            message = decode(arrival.payload, TOPICS[role].type)
            stamp = stamp_of(message)
            value = read(role, message, calibration, distorted=self._sensors.distorted)
        except CoopenvError:
            self.rejected[car][role.value] += 1
            return
        if isinstance(value, Twist) and role is Role.WHEEL and self._sensors.odometry == "wheel+imu":
            value = Twist(value.linear, None)  # the IMU's turn rate alone counts
        if car in self.offsets and role is not Role.TRUTH:
            self.offsets[car].put(stamp, arrival.received)
        yield Sample(car, role, stamp, arrival.received, value)


def _calibration(camera: Camera) -> Calibration:
    return Calibration(camera.image_size, camera.focal_length, camera.principal_point, camera.distortion)
