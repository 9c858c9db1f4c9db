"""The constants that a calibration estimates, and their places in the vector of all."""

from collections.abc import Sequence
from typing import NamedTuple

from coopenv.cars.calibration.drives import CarDrive
from coopenv.estimation.lens import COEFFICIENTS


class ParameterKind(NamedTuple):
    """A constant: a deviation from its given value."""

    name: str
    unit: str
    prior: float  # standard deviation; rad for deg
    step: float  # of differences
    part: str = ""  # title of the finding that names it


PER_CAR = (
    *(ParameterKind(f"camera.{name}", "deg", 0.2, 1e-6, "camera orientation") for name in ("roll", "pitch", "yaw")),
    *(ParameterKind(f"camera.{name}", "m", 0.3, 1e-6, "camera position") for name in "xyz"),
    *(ParameterKind(f"camera.{name}", "px", 40.0, 1e-4, "focal length") for name in ("fx", "fy")),
    *(ParameterKind(f"camera.{name}", "px", 40.0, 1e-4, "principal point") for name in ("cx", "cy")),
    *(
        ParameterKind("camera.", "", 0.0, 1e-7, "lens distortion") for _ in range(max(COEFFICIENTS))
    ),  # by the model of the lens
    ParameterKind("wheel.scale", "", 0.15, 1e-7, "wheel scale"),
    ParameterKind("gyro.bias", "rad/s", 0.1, 1e-7, "gyro bias"),
    ParameterKind("camera.offset", "s", 0.5, 1e-5, "stamps"),
    ParameterKind("wheel.offset", "s", 0.05, 1e-5, "stamps"),
    ParameterKind("truth.offset", "s", 0.5, 1e-5, "stamps"),
    ParameterKind("truth.body_yaw", "deg", 0.2, 1e-6, "body of motion capture"),
    *(ParameterKind(f"truth.body_{axis}", "m", 0.1, 1e-6, "body of motion capture") for axis in "xy"),
)
"""Constants of a car."""
FRAME = (
    ParameterKind("truth.frame_yaw", "deg", 0.2, 1e-6, "frame of motion capture"),
    *(ParameterKind(f"truth.frame_{axis}", "m", 0.3, 1e-6, "frame of motion capture") for axis in "xy"),
)
BENT = {"k1": 0.5, "k2": 0.5, "p1": 0.02, "p2": 0.02}
"""Priors of coefficients; 0.2 for all others."""
ROT, LEVER, LENS, SCALE, BIAS = slice(0, 3), slice(3, 6), slice(6, 18), 18, 19
CAMERA_TIME, WHEEL_TIME, TRUTH_TIME, BODY = 20, 21, 22, slice(23, 26)
NUISANCE = (SCALE, BIAS)
"""Constants that every drive has anew."""


def kinds_of(cars: Sequence[CarDrive], landmarks: Sequence[str]) -> list[ParameterKind]:
    """Return the constants of cars, of the markers of landmarks, and of the frame of motion capture."""
    found = list[ParameterKind]()
    for car in cars:
        own, names = [*PER_CAR], () if car.lens is None else COEFFICIENTS[len(car.lens.distortion)]
        for n, name in enumerate(names, LENS.start + 4):
            own[n] = own[n]._replace(name=own[n].name + name, prior=BENT.get(name, 0.2))
        found += [kind._replace(name=f"{car.name}.{kind.name}", part=f"{car.name}: {kind.part}") for kind in own]
    for mark in landmarks:
        found += [ParameterKind(f"marker.{mark}.{axis}", "m", 0.3, 1e-6, f"marker {mark}: position") for axis in "xyz"]
    return [*found, *FRAME]
