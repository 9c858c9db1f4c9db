"""Decoded messages as checked values in this project's conventions, from ROS 1 or ROS 2."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, listed, shown
from coopenv.cars.gate.wheel_command import MotionCommand
from coopenv.cars.messages.codec import numbers_after_header
from coopenv.cars.messages.detectors import BEARINGS, FINDERS, PLACED
from coopenv.cars.messages.stated import NOTHING, Stated, stated
from coopenv.cars.messages.vision import Calibration, Quality, Tag
from coopenv.cars.settings.profile import GATE_TYPES, MOST_CHANNELS, CarProfile, Role, VisionSettings
from coopenv.estimation.poses import Array, log_so3
from coopenv.observers.contract import Message
from coopenv.scenario import sensing


@dataclass(frozen=True, slots=True)
class Detections:
    """A frame of a camera; at most one detection per marker."""

    markers: tuple[int, ...]  # m numbers of markers (colour signatures)
    bearings: Array  # (m, 3) unit vectors camera -> target, optical frame, without the lens's distortion
    dropped: int = 0  # blocks that were left out: second ones of a marker, beyond the image, not finite, of low quality
    late: int = 0  # ns from the stamp to the exposure's middle
    qualities: tuple[Quality, ...] = ()  # (m,) as the detector states them; empty: made without a detector
    poor: int = 0  # of those left out, of low quality
    outside: int = 0  # likewise, beyond the image or without a ray


@dataclass(frozen=True, slots=True)
class Twist:
    """A body's velocity, base_link; None: the sensor does not measure it."""

    linear: Array | None  # (3,) m/s
    angular: Array | None  # (3,) rad/s
    pose: "CarPose | None" = None  # of the same message, in a frame of its own


@dataclass(frozen=True, slots=True)
class CarPose:
    """A pose of base_link in the map."""

    position: Array  # (3,) m
    rotation: Array | None = None  # (3, 3) body to map
    covariance: Array | None = None  # (6, 6) position then rotation about the map's axes, as ROS has it


@dataclass(frozen=True, slots=True)
class CarStatus:
    """Condition of a car."""

    armed: bool | None = None
    mode: str | None = None  # of the autopilot
    pulses: tuple[int, ...] | None = None  # us, of the remote control's channels; empty: it has no signal
    battery: float | None = None  # share that is left


Value = Detections | Twist | CarPose | Message | Calibration | CarStatus | MotionCommand


@dataclass(frozen=True, slots=True)
class Sample:
    """Value of one message."""

    car: str
    role: Role
    stamp: int  # ns, clock of the sender
    received: int  # ns, clock of the receiver
    value: Value
    stated: Stated = NOTHING  # beside the value, untested

    def at(self, stamp: int, received: int) -> "Sample":
        """Return the sample with other times."""
        return Sample(self.car, self.role, stamp, received, self.value, self.stated)


PLAIN = VisionSettings()
"""Tags of the usual family in frames of a global shutter."""


def vector(value: Any, field: str, most: float) -> Array:
    """Return x, y, z as (3,), none of them larger than `most`."""
    return numbers_of((value.x, value.y, value.z), field, most)


def numbers_of(values: Any, field: str, most: float) -> Array:
    """Return numbers as an array. Raises CoopenvError: one is not finite, or larger than `most`."""
    numbers = np.array(values, dtype=np.float64)
    if not all(abs(number) <= most for number in numbers.tolist()):
        raise CoopenvError(f"{field}: {shown(numbers.tolist())} is not finite, or beyond {most:g}")
    return numbers


ASYMMETRY = 1e-3
"""Tolerance of a covariance's symmetry, in shares of its standard deviations; single precision is within it."""


def covariance_of(values: Any) -> Array | None:
    """Return a covariance (6, 6); None: it is not known. Zeros, -1, NaN, and what is no covariance mean that."""
    return _covariance(np.asarray(values, dtype=np.float64).tobytes())


@lru_cache(maxsize=256)  # most messages of a topic have the same
def _covariance(values: bytes) -> Array | None:
    matrix = np.frombuffer(values).reshape(6, 6)
    diagonal = matrix.diagonal()
    if not (np.abs(matrix) <= 1e12).all() or not matrix.any() or (diagonal < 0.0).any():
        return None
    deviations = np.sqrt(diagonal)
    alike = np.abs(matrix - matrix.T) <= ASYMMETRY * np.outer(deviations, deviations)
    return 0.5 * (matrix + matrix.T) if alike.all() else None


LENGTH = 0.05
"""Tolerance of the length of a quaternion, which is normalised."""


