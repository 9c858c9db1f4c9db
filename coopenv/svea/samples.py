"""What messages of cars tell, checked and in this project's conventions, whatever network or bag they came from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coopenv.svea.topics import Role

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
class Pose:
    """A pose of base_link in the map."""

    position: Array  # (3,) m
    rotation: Array | None = None  # (3, 3) body to map
    covariance: Array | None = None  # (6, 6) position then rotation about the map's axes, as ROS has it


@dataclass(frozen=True, slots=True)
class Report:
    """What `robust` sends, see `coopenv.observers.robust.messages`."""

    position: Array | None  # None: the sender does not know where it is
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


@dataclass(frozen=True, slots=True)
class Status:
    """What a car says of itself."""

    armed: bool | None = None
    mode: str | None = None  # of the autopilot
    pulses: tuple[int, ...] | None = None  # us, of the remote control's channels; empty: it has no signal
    battery: float | None = None  # share that is left


Value = Detections | Twist | Pose | Report | Calibration | Status


@dataclass(frozen=True, slots=True)
class Sample:
    """What one message told."""

    car: str
    role: Role
    stamp: int  # ns, clock of the sender
    received: int  # ns, clock of the receiver
    value: Value
