"""The MCAP format of a recording: messages with their CDR codec, header, and topics for viewers.

The tick of a message is its sequence number. Standard ROS 2 messages serve viewers; what is read back stands in
messages of this project, in full precision. The header `recording.json` holds what is constant over a recording:
setups, gains, noise, starts, scenario. `is_cut_off` looks into a file without the MCAP library.
"""

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, create_model

from coopenv.base.errors import CoopenvError, DataError, regular
from coopenv.base.format import jsonable
from coopenv.base.installation import install_command, message_types, needing, version
from coopenv.base.sections import Number, Section, Vector3
from coopenv.measurements.named import name_in_logs, reference_of
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Drawn, Recording
from coopenv.scenario import Scenario, parse_scenario
from coopenv.scenario.own_terms import without_own_terms

FORMAT = "coopenv recording 1"
ATTACHMENT = "recording.json"
LANDMARKS = "/landmarks"

EXACT = {
    "increment": "coopenv_msgs/msg/Odometry",
    "bearings": "coopenv_msgs/msg/Bearings",
    "v2x": "coopenv_msgs/msg/Inbox",
    "truth_exact": "coopenv_msgs/msg/Truth",
    "pan": "coopenv_msgs/msg/Pan",
    "bearing_age": "coopenv_msgs/msg/Age",
}
"""Topics of a vehicle that hold the recording, one message a tick."""

CONTENTS = {
    "increment": {name: name for name in ("rotation", "translation", "velocity", "angular_velocity")},
    "bearings": {},
    "pan": {"angle": "pan"},
    "bearing_age": {"age": "bearing_age"},
    "v2x": {"tick_sent": "inbox_tick"},
    "truth_exact": {"rotation": "truth.rotation", "position": "truth.position"},
}
"""Topic to the entries of its messages that hold a vehicle's row of an array of the `Recording`; of bearings only those
that there are hold any."""

READING_TYPE = "coopenv_msgs/msg/Reading"
"""Type of the topic of a sensor beside the camera, `reading_topic`; one message at every tick that has measurements."""

SHOWN = {"odometry": "nav_msgs/msg/Odometry", "truth": "geometry_msgs/msg/PoseStamped"}
"""Topics of a vehicle that viewers understand: dead reckoning from the start, and the truth where it is known."""

LANDMARKS_TYPE = "geometry_msgs/msg/PoseArray"
"""Type of the topic `LANDMARKS`: positions in the map, one message whenever one has changed."""


def topic(vehicle: str, name: str) -> str:
    """Return the full name of a vehicle's topic."""
    return f"/{vehicle}/{name}"


def reading_topic(vehicle: str, sensor: str) -> str:
    """Return the full name of the topic of a vehicle's sensor beside the camera."""
    return f"/{vehicle}/sensors/{sensor}"


def exact_topics(arrays: Collection[str]) -> dict[str, str]:
    """Return the topics of `EXACT` for a recording that has these arrays."""
    return {name: kind for name, kind in EXACT.items() if set(CONTENTS[name].values()) <= set(arrays)}


@cache
def codec() -> Any:
    """Return the store of message types, with ours in it. Raises CoopenvError: the extra is not installed."""
    with needing(f"MCAP files need an extra: {install_command('log')}"):
        import mcap  # noqa: F401

        return message_types("ROS2_JAZZY")


Index = Annotated[int, Field(ge=0, lt=2**31)]

Vector6 = tuple[Number, Number, Number, Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix6 = tuple[Vector6, Vector6, Vector6, Vector6, Vector6, Vector6]


def _section_of(record: Any, **types: Any) -> Any:
    """Return a section with the fields of a dataclass; `types` gives those that JSON has in place of its arrays."""
    columns: dict[str, Any] = {
        field.name: (types.get(field.name, field.type), ... if field.default is MISSING else field.default)
        for field in fields(record)
    }
    return create_model(f"{record.__name__}Header", __base__=Section, **columns)


SensorHeader = _section_of(
    Sensor,
    std=tuple[Number, ...],
    targets=tuple[Annotated[int, Field(ge=MAP, lt=2**31)], ...],
    position=Vector3,
    rotation=Matrix3,
)
Row3 = tuple[Number | None, Number | None, Number | None]  # None: not known
SetupHeader = create_model(
    "SetupHeader",
    __base__=_section_of(
        Setup,
        landmarks=Index,
        targets=tuple[Index, ...],
        lever_arm=Vector3,
        marker=Vector3,
        noise=_section_of(SensorNoise),
        gains=_section_of(Gains, q=tuple[Number, ...]),
        sensors=tuple[SensorHeader, ...],  # type: ignore[valid-type]
        landmark_rotation=tuple[tuple[Row3, Row3, Row3], ...] | None,
    ),
    planar=(bool, False),  # earlier versions wrote it: true of robots on a plane whose odometry is their commands
)
OPTIONAL: dict[type, dict[str, Any]] = {
    of: {field.name: field.default for field in fields(of) if field.default in ((), None, 0.0)}
    for of in (Setup, SensorNoise)
}
"""Entries that a header has only if they are not empty; versions without them read the others' headers."""


class RecordingHeader(Section):
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
    drawn: _section_of(Drawn) | None = None  # type: ignore[valid-type]

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
            "scenario": None if self.scenario is None else _scenario_of(self.scenario, where),
        }