def rotation_of(quaternion: Any, field: str) -> Array:
    """Return the rotation matrix (3, 3) of a message's quaternion. Raises CoopenvError: its length is far from 1."""
    wxyz = [float(getattr(quaternion, part)) for part in "wxyz"]
    length = math.hypot(*wxyz)
    if not abs(length - 1.0) <= LENGTH:
        raise CoopenvError(f"{field}: no unit quaternion, its length is {length:.6g}")
    return sensing.rotation_of(None, wxyz)


MOST = 1000
"""Detections in a frame."""


def tags(
    message: Any, camera: Calibration | None, known: Collection[int] | None, vision: VisionSettings = PLAIN
) -> Detections:
    """Return the bearings of a frame or of a detector's message, by the first largest entry of each known number.

    Dropped and counted: others of a number, those of unknown numbers, and those without a ray, see `FINDERS`.
    """
    found, best = FINDERS[message.__msgtype__](message, vision, camera), dict[int, Tag]()
    if len(found) > MOST:
        raise CoopenvError(f"{len(found)} detections, a camera has at most {MOST}")
    for tag in found:
        counts = tag.ray is not None and not tag.quality.is_poor(vision) and (known is None or tag.number in known)
        if counts and (tag.number not in best or tag.size > best[tag.number].size):
            best[tag.number] = tag
    units = np.array([best[number].ray for number in sorted(best)], dtype=np.float64).reshape(-1, 3)
    rows = [tag.row for tag in found if tag.row is not None]
    late = vision.late(rows, camera.image_size[1]) if camera else 0
    numbers = sorted(best)
    qualities = tuple(best[n].quality for n in numbers)
    poor, outside = sum(tag.quality.is_poor(vision) for tag in found), sum(tag.ray is None for tag in found)
    return Detections(tuple(numbers), units, len(found) - len(best), late, qualities, poor, outside)


LONGEST_MODE = 64  # characters

LENSES = {"plumb_bob": 5, "": 5, "rational_polynomial": 8, "equidistant": 4, "fisheye": 4}
"""Coefficients by the name of the model; missing ones are 0."""


def calibration_of(message: Any, rectified: bool = False) -> Calibration:
    """Return the intrinsics of a CameraInfo, of its rectified frames if asked for; ROS 1 writes their names large."""
    size = (int(message.width), int(message.height))
    if not all(0 < side <= 100_000 for side in size):
        raise CoopenvError(f"width, height: {size} is no image")
    matrix = numbers_of(getattr(message, "k", getattr(message, "K", ())), "k", 1e6)
    given = numbers_of(getattr(message, "d", getattr(message, "D", ())), "d", 1e6)
    model = message.distortion_model if given.any() else ""  # without distortion its name says nothing
    if model not in LENSES:
        raise CoopenvError(f"distortion_model: {shown(model)} is none of {listed(list(LENSES))}")
    if matrix.shape != (9,) or min(matrix[0], matrix[4]) <= 0.0 or matrix[1] != 0.0:
        raise CoopenvError("k: no camera matrix with two positive focal lengths and no skew")
    count = LENSES[model]
    if given[count:].any() or (given.size < count and given.size not in (0, 4)):
        raise CoopenvError(f"d: {given.size} numbers, {model or 'plumb_bob'} has {count}")
    bent = (*map(float, given[:count]), *[0.0] * (count - given.size))
    focal, centre = (float(matrix[0]), float(matrix[4])), (float(matrix[2]), float(matrix[5]))
    if rectified:
        projection, bent = numbers_of(getattr(message, "p", getattr(message, "P", ())), "p", 1e6), (0.0,) * 5
        if projection.shape == (12,) and projection.any():
            focal, centre = (float(projection[0]), float(projection[5])), (float(projection[2]), float(projection[6]))
    return _of_image(Calibration(size, focal, centre, bent), stated(message))


