"""What a fake car says, message by message; each method is called when it is due."""

from collections.abc import Callable
from typing import Any

import numpy as np

from coopenv.fake import messages
from coopenv.fake.camera import Pixy
from coopenv.fake.sensors import FILTER_RATE, IMU_RATE, WHEEL_RATE, Sensors
from coopenv.fake.world import Room
from coopenv.svea.codec import encode
from coopenv.svea.topics import TOPICS, Role, topic_of
from coopenv.svea.transport.base import Transport

TRUTH_RATE, LEADER_RATE, CONDITION_RATE, CAMERA_INFO_RATE = 100.0, 60.0, 5.0, 1.0
"""Hz: of motion capture, of what a moving landmark says, of what a car says of itself, and of its camera."""
FULL = 0.9  # share of the battery that is left

Act = Callable[[int, int], None]
"""Called with when it was due, steady clock, and the stamp by the car's clock; ns."""


class Voice:
    """The messages of any car: motion capture, and those of a moving landmark."""

    def __init__(self, name: str, room: Room, wire: Transport, room_clock: Callable[[int], int], outside: Transport):
        """Say whose they are.

        Args:
            name: of the car.
            room: where it is.
            wire: its own link.
            room_clock: returns the stamp of motion capture for a time of the steady clock.
            outside: the network of motion capture, which has nothing to do with the car's.
        """
        self.name, self.room, self.wire = name, room, wire
        self._room_clock, self._outside = room_clock, outside
        self._origin = np.array(room.scenario.map.origin)

    @property
    def acts(self) -> dict[str, tuple[float, Act]]:
        """Rates in Hz, and what is said, by name."""
        return {"truth": (TRUTH_RATE, self._truth), "leader": (LEADER_RATE, self._leader)}

    def say(self, role: Role, message: Any) -> None:
        """Publish on the car's link."""
        topic = TOPICS[role]
        name = topic_of(self.name, role)
        self.wire.publish(name, encode(message), urgent=topic.urgent, reliable=topic.reliable)

    def _truth(self, due: int, _stamp: int) -> None:
        R, p = self.room.pose(self.room.agent)
        frames = ("mocap", self.name)
        message = messages.odometry(self._room_clock(due), frames, (R, p + self._origin), self.room.twist)
        self._outside.publish(topic_of(self.name, Role.TRUTH), encode(message))

    def _leader(self, _due: int, stamp: int) -> None:
        R, p = self.room.pose(self.room.agent)
        self.say(Role.ESTIMATE, messages.estimate(stamp, R, p + self._origin))


class DriverVoice(Voice):
    """The messages of a car that is a vehicle."""

    def __init__(self, *arguments: Any, pixy: Pixy, sensors: Sensors, rng: Callable[[], np.random.Generator]) -> None:
        """Say whose they are, and what measures; `rng` returns the generator of the episode's noise."""
        super().__init__(*arguments)
        self._pixy, self._sensors, self._rng = pixy, sensors, rng
        self.before_frame: Callable[[], None] = lambda: None
        """Called before a camera frame is taken."""

    @property
    def acts(self) -> dict[str, tuple[float, Act]]:
        """Rates in Hz, and what is said, by name."""
        return {
            "truth": (TRUTH_RATE, self._truth),
            "camera": (self.room.scenario.rates.camera, self._camera),
            "wheel": (WHEEL_RATE, self._wheel),
            "imu": (IMU_RATE, self._imu),
            "odometry": (FILTER_RATE, self._odometry),
            "condition": (CONDITION_RATE, self._condition),
            "camera_info": (CAMERA_INFO_RATE, self._camera_info),
        }

    def _camera(self, due: int, stamp: int) -> None:
        self.before_frame()
        blocks = self._pixy.frame(due, self._rng())
        self.say(Role.DETECTIONS, messages.detections(stamp, blocks))
        self.say(Role.BEARINGS, messages.bearings(stamp, blocks, self._pixy.calibration))

    def _wheel(self, due: int, stamp: int) -> None:
        s = self._sensors
        speed, turn = s.wheel(due, self._rng())
        variances = (s.wheel_std**2, s.wheel_turn_std**2)
        self.say(Role.WHEEL, messages.wheel(stamp, self.name, speed, turn, variances))

    def _imu(self, due: int, stamp: int) -> None:
        rates = self._sensors.gyro(due, self._rng())
        self.say(Role.IMU, messages.imu(stamp, self.name, rates, self._sensors.gyro_std**2))

    def _odometry(self, due: int, stamp: int) -> None:
        (x, y, heading), speed, turn = self._sensors.filtered(due)
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        twist = np.array([speed, 0.0, 0.0]), np.array([0.0, 0.0, turn])
        frames = (f"{self.name}/odom", f"{self.name}/base_link")
        self.say(Role.ODOMETRY, messages.odometry(stamp, frames, (R, np.array([x, y, 0.0])), twist))

    def _camera_info(self, _due: int, stamp: int) -> None:
        self.say(Role.CAMERA_INFO, messages.camera_info(stamp, self._pixy.calibration))

    def _condition(self, _due: int, stamp: int) -> None:
        self.say(Role.STATE, messages.state(stamp, armed=True))
        self.say(Role.REMOTE, messages.remote(stamp))
        self.say(Role.BATTERY, messages.battery(stamp, FULL))
