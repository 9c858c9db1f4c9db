"""Decoded messages as checked values in this project's conventions, from ROS 1 or ROS 2; rays of a camera's pixels."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, listed, shown
from coopenv.cars.deployment import MOST_CHANNELS
from coopenv.cars.profile import GATE_TYPES, CarProfile, MotionCommand, Role
from coopenv.cars.vision import FINDERS, Lens, VisionSettings
from coopenv.estimation.lens import undistort
from coopenv.estimation.poses import Array, log_so3
from coopenv.observers.contract import Message
from coopenv.scenario import base


@dataclass(frozen=True, slots=True)
class Detections:
    """A frame of a camera; at most one detection per marker."""

    markers: tuple[int, ...]  # m numbers of markers (colour signatures)
    bearings: Array  # (m, 3) unit vectors camera -> target, optical frame, without the lens's distortion
    dropped: int = 0  # blocks that were left out: second ones of a marker, beyond the image, not finite
    late: int = 0  # ns from the stamp to the exposure's middle


@dataclass(frozen=True, slots=True)
class Twist:
    """A body's velocity, base_link; None: the sensor does not measure it."""

    linear: Array | None  # (3,) m/s
    angular: Array | None  # (3,) rad/s


@dataclass(frozen=True, slots=True)
class CarPose:
    """A pose of base_link in the map."""

    position: Array  # (3,) m
    rotation: Array | None = None  # (3, 3) body to map
    covariance: Array | None = None  # (6, 6) position then rotation about the map's axes, as ROS has it


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics of a camera; the number of coefficients is that of a model of `coopenv.estimation.lens`."""

    image_size: tuple[int, int]
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    distortion: tuple[float, ...]

    @classmethod
    def of(cls, camera: Any) -> Self:
        """Return the intrinsics of a camera of the scenario."""
        return cls(camera.image_size, camera.focal_length, camera.principal_point, camera.distortion)


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


PLAIN = VisionSettings()
"""Tags of the usual family in frames of a global shutter."""


def vector(value: Any, field: str, most: float) -> Array:
    """Return x, y, z as (3,), none of them larger than `most`."""
    return numbers_of((value.x, value.y, value.z), field, most)


def numbers_of(values: Any, field: str, most: float) -> Array:
    """Return numbers as an array. Raises CoopenvError: one is not finite, or larger than `most`."""
    numbers = np.array(values, dtype=np.float64)
    if not (np.abs(numbers) <= most).all():
        raise CoopenvError(f"{field}: {shown(numbers.tolist())} is not finite, or beyond {most:g}")
    return numbers


def covariance_of(values: Any, field: str) -> Array:
    """Return (6, 6) numbers whose diagonal is not negative and that are symmetric."""
    matrix = numbers_of(values, field, 1e12).reshape(6, 6)
    if not matrix.any():  # often: not known
        return matrix
    if (matrix.diagonal() < 0.0).any() or (np.abs(matrix - matrix.T) > 1e-9 + 1e-6 * np.abs(matrix.T)).any():
        raise CoopenvError(f"{field}: is no covariance (symmetric, no negative variance)")
    return matrix


UNIT = 1e-3
"""How far from 1 the length of a quaternion or a bearing may be: single precision and rounded decimals are nearer."""


def rotation_of(quaternion: Any, field: str) -> Array:
    """Return the rotation matrix (3, 3) of a message's quaternion. Raises CoopenvError: its length is not 1."""
    wxyz = [float(getattr(quaternion, part)) for part in "wxyz"]
    length = math.hypot(*wxyz)
    if not abs(length - 1.0) <= UNIT:
        raise CoopenvError(f"{field}: no unit quaternion, its length is {length:.6g}")
    return base.rotation_of(None, wxyz)


