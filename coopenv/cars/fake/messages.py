"""Measurements of a fake car as the messages of real ones; stamps in ns."""

from collections.abc import Callable
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.cars.codec import encode, header, make, pose, quaternion
from coopenv.cars.fake.sensors import FILTER_RATE, IMU_RATE, WHEEL_RATE, Block, CarSensors, Pixy, bearings_of
from coopenv.cars.fake.world import CarWorld
from coopenv.cars.profile import CarProfile, Role
from coopenv.cars.samples import Calibration
from coopenv.cars.transport.base import Transport
from coopenv.estimation.poses import Array

GRAVITY = 9.81  # m/s^2


def detections(stamp: int, blocks: list[Block]) -> Any:
    """Return the ObjectInfoArrayStamped of a frame; one without blocks is a frame as well."""
    objects = [
        make(
            "pixy_camera/msg/ObjectInfo",
            signature=b.signature,
            center_x=b.x,
            center_y=b.y,
            width=b.width,
            height=b.height,
            angle=0,
            index=b.index,
            age=b.age,
        )
        for b in blocks
    ]
    return make("pixy_camera/msg/ObjectInfoArrayStamped", header=header(stamp, "camera"), objects=objects)


def bearings(stamp: int, blocks: list[Block], calibration: Calibration) -> Any:
    """Return the ObjectBearingArrayStamped of a frame."""
    unit = bearings_of(blocks, calibration).tolist()
    entries = [
        make("pixy_camera/msg/ObjectBearing", id=b.signature, bearing_x=x, bearing_y=y, bearing_z=z)
        for b, (x, y, z) in zip(blocks, unit, strict=True)
    ]
    return make("pixy_camera/msg/ObjectBearingArrayStamped", header=header(stamp, "camera"), bearing=entries)


def camera_info(stamp: int, c: Calibration) -> Any:
    """Return the CameraInfo of a lens."""
    (fx, fy), (cx, cy), (width, height) = c.focal_length, c.principal_point, c.image_size
    region = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp, "camera"),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.array(c.distortion),
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).ravel(),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def wheel(stamp: int, car: str, speed: float, turn_rate: float, variances: tuple[float, float]) -> Any:
    """Return the TwistWithCovarianceStamped of the wheels; variances of speed and turn rate."""
    covariance = np.diag([variances[0], 0.0, 0.0, 0.0, 0.0, variances[1]])
    return make(
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        header=header(stamp, f"{car}/base_link"),
        twist=_twist_with_covariance((speed, 0.0, 0.0), (0.0, 0.0, turn_rate), covariance),
    )


def imu(stamp: int, car: str, turn_rates: Array, variance: float) -> Any:
    """Return the Imu: turn rates, and the weight of a car on a plane; it knows no orientation."""
    unknown = np.array([-1.0, *np.zeros(8)])
    return make(
        "sensor_msgs/msg/Imu",
        header=header(stamp, f"{car}/imu"),
        orientation=quaternion(np.eye(3)),
        orientation_covariance=unknown,
        angular_velocity=_vector(turn_rates),
        angular_velocity_covariance=(variance * np.eye(3)).ravel(),
        linear_acceleration=_vector((0.0, 0.0, GRAVITY)),
        linear_acceleration_covariance=np.zeros(9),
    )


def odometry(stamp: int, frames: tuple[str, str], placed: tuple[Array, Array], twist: tuple[Array, Array]) -> Any:
    """Return an Odometry: pose (rotation, position) in the first frame, twist (velocity, turn rate) in the second."""
    return make(
        "nav_msgs/msg/Odometry",
        header=header(stamp, frames[0]),
        child_frame_id=frames[1],
        pose=_pose_with_covariance(*placed),
        twist=_twist_with_covariance(*twist, np.zeros((6, 6))),
    )


def estimate(stamp: int, rotation: Array, position: Array) -> Any:
    """Return the PoseWithCovarianceStamped of a car whose pose is known, in the map."""
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(stamp, "map"),
        pose=_pose_with_covariance(rotation, position),
    )


def state(stamp: int, armed: bool) -> Any:
    """Return the State of the flight controller."""
    more = {"connected": True, "guided": False, "manual_input": True, "mode": "MANUAL", "system_status": 4}
    return make("mavros_msgs/msg/State", header=header(stamp), armed=armed, **more)


def remote(stamp: int) -> Any:
    """Return the RCIn of sticks at rest."""
    channels = np.full(8, 1500, dtype=np.uint16)
    return make("mavros_msgs/msg/RCIn", header=header(stamp), rssi=200, channels=channels)


def battery(stamp: int, share: float) -> Any:
    """Return the BatteryState of a battery of which a share is left."""
    amounts = {"voltage": 10.5 + 2.1 * share, "temperature": 25.0, "current": -1.0}
    capacity = {"charge": 5.0 * share, "capacity": 5.0, "design_capacity": 5.0, "percentage": share}
    status = {"power_supply_status": 2, "power_supply_health": 1, "power_supply_technology": 3, "present": True}
    cells = {"cell_voltage": np.zeros(0, np.float32), "cell_temperature": np.zeros(0, np.float32)}
    names = {"location": "", "serial_number": ""}
    kind = "sensor_msgs/msg/BatteryState"
    return make(kind, header=header(stamp), **amounts, **capacity, **status, **cells, **names)


def _twist_with_covariance(linear: Any, angular: Any, covariance: Array) -> Any:
    twist = make("geometry_msgs/msg/Twist", linear=_vector(linear), angular=_vector(angular))
    return make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance.ravel())


