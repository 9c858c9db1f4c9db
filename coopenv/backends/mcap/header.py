"""What a recording says once: who is there, gains, noise, starts, and the scenario it came from (`recording.json`)."""

import json
import math
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError

from coopenv.base.errors import DataError
from coopenv.base.format import jsonable
from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Drawn, Recording
from coopenv.scenario.base import Number, Part, Vector3, one_line
from coopenv.scenario.files import parse_scenario
from coopenv.scenario.own_terms import without_own_terms

Index = Annotated[int, Field(ge=0, lt=2**31)]

Vector6 = tuple[Number, Number, Number, Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix6 = tuple[Vector6, Vector6, Vector6, Vector6, Vector6, Vector6]


class NoiseHeader(Part):
    """A `SensorNoise`."""

    velocity: Number
    angular_velocity: Number
    odometry_period: Number
    bearing: Number
    image_axis: Vector3 | None
    odometry_scale: Number = 0.0
    odometry_scale_walk: Number = 0.0
    gyro_bias: Vector3 = (0.0, 0.0, 0.0)
    gyro_bias_walk: Vector3 = (0.0, 0.0, 0.0)
    slip: tuple[Number, Number, Number, Number] = (0.0, 1.0, 0.0, 0.0)
    camera_orientation: Number = 0.0
    camera_position: Number = 0.0
    focal_length: Number = 0.0
    clock_offset: Number = 0.0


class GainsHeader(Part):
    """The `Gains` of one vehicle."""

    k: Number
    q: tuple[Number, ...]
    V: tuple[Number, Number]
    P0: tuple[Number, Number]
    max_turn: Number


class SetupHeader(Part):
    """The `Setup` of one vehicle."""

    vehicle: Index
    name: str
    target_names: tuple[str, ...]
    landmarks: Index
    targets: tuple[Index, ...]
    lever_arm: Vector3
    marker: Vector3
    planar: bool
    noise: NoiseHeader
    gains: GainsHeader


class DrawnHeader(Part):
    """A `Drawn`."""

    key: int
    episode: int
    parameters: tuple[Number, ...]


class Header(Part):
    """Everything of a `Recording` that does not change from tick to tick; `check_recording` knows what makes sense."""

    ticks: int = Field(ge=1)
    dt: Number
    order: tuple[Index, ...]
    period: int
    staleness: Number | None
    """s; none: messages are used for ever."""
    setups: tuple[SetupHeader, ...] = Field(min_length=1)
    start_rotation: tuple[Matrix3, ...]
    start_position: tuple[Vector3, ...]
    start_covariance: tuple[Matrix6, ...]
    scenario: dict[str, Any] | None
    drawn: DrawnHeader | None = None

    @classmethod
    def read(cls, text: bytes, where: str) -> Self:
        """Return a header from its JSON. Raises DataError: it is no header; `where` begins the line."""
        try:
            return cls.model_validate_json(text, strict=True)
        except ValidationError as error:
            raise DataError(one_line(error, where, cls)) from None

    def constants(self, where: str) -> dict[str, Any]:
        """Return the arguments of a `Recording` that the header gives; a ScenarioError if its scenario is none."""
        return {
            "setups": tuple(_setup(setup) for setup in self.setups),
            "order": self.order,
            "dt": self.dt,
            "period": self.period,
            "staleness": math.inf if self.staleness is None else self.staleness,
            "start_rotation": np.array(self.start_rotation),
            "start_position": np.array(self.start_position),
            "start_covariance": np.array(self.start_covariance),
            "drawn": None if self.drawn is None else Drawn(**dict(self.drawn)),
            "scenario": None if self.scenario is None else parse_scenario(without_own_terms(self.scenario), where),
        }


def header_of(recording: Recording) -> bytes:
    """Return the header of a recording as JSON."""
    values = jsonable({name: getattr(recording, name) for name in Header.model_fields})
    if values["scenario"] is not None:
        values["scenario"] = without_own_terms(values["scenario"])
    return json.dumps(values, separators=(",", ":")).encode()


def _setup(header: SetupHeader) -> Setup:
    arrays = {
        "targets": np.array(header.targets, np.int64),
        "lever_arm": np.array(header.lever_arm),
        "marker": np.array(header.marker),
        "noise": SensorNoise(**dict(header.noise)),
        "gains": Gains(**{**dict(header.gains), "q": np.array(header.gains.q)}),
    }
    return Setup(**{**dict(header), **arrays})