def rays(pixels: Array, calibration: Calibration) -> tuple[Array, NDArray[np.bool_]]:
    """Return the rays of pixels.

    Args:
        pixels: (m, 2) to the right and down from the image's corner.
        calibration: of the camera.

    Returns:
        (m, 3) unit vectors in the optical frame, and (m,) which are rays: of pixels in the image that the lens gives.
    """
    size, focal, centre = (
        np.asarray(v, dtype=np.float64)
        for v in (calibration.image_size, calibration.focal_length, calibration.principal_point)
    )
    inside = ((pixels >= 0.0) & (pixels < size)).all(axis=-1)
    flat, there = undistort((pixels - centre) / focal, calibration.distortion)
    through = np.concatenate([flat, np.ones((len(flat), 1))], axis=-1)
    return through / np.linalg.norm(through, axis=-1, keepdims=True), inside & there


@lru_cache(maxsize=2**17)
def ray_of(calibration: Calibration, u: int, v: int) -> tuple[float, float, float] | None:
    """Return the ray of a whole pixel, as `rays` does; None: it has none. There are few enough to remember them all."""
    unit, there = rays(np.array([[u, v]], dtype=np.float64), calibration)
    x, y, z = unit[0].tolist()
    return (x, y, z) if there[0] else None


MOST = 1000
"""Blocks of a frame."""


def detections(message: Any, calibration: Calibration, known: Collection[int] | None) -> Detections:
    """Return the bearings of an ObjectInfoArrayStamped, by the largest block of each marker.

    Dropped and counted: other blocks of a marker, those of unknown markers, without an area, or outside the image.
    """
    blocks = _few(message.objects, "objects")
    width, height = calibration.image_size
    found = []
    for block in blocks:
        u, v, marker = int(block.center_x), int(block.center_y), int(block.signature)
        if 0 <= u < width and 0 <= v < height and block.width >= 0 and block.height >= 0:
            found.append((marker, int(block.width) * int(block.height), ray_of(calibration, u, v)))
    return _largest(found, len(blocks), known)


def bearings(message: Any, calibration: Calibration | None, known: Collection[int] | None) -> Detections:
    """Return the bearings of an ObjectBearingArrayStamped, whose vectors point from the target to the camera.

    Args:
        message: of the authors' node, which keeps the order of the camera, largest block first: the first counts.
        calibration: of the camera if distortion was not removed from the pixels of the vectors: then they give back
            the pixels. None: it was.
        known: markers that there are (None: all).

    Dropped and counted: later ones of a marker, those of unknown markers, without length 1, and with a calibration
    those outside the image.
    """
    rows = [(b.id, b.bearing_x, b.bearing_y, b.bearing_z) for b in _few(message.bearing, "bearing")]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    with np.errstate(all="ignore"):
        rays_ = -table[:, 1:]
        lengths = np.linalg.norm(rays_, axis=-1)
        there = np.abs(lengths - 1.0) <= UNIT
        rays_ /= lengths[:, None]
        if calibration is not None:
            there &= rays_[:, 2] > 1e-6
            flat = np.where(there[:, None], rays_[:, :2] / rays_[:, 2:], 0.0)
            pixels = flat * calibration.focal_length + np.asarray(calibration.principal_point)
            rays_, imaged = rays(np.round(pixels, 3), calibration)  # of single precision
            there &= imaged
    found = [(int(marker), 0, ray) for marker, ray in zip(table[there, 0], rays_[there], strict=True)]
    return _largest(found, len(table), known)


def tags(
    message: Any, calibration: Calibration, known: Collection[int] | None, vision: VisionSettings = PLAIN
) -> Detections:
    """Return the bearings of tags in a frame, or of another detector's message, by the largest of each number."""
    lens = Lens(calibration.image_size, partial(rays, calibration=calibration))
    found = FINDERS[message.__msgtype__](message, vision, lens)
    late = vision.late([tag.row for tag in found if tag.row is not None], lens.image_size[1])
    return replace(_largest([tag[:3] for tag in found], len(found), known), late=late)


def _few(entries: Any, field: str) -> Any:
    if len(entries) > MOST:
        raise CoopenvError(f"{field}: {len(entries)} entries, a camera has at most {MOST}")
    return entries