def _of_image(sensor: Calibration, about: Stated) -> Calibration:
    """Return the intrinsics of an image by those of the whole sensor, of which it has a region and bins pixels."""
    left, top, *sides = about.region
    width, height = sides if all(sides) else sensor.image_size
    return Calibration(
        (width // about.binning[0], height // about.binning[1]),
        (sensor.focal_length[0] / about.binning[0], sensor.focal_length[1] / about.binning[1]),
        ((sensor.principal_point[0] - left) / about.binning[0], (sensor.principal_point[1] - top) / about.binning[1]),
        sensor.distortion,
    )


def state_of(message: Any) -> CarStatus:
    """Return whether a car's autopilot is armed and connected, and in which mode."""
    return CarStatus(armed=bool(message.armed and message.connected), mode=str(message.mode)[:LONGEST_MODE])


def remote_of(message: Any) -> CarStatus:
    """Return the pulses of a car's remote control; none with a signal strength of 0, and 255 means unknown."""
    return CarStatus(pulses=tuple(int(pulse) for pulse in message.channels[:MOST_CHANNELS]) if message.rssi else ())


def battery_of(message: Any) -> CarStatus:
    """Return the share that is left; NaN and -1 mean unknown."""
    share = float(message.percentage)
    if np.isnan(share) or share == -1.0:
        return CarStatus()
    if not 0.0 <= share <= 1.0:
        raise CoopenvError(f"percentage: {share:g} is not in 0..1")
    return CarStatus(battery=share)


OTHER_FIELDS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""Errors of reading a message of a bag whose definition has other fields than ours."""

FARTHEST, FASTEST, SPINNING = 1e7, 200.0, 100.0
"""m, m/s and rad/s beyond which a value is no car's."""
ABSURD = 1e6
"""Speeds and turn rates beyond which a value is none, in whatever unit."""
COMMON = 0.02
"""Share of a topic's messages beyond what a car does from which they are in another unit, and no outliers."""


def read(
    role: Role,
    message: Any,
    calibration: Calibration | None = None,
    *,
    distorted: bool = True,
    known: Collection[int] | None = None,
    vision: VisionSettings = PLAIN,
    any_unit: bool = False,
) -> Value:
    """Return the value of a message.

    Args:
        role: of its topic.
        message: as rosbags decodes it.
        calibration: of the camera; needed for pixels, and for bearings that were made without removing distortion.
        distorted: `bearings` were computed from distorted pixels.
        known: markers that there are; detections of others are dropped and counted (None: all count).
        vision: markers in the frames of a camera.
        any_unit: a velocity may be in another unit than m/s and rad/s; see `implausible`.

    Raises:
        CoopenvError: one line that names the role and the field: a type that the role has not, a value that is not
            finite or is absurd, a quaternion without length 1, or no calibration where one is needed.
    """
    kind = getattr(message, "__msgtype__", type(message).__name__)
    readers = READERS.get(role, {})
    if kind not in readers:
        raise CoopenvError(f"{role}: type {shown(kind)} is none of {listed(list(readers)) or 'the readable types'}")
    try:
        if role is Role.CAMERA_INFO:
            return calibration_of(message, vision.rectified)
        if role not in (Role.DETECTIONS, Role.BEARINGS):
            value = readers[kind](message)
            if not any_unit and (why := implausible(Sample("", role, 0, 0, value))):
                raise CoopenvError(why)
            return value
        needed = kind not in PLACED and (role is Role.DETECTIONS or distorted)
        if needed and calibration is None:
            raise CoopenvError("the camera's calibration is not known")
        settings = vision if role is Role.DETECTIONS else PLAIN  # bearings have their final stamps
        return tags(message, calibration if needed else None, known, settings)
    except CoopenvError as error:
        raise CoopenvError(f"{role}: {error}") from None
    except OTHER_FIELDS as error:
        raise CoopenvError(f"{role}: {kind} has other fields than expected ({error})") from None


def implausible(sample: Sample) -> str:
    """Return in words why a velocity is no car's in m/s and rad/s; empty: it may be one, or is none."""
    value, turning = sample.value, "angular_velocity" if sample.role is Role.IMU else "twist.angular"
    if isinstance(value, Twist):
        for field, part, most in (("twist.linear", value.linear, FASTEST), (turning, value.angular, SPINNING)):
            if part is not None and not (np.abs(part) <= most).all():
                return f"{field}: {shown(part.tolist())} is not finite, or beyond {most:g}"
    return ""


def without_outliers(samples: Sequence[Sample], refused: Counter[str]) -> list[Sample]:
    """Return the samples of a topic without velocities that are no car's, which are counted by reason.

    If they are common, the topic is in another unit, which the doctor names: all samples are returned.
    """
    why = [implausible(sample) for sample in samples]
    if sum(map(bool, why)) > COMMON * len(samples):
        return [*samples]
    refused.update(f"{sample.role}: {text}" for sample, text in zip(samples, why, strict=True) if text)
    return [sample for sample, text in zip(samples, why, strict=True) if not text]


def _twist(twist: Any) -> Twist:
    """Return the velocities of a TwistWithCovariance; a negative variance means not measured."""
    value = _velocities(twist.twist)
    variances = np.asarray(twist.covariance, dtype=np.float64).reshape(6, 6).diagonal()
    linear, angular = (None if variances[k] < 0.0 else part for k, part in ((0, value.linear), (5, value.angular)))
    return Twist(linear, angular)


def _moving_pose(message: Any) -> Twist:
    """Return the velocities of an Odometry with its pose, if that is one."""
    pose = None
    with suppress(CoopenvError):
        pose = placed(message.pose.pose)
    return replace(_twist(message.twist), pose=pose)


def _velocities(twist: Any) -> Twist:
    """Return velocities, in which what is not finite is not measured: a turn rate is unknown, the others are 0."""
    linear, angular = ([part.x, part.y, part.z] for part in (twist.linear, twist.angular))
    linear[1:], angular[:2] = ([v if math.isfinite(v) else 0.0 for v in some] for some in (linear[1:], angular[:2]))
    known = None if math.isnan(angular[2]) else numbers_of(angular, "twist.angular", ABSURD)
    return Twist(numbers_of(linear, "twist.linear", ABSURD), known)


def _turning(message: Any) -> Twist:
    """Return the turn rate of an Imu; -1 as first covariance means not measured."""
    if float(message.angular_velocity_covariance[0]) == -1.0:
        return Twist(None, None)
    turning = message.angular_velocity
    across = [0.0 if math.isnan(value) else value for value in (turning.x, turning.y)]  # as of one axis alone
    return Twist(None, numbers_of([*across, turning.z], "angular_velocity", ABSURD))


def _pose_with_covariance(pose: Any) -> CarPose:
    """Return the pose of a PoseWithCovariance."""
    place = placed(pose.pose)
    return CarPose(place.position, place.rotation, covariance_of(pose.covariance))


def placed(pose: Any) -> CarPose:
    """Return the pose of a Pose or a Transform. Raises CoopenvError: it is none."""
    if hasattr(pose, "translation"):
        turned = rotation_of(pose.rotation, "transform.rotation")
        return CarPose(vector(pose.translation, "transform.translation", FARTHEST), turned)
    return CarPose(vector(pose.position, "pose.position", FARTHEST), rotation_of(pose.orientation, "pose.orientation"))


def _report(message: Any) -> Message:
    """Return the message of the observer `robust`, see `coopenv.observers.robust.messages`; none: no position."""
    if not message.valid:
        return Message()
    pose, odometry = placed(message.pose), message.odometry
    moved = vector(odometry.position, "odometry.position", FARTHEST)
    turned = log_so3(rotation_of(odometry.orientation, "odometry.orientation"))
    extra: dict[str, Any] = {
        "odometry": np.concatenate([turned, moved]),
        "depends_on": np.array([message.depends_on], dtype=np.uint64),
        "correlated_vehicles": np.zeros(0, np.uint16),  # a report counts; of correlations it has none
        "ages": np.zeros(0, np.float32),
        "correlations": np.zeros((0, 6, 6), np.int8),
    }
    if (covariance := covariance_of(message.covariance)) is None:
        raise CoopenvError("covariance: is no covariance (symmetric, no negative variance)")
    return Message(pose.position, pose.rotation, covariance, extra)


POSES: dict[str, Callable[[Any], Value]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: placed(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: _pose_with_covariance(message.pose),
    "nav_msgs/msg/Odometry": lambda message: _pose_with_covariance(message.pose),
    "geometry_msgs/msg/TransformStamped": lambda message: placed(message.transform),
    "geometry_msgs/msg/Pose": placed,
    "geometry_msgs/msg/PoseWithCovariance": _pose_with_covariance,
}
TWISTS: dict[str, Callable[[Any], Value]] = {
    "geometry_msgs/msg/TwistWithCovarianceStamped": lambda message: _twist(message.twist),
    "geometry_msgs/msg/TwistStamped": lambda message: _velocities(message.twist),
    "nav_msgs/msg/Odometry": _moving_pose,  # in the child frame
    "geometry_msgs/msg/Twist": _velocities,
    "geometry_msgs/msg/TwistWithCovariance": _twist,
}
UNSTAMPED = tuple(f"geometry_msgs/msg/{name}{more}" for name in ("Pose", "Twist") for more in ("", "WithCovariance"))
"""Types without a stamp: in bags the time of reception counts, live cars need stamps."""
READERS: dict[Role, dict[str, Callable[..., Value]]] = {
    Role.DETECTIONS: {kind: tags for kind in FINDERS if kind != BEARINGS},
    Role.BEARINGS: {BEARINGS: tags},
    Role.CAMERA_INFO: {"sensor_msgs/msg/CameraInfo": calibration_of},
    Role.ODOMETRY: TWISTS,
    Role.WHEEL: TWISTS,
    Role.IMU: {"sensor_msgs/msg/Imu": _turning},
    Role.ESTIMATE: POSES,
    Role.POINT: {"geometry_msgs/msg/PointStamped": lambda message: CarPose(vector(message.point, "point", FARTHEST))},
    Role.REPORT: {"coopenv_msgs/msg/RobustReport": _report},
    Role.TRUTH: POSES,
    Role.COMMAND: {
        GATE_TYPES[Role.COMMAND]: lambda message: MotionCommand(message.drive.steering_angle, message.drive.speed)
    },
    Role.STATE: {"mavros_msgs/msg/State": state_of},
    Role.REMOTE: {"mavros_msgs/msg/RCIn": remote_of},
    Role.BATTERY: {"sensor_msgs/msg/BatteryState": battery_of},
}
"""Types of a role, and their readers; the message to the wheels depends on the profile."""


def check_types(profile: CarProfile, where: str) -> None:
    """Refuse a profile with a type that cannot be read in its role, with a CoopenvError that begins with `where`."""
    for role, readers in READERS.items():
        if (kind := profile.topics[role].type) not in readers:
            raise CoopenvError(f"{where}: profile: topics.{role}.type: {kind} is none of {listed(list(readers))}")
        if kind in UNSTAMPED:
            raise CoopenvError(f"{where}: profile: topics.{role}.type: {kind} has no stamp, messages of cars need one")
    kind, written = profile.topics[Role.MANUAL].type, [kind for kind, _ in profile.command.neutral.values()]
    if (numbers := numbers_after_header(kind)) != written:
        has = f"has {listed(numbers)} after its header" if numbers else "is no stamped message of numbers"
        raise CoopenvError(f"{where}: profile: command.neutral: {listed(written)}, but topics.manual.type {kind} {has}")


TRACKS = (
    *("wheel_time", "wheel", "gyro_time", "gyro", "truth_time", "truth", "truth_yaw", "truth_pose"),
    *("command_time", "command_speed", "command_steering"),
)


def tracks_of(samples: Sequence[Sample], start: int) -> dict[str, Any]:
    """Return measurements of wheels, gyro and motion capture, and commands, as arrays by the names of `TRACKS`.

    Times are in s since a start, ns; velocities (m/s, body) and places (m, map) are complex numbers x + iy. Poses of
    motion capture are (n, 3, 4): rotations beside positions.
    """
    wheel, gyro, truth, command = [], [], [], []
    for s in samples:
        value, t = s.value, 1e-9 * (s.stamp - start)
        if isinstance(value, Twist):
            wheel += [] if value.linear is None else [(t, complex(*value.linear[:2]))]
            gyro += [] if value.angular is None else [(t, value.angular[2])]
        elif isinstance(value, CarPose) and value.rotation is not None and s.role is Role.TRUTH:
            truth.append((t, complex(*value.position[:2]), yaw_of(value.rotation), pose_of(value)))
        elif isinstance(value, MotionCommand):
            command.append((t, value.speed, value.steering))
    columns = [*_columns(wheel, 2), *_columns(gyro, 2), *_columns(truth, 4), *_columns(command, 3)]
    tracks = dict(zip(TRACKS, columns, strict=True))
    return tracks | {key: tracks[key].real for key in tracks if key not in ("wheel", "truth")}


def sightings_of(
    samples: Sequence[Sample], start: int, known: Mapping[int, int]
) -> tuple[Array, NDArray[np.int64], Array]:
    """Return times (n,), s since a start in ns, targets (n,) by marker, and rays (n, 3) of sightings."""
    seen = [
        (1e-9 * (s.stamp - start), known[marker], *ray)
        for s in samples
        if isinstance(value := s.value, Detections)
        for marker, ray in zip(value.markers, value.bearings, strict=True)
        if marker in known
    ]
    table = np.array(seen, dtype=np.float64).reshape(-1, 5)
    return table[:, 0], table[:, 1].astype(np.int64), table[:, 2:]


def yaw_of(rotation: Array) -> float:
    """Return the heading of a rotation (3, 3), rad."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def pose_of(value: CarPose) -> Array:
    """Return the rotation beside the position (3, 4) of a pose that has both."""
    assert value.rotation is not None
    return np.column_stack([value.rotation, value.position])


def _columns(rows: Sequence[Any], count: int) -> list[Any]:
    return [np.array([row[n] for row in rows]) for n in range(count)]