def header_of(recording: Recording) -> bytes:
    """Return the header of a recording as JSON."""
    values = jsonable({name: getattr(recording, name) for name in RecordingHeader.model_fields})
    for setup in values["setups"]:
        setup["noise"] = _without_empty(SensorNoise, setup["noise"])
    values["setups"] = [_without_empty(Setup, setup) for setup in values["setups"]]
    for setup in values["setups"]:
        for sensor in setup.get("sensors", ()):
            sensor["reference"] = name_in_logs(sensor["reference"])
    if values["scenario"] is not None:
        values["scenario"] = without_own_terms(values["scenario"])
        for sensor in values["scenario"].get("sensors", ()):
            sensor["kind"] = name_in_logs(sensor["kind"])
    return json.dumps(values, separators=(",", ":")).encode()


def _without_empty(of: type, entries: dict[str, Any]) -> dict[str, Any]:
    empty = OPTIONAL[of]
    return {name: value for name, value in entries.items() if name not in empty or value != jsonable(empty[name])}


def _scenario_of(raw: Mapping[str, Any], where: str) -> Scenario:
    """Return the scenario of a log; its sensors are of coopenv's kinds, or of classes that the user has named."""
    values = without_own_terms(raw)
    sensors = values.get("sensors")
    if isinstance(sensors, list) and all(isinstance(sensor, Mapping) for sensor in sensors):
        values["sensors"] = [
            {**sensor, "kind": reference_of(str(sensor.get("kind")), str(sensor.get("name") or "*"))}
            for sensor in sensors
        ]
    return parse_scenario(values, where)


def _setup(header: Any) -> Setup:
    arrays = {
        "targets": np.array(header.targets, np.int64),
        "lever_arm": np.array(header.lever_arm),
        "marker": np.array(header.marker),
        "noise": SensorNoise(**dict(header.noise)),
        "gains": Gains(**{**dict(header.gains), "q": np.array(header.gains.q)}),
        "sensors": tuple(_sensor(sensor) for sensor in header.sensors),
        "landmark_rotation": header.landmark_rotation and np.array(header.landmark_rotation, float),
    }
    values = {**dict(header), **arrays}
    if values.pop("planar"):
        recorded = "recorded with an earlier version: robots on a plane whose odometry is their commands"
        raise CoopenvError(f"{recorded}; convert the data set again")
    return Setup(**values)


def _sensor(header: Any) -> Sensor:
    arrays = {
        "reference": reference_of(header.reference, header.name),
        "std": np.array(header.std, float),
        "targets": np.array(header.targets, np.int64),
        "position": np.array(header.position),
        "rotation": np.array(header.rotation),
    }
    return Sensor(**{**dict(header), **arrays})


MAGIC = b"\x89MCAP0\r\n"

CUT_OFF = "cut off, the end of the MCAP file is missing"
REPAIR = "mcap recover"
"""The tool that mends such a file."""
MENDED = f"`{REPAIR}` mends it"


def is_cut_off(path: Path) -> bool:
    """Return whether a file begins as an MCAP file and does not end as one."""
    with regular(path).open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return False
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MAGIC)))
        return size < 2 * len(MAGIC) or stream.read() != MAGIC


@contextmanager
def reading(where: str) -> Iterator[None]:
    """Turn whatever is raised about an MCAP file into a DataError that begins with `where`."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{where}: cannot be read ({error.strerror or error})") from None
    except CoopenvError as error:
        raise error if isinstance(error, DataError) else DataError(f"{where}: {error}") from None
    except Exception as error:  # whatever the libraries raise at bytes that make no sense
        raise DataError(f"{where}: damaged MCAP file ({str(error) or type(error).__name__})") from None


class View(NamedTuple):
    """A topic with its messages."""

    topic: str
    schema: str
    """Name of the type of its messages."""
    schema_encoding: str
    definition: bytes
    """Of the type, in that encoding."""
    encoding: str
    """Of the messages."""
    messages: Iterable[tuple[int, bytes]]
    """(tick, contents), in the order of ticks."""


class LogClock(NamedTuple):
    """When ticks were."""

    dt: float
    """s, between ticks."""
    start: float = 0.0
    """s since 1970, of tick 0."""

    def nanoseconds(self, tick: int) -> int:
        """Return the time of a tick, ns since 1970."""
        return round(self.start * 1e9) + round(tick * self.dt * 1e9)


def ros_definition(kind: str) -> bytes:
    """Return the definition of a ROS 2 type as MCAP files hold it (`ros2msg`)."""
    return str(codec().generate_msgdef(kind, ros_version=2)[0]).encode()


class RosLog:
    """An MCAP file of ROS 2 messages under way; topics and types are described as they come."""

    def __init__(self, stream: Any) -> None:
        """Begin the file. Raises ImportError: the extra is not installed."""
        from mcap.writer import Writer

        self.writer = Writer(stream)
        self.writer.start(profile="ros2", library=f"coopenv {version()}")
        self.schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def channel(self, name: str, kind: str) -> int:
        """Return the channel of a topic with messages of a type."""
        if name not in self._channels:
            if kind not in self.schemas:
                self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", ros_definition(kind))
            self._channels[name] = self.writer.register_channel(name, "cdr", self.schemas[kind])
        return self._channels[name]