def _largest(found: Sequence[tuple[int, float, Any]], total: int, known: Collection[int] | None) -> Detections:
    """Return the first largest entry (marker, size, ray or None) of each known marker, of so many entries in all."""
    best: dict[int, tuple[float, Any]] = {}
    for marker, size, ray in found:
        counts = ray is not None and (known is None or marker in known)
        if counts and (marker not in best or size > best[marker][0]):
            best[marker] = size, ray
    unit = np.array([best[marker][1] for marker in sorted(best)], dtype=np.float64).reshape(-1, 3)
    return Detections(tuple(sorted(best)), unit, total - len(best))


LONGEST_MODE = 64  # characters


LENSES = {"plumb_bob": 5, "": 5, "rational_polynomial": 8, "equidistant": 4, "fisheye": 4}
"""Coefficients by the name of the model; missing ones are 0."""


def calibration_of(message: Any, rectified: bool = False) -> Calibration:
    """Return the intrinsics of a CameraInfo, of its rectified frames if asked for; ROS 1 writes their names large."""
    size = (int(message.width), int(message.height))
    if not all(0 < side <= 100_000 for side in size):
        raise CoopenvError(f"width, height: {size} is no image")
    if message.distortion_model not in LENSES:
        raise CoopenvError(f"distortion_model: {shown(message.distortion_model)} is none of {listed(list(LENSES))}")
    matrix = numbers_of(getattr(message, "k", getattr(message, "K", ())), "k", 1e6)
    given = numbers_of(getattr(message, "d", getattr(message, "D", ())), "d", 1e6)
    if matrix.shape != (9,) or min(matrix[0], matrix[4]) <= 0.0 or matrix[1] != 0.0:
        raise CoopenvError("k: no camera matrix with two positive focal lengths and no skew")
    count = LENSES[message.distortion_model]
    if given[count:].any() or (given.size < count and given.size not in (0, 4)):
        raise CoopenvError(f"d: {given.size} numbers, {message.distortion_model or 'plumb_bob'} has {count}")
    bent = (*map(float, given[:count]), *[0.0] * (count - given.size))
    focal, centre = (float(matrix[0]), float(matrix[4])), (float(matrix[2]), float(matrix[5]))
    if rectified:
        projection, bent = numbers_of(getattr(message, "p", getattr(message, "P", ())), "p", 1e6), (0.0,) * 5
        if projection.shape == (12,) and projection.any():
            focal, centre = (float(projection[0]), float(projection[5])), (float(projection[2]), float(projection[6]))
    return Calibration(size, focal, centre, bent)


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


FARTHEST, FASTEST, SPINNING = 1e7, 200.0, 100.0
"""m, m/s and rad/s beyond which a value is no car's."""


def read(
    role: Role,
    message: Any,
    calibration: Calibration | None = None,
    *,
    distorted: bool = True,
    known: Collection[int] | None = None,
    vision: VisionSettings = PLAIN,
) -> Value:
    """Return the value of a message.

    Args:
        role: of its topic.
        message: as rosbags decodes it.
        calibration: of the camera; needed for pixels, and for bearings that were made without removing distortion.
        distorted: whether `bearings` were made so.
        known: markers that there are; detections of others are dropped and counted (None: all count).
        vision: what frames of a camera are of.

    Raises:
        CoopenvError: one line that names the role and the field: a type that the role has not, a value that is not
            finite or is absurd, a quaternion without length 1, or no calibration where one is needed.
    """
    kind = getattr(message, "__msgtype__", type(message).__name__)
    readers = READERS.get(role, {})
    if kind not in readers:
        raise CoopenvError(f"{role}: type {shown(kind)} is none of {listed(list(readers)) or 'those that are read'}")
    try:
        if role is Role.CAMERA_INFO:
            return calibration_of(message, vision.rectified)
        if role not in (Role.DETECTIONS, Role.BEARINGS):
            return readers[kind](message)
        needed = role is Role.DETECTIONS or distorted
        if needed and calibration is None:
            raise CoopenvError("the camera's calibration is not known")
        if kind in FINDERS and calibration is not None:
            return tags(message, calibration, known, vision)
        return readers[kind](message, calibration if needed else None, known)
    except CoopenvError as error:
        raise CoopenvError(f"{role}: {error}") from None


