"""Topics of cars that are read, and constants of `coopenv calibrate` that correct them, live and in bags.

Needs no NumPy, like the gate.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator

from coopenv.base.errors import CoopenvError
from coopenv.base.sections import PositiveVector2, Section, Vector2, read_toml, validated
from coopenv.cars.settings.limits import Number
from coopenv.cars.settings.profile import VELOCITY, Role

if TYPE_CHECKING:
    from coopenv.cars.messages.readings import Twist
    from coopenv.cars.messages.vision import Calibration

Name = Annotated[str, Field(max_length=64, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
TOPIC = r"^/[A-Za-z0-9_/~]{1,255}$"
TopicName = Annotated[str, Field(pattern=TOPIC)]


class Correction(Section):
    """Constants of a car, as `coopenv calibrate` finds them."""

    focal_length: PositiveVector2 | None = None
    """Focal length of its camera, instead of CameraInfo's, px."""
    principal_point: Vector2 | None = None
    """Principal point of its camera, px."""
    distortion: tuple[Number, ...] | None = None
    """Distortion of its camera: 5 or 8 coefficients, or 4 of a fisheye."""
    wheel_scale: float = Field(default=0.0, gt=-1.0, le=10.0)
    """Relative error of its speeds, removed."""
    gyro_bias: Number = 0.0
    """Error of its turn rates, removed, rad/s."""
    wheel_factor: Number = 1.0
    """Factor of its speeds before that, for another unit or sign."""
    gyro_factor: Number = 1.0
    """Factor of its turn rates before that, for another unit or sign."""

    @field_validator("distortion")
    @classmethod
    def _is_of_a_model(cls, given: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if given is not None and len(given) not in (4, 5, 8):
            raise ValueError(f"has {len(given)} coefficients, a model has 4, 5 or 8")
        return given

    @field_validator("wheel_factor", "gyro_factor")
    @classmethod
    def _keeps_the_stream(cls, given: float) -> float:
        if given == 0.0:
            raise ValueError("is 0, which leaves nothing of the stream")
        return given

    def lens(self, lens: "Calibration") -> "Calibration":
        """Return a camera's intrinsics with those that are given here."""
        names = ("focal_length", "principal_point", "distortion")
        return replace(lens, **{name: value for name in names if (value := getattr(self, name)) is not None})

    def twist(self, twist: "Twist", role: Role, by_imu: bool) -> "Twist":
        """Return a measured twist without its errors; `by_imu`: turn rates are the IMU's, not the wheels'."""
        v, w = twist.linear, None if by_imu and role is Role.WHEEL else twist.angular
        linear = None if v is None else v * (self.wheel_factor / (1.0 + self.wheel_scale))
        angular = None if w is None else self.gyro_factor * w - (0.0, 0.0, self.gyro_bias)
        return type(twist)(linear, angular, twist.pose)


Lead = Annotated[float, Field(ge=-2.0, le=2.0)]


class Sensors(Section):
    """Topics that are read."""

    odometry: Literal["wheel+imu", "wheel", "odometry"] = "wheel+imu"
    """Source of the body twist: speed of the wheels and turn rate of the IMU, the wheels alone, or the car's own
    filter."""
    detections: Literal["detections", "bearings"] = "detections"
    """`detections`: pixels, from which distortion is removed on this computer; `bearings`: unit vectors of the authors'
    node."""
    distorted: bool = True
    """Treat `bearings` as computed from distorted pixels, as the authors' are."""
    truth: bool = True
    """Read motion capture. It serves infos, metrics and safety, never observations."""
    corrections: dict[Name, Correction] = Field(default={})
    """Constants by the name of a car, see `calibration`."""
    leads: dict[TopicName, Lead] = Field(default={})
    """Time added to the stamps of a topic in every drive, s."""
    trust: tuple[str, ...] = Field(default=(), max_length=64)
    """Topics, or other subjects of findings, with which cars arm although other streams contradict; `all`: each."""

    @property
    def roles(self) -> tuple[Role, ...]:
        """Roles of the topics that are read."""
        return (*VELOCITY[self.odometry], Role(self.detections), *([Role.TRUTH] if self.truth else []))


class CalibratedClocks(Section):
    """Table `clocks` of a calibration."""

    leads: dict[TopicName, Number] = Field(max_length=64)


class CalibratedConstant(Section):
    """An entry of the table `constants` of a calibration."""

    given: Any = None
    value: Any = None
    standard_error: Any = None
    unit: Literal["deg", "m", "px", "", "rad/s", "s"]
    finding: str = ""


class CalibrationFile(Section):
    """Calibration file of `coopenv calibrate`."""

    overrides: dict[str, Any]
    clocks: CalibratedClocks
    corrections: dict[Name, Correction] = Field(default={})
    constants: dict[str, CalibratedConstant]


def read_calibration(path: Path, where: str, error: type[CoopenvError]) -> dict[str, Any]:
    """Return the tables of a file that `coopenv calibrate` has written.

    Args:
        path: of the file.
        where: begin of the error's line: the file and key that name it.
        error: class of the error.

    Raises:
        CoopenvError: of class `error`; it cannot be read, or is none.
    """
    found = read_toml(path, error)
    validated(CalibrationFile, json.dumps(found, default=str), where, error)
    return found