def _pose_with_covariance(rotation: Array, position: Array) -> Any:
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose(rotation, position), covariance=np.zeros(36))


def _vector(values: Any) -> Any:
    x, y, z = (float(value) for value in values)
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


TRUTH_RATE, LEADER_RATE, CONDITION_RATE, CAMERA_INFO_RATE = 100.0, 60.0, 5.0, 1.0
"""Hz: motion capture, poses of a moving landmark, conditions of a car, calibration of its camera."""
FULL = 0.9  # share of the battery that is left

Act = Callable[[int, int], None]
"""Called with when it was due, steady clock, and the stamp by the car's clock; ns."""


class SensorPublisher:
    """Publishes the messages of any car: motion capture, and those of a moving landmark."""

    def __init__(
        self,
        name: str,
        world: CarWorld,
        wire: Transport,
        shared_clock: Callable[[int], int],
        outside: Transport,
        profile: CarProfile,
    ):
        """Prepare the messages of a car.

        Args:
            name: of the car.
            world: its world.
            wire: its own link.
            shared_clock: returns the stamp of motion capture for a time of the steady clock.
            outside: the network of motion capture, which has nothing to do with the car's.
            profile: make of the car.
        """
        self.name, self.world, self.wire = name, world, wire
        self._shared_clock, self._outside, self._profile = shared_clock, outside, profile
        self._origin = np.array(world.scenario.map.origin)

    @property
    def acts(self) -> dict[str, tuple[float, Act]]:
        """Rates in Hz, and what is published, by name."""
        return {"truth": (TRUTH_RATE, self._truth), "leader": (LEADER_RATE, self._leader)}

    def publish(self, role: Role, message: Any) -> None:
        """Publish on the car's link."""
        topic, name = self._profile.topics[role], self._profile.topic_of(self.name, role)
        self.wire.publish(name, self._encoded(role, message), urgent=topic.urgent, reliable=topic.reliable)

    def _encoded(self, role: Role, message: Any) -> bytes:
        if message.__msgtype__ != (kind := self._profile.topics[role].type):
            raise CoopenvError(f"profile: topics.{role}.type: {kind}: fake cars have {message.__msgtype__} alone")
        return encode(message)

    def _truth(self, due: int, _stamp: int) -> None:
        R, p = self.world.pose(self.world.agent)
        frames = ("mocap", self.name)
        message = odometry(self._shared_clock(due), frames, (R, p + self._origin), self.world.twist)
        self._outside.publish(self._profile.topic_of(self.name, Role.TRUTH), self._encoded(Role.TRUTH, message))

    def _leader(self, _due: int, stamp: int) -> None:
        R, p = self.world.pose(self.world.agent)
        self.publish(Role.ESTIMATE, estimate(stamp, R, p + self._origin))


class VehicleSensorPublisher(SensorPublisher):
    """Publishes the messages of a car that is a vehicle."""

    def __init__(
        self, *arguments: Any, pixy: Pixy, sensors: CarSensors, rng: Callable[[], np.random.Generator]
    ) -> None:
        """Add camera and sensors; `rng` returns the generator of the episode's noise."""
        super().__init__(*arguments)
        self._pixy, self._sensors, self._rng = pixy, sensors, rng
        self.before_frame: Callable[[], None] = lambda: None
        """Called before a camera frame is taken."""

    @property
    def acts(self) -> dict[str, tuple[float, Act]]:
        """Rates in Hz, and what is published, by name."""
        return {
            "truth": (TRUTH_RATE, self._truth),
            "camera": (self.world.scenario.rates.camera, self._camera),
            "wheel": (WHEEL_RATE, self._wheel),
            "imu": (IMU_RATE, self._imu),
            "odometry": (FILTER_RATE, self._odometry),
            "condition": (CONDITION_RATE, self._condition),
            "camera_info": (CAMERA_INFO_RATE, self._camera_info),
        }

    def _camera(self, due: int, stamp: int) -> None:
        self.before_frame()
        blocks = self._pixy.frame(due, self._rng())
        self.publish(Role.DETECTIONS, detections(stamp, blocks))
        self.publish(Role.BEARINGS, bearings(stamp, blocks, self._pixy.calibration))

    def _wheel(self, due: int, stamp: int) -> None:
        s = self._sensors
        speed, turn = s.wheel(due, self._rng())
        variances = (s.wheel_std**2, s.wheel_turn_std**2)
        self.publish(Role.WHEEL, wheel(stamp, self.name, speed, turn, variances))

    def _imu(self, due: int, stamp: int) -> None:
        rates = self._sensors.gyro(due, self._rng())
        self.publish(Role.IMU, imu(stamp, self.name, rates, self._sensors.gyro_std**2))

    def _odometry(self, due: int, stamp: int) -> None:
        (x, y, heading), speed, turn = self._sensors.filtered(due)
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        twist = np.array([speed, 0.0, 0.0]), np.array([0.0, 0.0, turn])
        frames = (f"{self.name}/odom", f"{self.name}/base_link")
        self.publish(Role.ODOMETRY, odometry(stamp, frames, (R, np.array([x, y, 0.0])), twist))

    def _camera_info(self, _due: int, stamp: int) -> None:
        self.publish(Role.CAMERA_INFO, camera_info(stamp, self._pixy.calibration))

    def _condition(self, _due: int, stamp: int) -> None:
        self.publish(Role.STATE, state(stamp, armed=True))
        self.publish(Role.REMOTE, remote(stamp))
        self.publish(Role.BATTERY, battery(stamp, FULL))