def _twist(message: Any) -> Twist:
    """Return the velocities of a TwistWithCovarianceStamped; a negative variance means not measured."""
    with_covariance = message.twist
    linear, angular = _velocities(with_covariance.twist)
    variances = np.asarray(with_covariance.covariance, dtype=np.float64).reshape(6, 6).diagonal()
    return Twist(None if variances[0] < 0.0 else linear, None if variances[5] < 0.0 else angular)


def _velocities(twist: Any) -> tuple[Array, Array]:
    return vector(twist.linear, "twist.linear", FASTEST), vector(twist.angular, "twist.angular", SPINNING)


def _turning(message: Any) -> Twist:
    """Return the turn rate of an Imu; -1 as first covariance means not measured."""
    if float(message.angular_velocity_covariance[0]) == -1.0:
        return Twist(None, None)
    return Twist(None, vector(message.angular_velocity, "angular_velocity", SPINNING))


def _pose_with_covariance(message: Any) -> CarPose:
    """Return the pose of a PoseWithCovarianceStamped or Odometry; a covariance of zeros means unknown."""
    covariance = covariance_of(message.pose.covariance, "pose.covariance")
    return replace(_placed(message.pose.pose), covariance=covariance if covariance.any() else None)


def _placed(pose: Any) -> CarPose:
    return CarPose(vector(pose.position, "pose.position", FARTHEST), rotation_of(pose.orientation, "pose.orientation"))


def _report(message: Any) -> Message:
    """Return the message of the observer `robust`, see `coopenv.observers.robust.messages`; none: no position."""
    if not message.valid:
        return Message()
    pose, odometry = _placed(message.pose), message.odometry
    moved = vector(odometry.position, "odometry.position", FARTHEST)
    turned = log_so3(rotation_of(odometry.orientation, "odometry.orientation"))
    extra: dict[str, Any] = {
        "odometry": np.concatenate([turned, moved]),
        "depends_on": np.array([message.depends_on], dtype=np.uint64),
        "correlated_vehicles": np.zeros(0, np.uint16),  # a report counts; of correlations it has none
        "ages": np.zeros(0, np.float32),
        "correlations": np.zeros((0, 6, 6), np.int8),
    }
    return Message(pose.position, pose.rotation, covariance_of(message.covariance, "covariance"), extra)


POSES: dict[str, Callable[[Any], Value]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: _placed(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_with_covariance,
    "nav_msgs/msg/Odometry": _pose_with_covariance,
}
TWISTS: dict[str, Callable[[Any], Value]] = {
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist,
    "geometry_msgs/msg/TwistStamped": lambda message: Twist(*_velocities(message.twist)),
    "nav_msgs/msg/Odometry": lambda message: Twist(*_velocities(message.twist.twist)),  # in the child frame
}
READERS: dict[Role, dict[str, Callable[..., Value]]] = {
    Role.DETECTIONS: {"pixy_camera/msg/ObjectInfoArrayStamped": detections, **dict.fromkeys(FINDERS, tags)},
    Role.BEARINGS: {"pixy_camera/msg/ObjectBearingArrayStamped": bearings},
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
"""Types of a role, and what reads them; the message to the wheels depends on the profile."""


def check_types(profile: CarProfile, where: str) -> None:
    """Refuse a profile with a type that cannot be read in its role, with a CoopenvError that begins with `where`."""
    for role, readers in READERS.items():
        if (kind := profile.topics[role].type) not in readers:
            raise CoopenvError(f"{where}: profile: topics.{role}.type: {kind} is none of {listed(list(readers))}")
