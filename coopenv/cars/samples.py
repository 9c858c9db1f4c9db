"""Values of messages of cars, checked and in this project's conventions, from any network or bag."""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.profile import Role

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Detections:
    """A frame of a camera; at most one detection per marker."""

    markers: tuple[int, ...]  # m numbers of markers (colour signatures)
    bearings: Array  # (m, 3) unit vectors camera -> target, optical frame, without the lens's distortion
    dropped: int = 0  # blocks that were left out: second ones of a marker, beyond the image, not finite


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
class RobustReport:
    """Report of the observer `robust`, see `coopenv.observers.robust.messages`."""

    position: Array | None  # None: the sender has no position
    rotation: Array | None
    covariance: Array | None
    extra: dict[str, NDArray[np.float64] | NDArray[np.uint64]]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics of a camera: plumb-bob model."""

    image_size: tuple[int, int]
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    distortion: tuple[float, float, float, float, float]

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


Value = Detections | Twist | CarPose | RobustReport | Calibration | CarStatus


@dataclass(frozen=True, slots=True)
class Sample:
    """Value of one message."""

    car: str
    role: Role
    stamp: int  # ns, clock of the sender
    received: int  # ns, clock of the receiver
    value: Value


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
"""How far from 1 a quaternion's length may be: single precision and rounded decimals are nearer."""


def rotation_of(quaternion: Any, field: str) -> Array:
    """Return the rotation matrix (3, 3) of a message's quaternion. Raises CoopenvError: its length is not 1."""
    w, x, y, z = _unit(quaternion, field)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_vector_of(quaternion: Any, field: str) -> Array:
    """Return the rotation vector (3,) of a message's quaternion, rad; errors as for `rotation_of`."""
    w, x, y, z = _unit(quaternion, field)
    if w < 0.0:  # the shorter way round
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return factor * np.array([x, y, z])


def _unit(quaternion: Any, field: str) -> tuple[float, float, float, float]:
    w, x, y, z = (float(getattr(quaternion, part)) for part in "wxyz")
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(length - 1.0) <= UNIT:
        raise CoopenvError(f"{field}: no unit quaternion, its length is {length:.6g}")
    return w / length, x / length, y / length, z / length
