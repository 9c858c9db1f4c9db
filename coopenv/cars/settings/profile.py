"""The profile of a make of cars (topics, command message, limits, conditions), and the polygon of a geofence."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.base.sections import Section, TagFamily, read_toml, validated


@dataclass(frozen=True)
class Limits:
    """Bounds of commands."""

    speed: float  # m/s
    steering: float  # rad
    acceleration: float  # m/s^2
    steering_rate: float  # rad/s
    reverse: bool = False

    def permit(self, speed: float, steering: float) -> bool:
        """Return whether a command is finite and inside."""
        return (
            math.isfinite(speed)
            and math.isfinite(steering)
            and (-self.speed if self.reverse else 0.0) - SLACK <= speed <= self.speed + SLACK
            and abs(steering) <= self.steering + SLACK
        )

    def approach(self, before: tuple[float, float], wanted: tuple[float, float], dt: float) -> tuple[float, float]:
        """Return the (speed, steering) nearest to what is wanted that can follow after dt s; both in m/s and rad."""
        speed = _toward(before[0], wanted[0], self.acceleration * dt)
        return speed, _toward(before[1], wanted[1], self.steering_rate * dt)

    def check(self, hardest: "Limits") -> "Limits":
        """Return these limits. Raises CoopenvError: one of them is not above zero, or beyond the hardest."""
        for field in fields(self):
            value, most = getattr(self, field.name), getattr(hardest, field.name)
            if field.name == "reverse":
                if value and not most:
                    raise CoopenvError("limit reverse: this make does not reverse")
            elif not 0.0 < value <= most:
                raise CoopenvError(f"limit of {field.name.replace('_', ' ')}: must be above 0, at most {most:.4g}")
        return self


def _toward(before: float, wanted: float, most: float) -> float:
    """Return `wanted`, or what is `most` from `before` towards it."""
    return wanted if abs(wanted - before) <= most else before + math.copysign(most, wanted - before)


SLACK = 1e-6
"""m/s or rad, of numbers that have gone through single precision."""

USUAL = Limits(speed=0.5, steering=math.pi / 6, acceleration=1.0, steering_rate=2.0)
"""Default limits."""


Point = tuple[float, float]


def inside(corners: Sequence[Point], x: float, y: float) -> bool:
    """Return whether a point is in a polygon: a ray to the right of it crosses the edges an odd number of times."""
    crossings = 0
    for (x1, y1), (x2, y2) in _edges(corners):
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) * (x2 - x1) / (y2 - y1):
            crossings += 1
    return crossings % 2 == 1


def is_simple(corners: Sequence[Point]) -> bool:
    """Return whether corners enclose something, and no two edges of theirs cross or touch beyond a common corner."""
    edges = _edges(corners)
    crossing = any(
        _side(a, b, c) * _side(a, b, d) < 0.0 and _side(c, d, a) * _side(c, d, b) < 0.0
        for (a, b), (c, d) in combinations(edges, 2)
    )
    touching = any(_between(a, c, b) for a, b in edges for c in corners if c not in (a, b))
    return 3 <= len(corners) == len(set(corners)) and not crossing and not touching


def _edges(corners: Sequence[Point]) -> list[tuple[Point, Point]]:
    return list(zip(corners, [*corners[1:], *corners[:1]], strict=True))


def _side(a: Point, b: Point, c: Point) -> float:
    """Return on which side of the line a-b a point is: positive on the left, 0 on it."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _between(a: Point, c: Point, b: Point) -> bool:
    """Return whether c is on the segment a-b."""
    return _side(a, b, c) == 0.0 and min(a, b) <= c <= max(a, b)


class Role(StrEnum):
    """Content of a topic."""

    DETECTIONS = "detections"  # blocks of the camera, pixels
    BEARINGS = "bearings"  # of the camera, unit vectors from the target to the camera, optical frame
    CAMERA_INFO = "camera_info"
    ODOMETRY = "odometry"  # of the car's own filter
    WHEEL = "wheel"
    IMU = "imu"
    ESTIMATE = "estimate"  # V2X
    REPORT = "report"  # V2X, of the observer `robust`
    POINT = "point"  # V2X of the authors: a position alone
    TRUTH = "truth"  # motion capture
    STATE = "state"  # of the autopilot
    REMOTE = "remote"  # channels of the remote control
    BATTERY = "battery"
    COMMAND = "command"  # to the gate
    ARM = "arm"  # to the gate
    GATE = "gate"  # status of the gate
    STOP = "stop"
    MANUAL = "manual"  # from the gate to the car


VELOCITY = {"wheel+imu": (Role.WHEEL, Role.IMU), "odometry": (Role.ODOMETRY,), "wheel": (Role.WHEEL,)}
"""Sources of body twists, best first."""

AUTHORS = {
    Role.DETECTIONS: ("{agent}/pixy_node/objectsInfo",),
    Role.BEARINGS: ("{agent}/pixy_landmark_detection/objectsBearing",),
    Role.CAMERA_INFO: ("{agent}/pixy_node/camera_info",),
    Role.WHEEL: ("{agent}/actuation_twist",),
    Role.POINT: ("{agent}/riccatiPoint",),
    Role.TRUTH: ("qualisys/{body}/pose", "qualisys/{body}/odom"),
}
"""The authors' topics: names that bags have, best first; the last one is that on a network."""

GATE_TYPES = {
    Role.COMMAND: "ackermann_msgs/msg/AckermannDriveStamped",
    Role.ARM: "coopenv_msgs/msg/Arm",
    Role.GATE: "coopenv_msgs/msg/GateStatus",
    Role.STOP: "std_msgs/msg/Bool",
}
"""Types between a station and a gate, the same for every make."""

PREFIX = "fleet"
TICK_TOPIC = "coopenv/tick"  # in files only
STOPPED_TOPIC = "coopenv/stopped"  # in files only: why the watchdog stopped the cars
RESET_TOPIC = "fleet/coopenv/reset"  # std_msgs/msg/Int64, a seed: fakes go to their start


def presence_of(name: str) -> str:
    """Return the key of the liveliness token of a car, its gate or an environment."""
    return f"{PREFIX}/alive/{name}"


@dataclass(frozen=True, slots=True)
class MotionCommand:
    """Motion command of a car."""

    steering: float = 0.0  # rad, left is positive
    speed: float = 0.0  # m/s, forward is positive
    brake: bool = False  # with the profile's brake, whatever the others are


NEUTRAL = MotionCommand()

MAX_COMMAND_AGE = 0.15
"""s, above which a gate refuses a command; no profile permits older ones."""

Positive = Annotated[float, Field(gt=0.0, le=1e6)]
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
TopicPattern = Annotated[
    str, Field(max_length=256, pattern=r"^([A-Za-z0-9_~]|\{car\}|\{body\})([A-Za-z0-9_/~]|\{car\}|\{body\})*$")
]


class Topic(Section):
    """A topic of a car."""

    name: TopicPattern
    """ROS name without the leading slash, which is the Zenoh key; `{car}` is the name of the car. Motion capture may
    have `{body}`, its name for the car."""
    type: str = Field(pattern=r"^\w+/msg/\w+$")
    """ROS 2 type."""
    max_age: Positive | None = None
    """Age above which a message is not used, s (default: none)."""
    urgent: bool = False
    """Send messages at once and before others."""
    reliable: bool = False
    """Let the sender wait instead of dropping messages."""
    bag_names: tuple[TopicPattern, ...] = ()
    """Further names in bags."""

    @property
    def max_age_ns(self) -> int:
        """Age above which a message is not used, ns; 0 without one."""
        return round(1e9 * (self.max_age or 0.0))


class Channel(Section):
    """One value of the command message: linear between neutral and full."""

    field: str
    """Field of the message."""
    full: Positive
    """Steering angle (rad, left is positive), turn rate (rad/s) or speed (m/s) at full."""
    change: Number
    """Change of the field from neutral to full."""


class Brake(Section):
    """Braking of the wheels."""

    fields: dict[str, Number] = Field(min_length=1)
    """Fields of the message that differ from a standing car's."""
    deceleration: Positive
    """Deceleration of a braking car, m/s^2, by a test. Braking lasts for the last commanded speed divided by it."""


FieldType = Literal["bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]


def _holds(kind: FieldType, value: float) -> bool:
    """Return whether a field can have a value."""
    if kind.startswith("float"):
        return True
    bits = 1 if kind == "bool" else int(kind.lstrip("uint"))
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind.startswith("i") else (0, 2**bits - 1)
    return value.is_integer() and low <= value <= high


class CommandMessage(Section):
    """Message from the gate to the car, a stamped one: a header, then numbers."""

    neutral: dict[str, tuple[FieldType, Number]]
    """Fields after the header in their order: type, and value of a standing car. Nested messages are written flat."""
    steering: Channel
    """Field of the steering angle; with `wheelbase`, of the turn rate."""
    speed: Channel
    """Field of the speed."""
    most: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of full that is sent at most, either way."""
    brake: Brake | None = None
    """Braking before neutral when the gate stops its car (none: neutral alone)."""
    wheelbase: Positive | None = None
    """Wheelbase of a car that takes turn rates, such as differential drives: that of the environment's vehicle, m.
    Turn rates are speed tan(steering) / wheelbase."""
    timeout: Positive = 0.5
    """Time without a message after which the car goes to neutral by itself, s (assumed by fake cars)."""

    @model_validator(mode="after")
    def _channels_move_fields(self) -> Self:
        for name, channel in (("steering", self.steering), ("speed", self.speed)):
            if not self.neutral.get(channel.field, ("", 0.0))[0].startswith("float"):
                raise ValueError(f"{name}.field: {shown(channel.field)} is no float32 or float64 of neutral")
            if channel.change == 0.0:
                raise ValueError(f"{name}.change: must not be 0")
        if self.steering.field == self.speed.field:
            raise ValueError(f"speed.field: {shown(self.speed.field)} is steering.field, too")
        braking = self.brake.fields if self.brake else {}
        if braking and all(value == self.neutral.get(name, ("", None))[1] for name, value in braking.items()):
            raise ValueError("brake.fields: equal a standing car's, so they brake nothing")
        for field in braking:
            if field not in self.neutral:
                raise ValueError(f"brake.fields: {shown(field)} is no field of neutral")
        for name, (kind, value) in self.neutral.items():
            for where, number in (("neutral", value), ("brake.fields", braking.get(name, value))):
                if not _holds(kind, number):
                    raise ValueError(f"{where}.{name}: a field of type {kind} cannot be {number:g}")
        return self

    def share(self, channel: Channel, value: float) -> float:
        """Return a steering angle or a speed as a share of full, cut off at `most`."""
        return min(max(value / channel.full, -self.most), self.most)

    def values(self, drive: MotionCommand) -> dict[str, float]:
        """Return the fields of a finite command by name."""
        found, turn = {name: value for name, (_, value) in self.neutral.items()}, drive.steering
        if drive.brake and self.brake:
            return found | self.brake.fields
        if self.wheelbase is not None:
            turn = drive.speed * math.tan(drive.steering) / self.wheelbase
        for channel, value in ((self.steering, turn), (self.speed, drive.speed)):
            found[channel.field] += channel.change * self.share(channel, value)
        return found

    def drive(self, values: Mapping[str, float]) -> MotionCommand:
        """Return the command of fields by name."""
        if self.brake and all(values[name] == value for name, value in self.brake.fields.items()):
            return MotionCommand(brake=True)
        steering, speed = (
            (values[channel.field] - self.neutral[channel.field][1]) / channel.change * channel.full
            for channel in (self.steering, self.speed)
        )
        if self.wheelbase is not None:
            steering = math.atan(steering * self.wheelbase / speed) if speed else 0.0
        return MotionCommand(steering, speed)


MOST_CHANNELS = 18
"""Of a remote control."""


class RemotePulses(Section):
    """Pulses of the remote control, us."""

    neutral: int = 1500
    """Pulse of a stick at rest."""
    moved: int = 100
    """Difference that counts as a moved stick or switch."""
    shortest: int = 800
    """Shortest pulse that is a signal."""
    longest: int = 2200
    """Longest pulse that is a signal."""


IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types of a camera's frames."""

Hue = Annotated[float, Field(ge=0.0, le=360.0)]


class VisionSettings(Section):
    """Frames of a camera, and tags that were detected in them."""

    family: TagFamily = "tag36h11"
    """Family of the tags: `tag16h5` to `tag36h11` of AprilTag, `DICT_4X4_50` to `DICT_7X7_1000` of ArUco."""
    colours: dict[int, tuple[Hue, Hue]] = Field(default={})
    """Hues, deg, from the first to the second (red 0, green 120, blue 240), by number of a marker. With any, blobs of
    these colours are found instead of tags."""
    exposure: float = Field(default=0.0, ge=0.0, le=1.0)
    """Time of exposure, s: half of it is added to the stamps, which mark its begin."""
    row_time: float = Field(default=0.0, ge=0.0, le=1e-3)
    """Time from a row to the next of a rolling shutter, s: that of the tags is added to the stamps, which are those of
    the first row."""
    rectified: bool = False
    """Treat pixels as rectified (`image_rect`): the matrix P of CameraInfo applies, without distortion."""

    def late(self, rows: Sequence[float], height: int) -> int:
        """Return the time, ns, from a stamp to the middle of the exposure of rows; none: of the middle row."""
        row = sum(rows) / len(rows) if rows else 0.5 * height
        return round(1e9 * (0.5 * self.exposure + self.row_time * row))


class CarProfile(Section):
    """Properties of a make of cars."""

    topics: dict[Role, Topic]
    """Topics by role; all roles are needed. A topic without a publisher does no harm unless it is a condition."""
    command: CommandMessage
    """Message on the topic `manual`."""
    hardest: Limits
    """Limits that no deployment can exceed: speed, m/s; steering, rad; acceleration, m/s^2; steering rate, rad/s."""
    markers: tuple[int, int] = (1, 7)
    """Smallest and largest number of a marker that the camera identifies."""
    conditions: tuple[Literal["state", "remote", "battery"], ...] = ("state", "remote", "battery")
    """Topics that a car must send before it is armed."""
    pulses: RemotePulses = RemotePulses()
    """Pulses of the remote control."""
    vision: VisionSettings = VisionSettings()
    """Tags, where `topics.detections` has frames or tags."""

    @property
    def sees_frames(self) -> bool:
        """True if cameras publish frames, which `coopenv svea see` reads on the car."""
        return self.topics[Role.DETECTIONS].type in IMAGES

    @model_validator(mode="after")
    def _has_all_topics(self) -> Self:
        if missing := [role.value for role in Role if role not in self.topics]:
            raise ValueError(f"topics: {listed(missing)} missing")
        names = [self.topic_of("NAME", role) for role in Role]
        if repeated := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"topics: two roles have the name {repeated}")
        if not 0.0 < (self.topics[Role.COMMAND].max_age or 0.0) <= MAX_COMMAND_AGE:
            raise ValueError(f"topics.command.max_age: needed, above 0 and at most {MAX_COMMAND_AGE:g} s")
        for role, kind in GATE_TYPES.items():
            if self.topics[role].type != kind:
                raise ValueError(f"topics.{role.value}.type: the gate has {kind}")
        if any(self.topic_of("NAME", role) == self.topic_of("OTHER", role) for role in Role):
            raise ValueError("topics: a name is without {car}")
        return self

    @model_validator(mode="after")
    def _sends_what_it_permits(self) -> Self:
        """Refuse limits of which the message would cut off a part."""
        hardest, sent = self.hardest, self.command
        if min(hardest.speed, hardest.steering, hardest.acceleration, hardest.steering_rate) <= 0.0:
            raise ValueError("hardest: speed, steering, acceleration and steering_rate must be above 0")
        turn = hardest.steering
        if sent.wheelbase is not None:
            turn = hardest.speed * math.tan(hardest.steering) / sent.wheelbase
        for name, channel, most in (("steering", sent.steering, turn), ("speed", sent.speed, hardest.speed)):
            if most > (can := channel.full * sent.most) + SLACK:
                raise ValueError(f"hardest: needs {most:.3g} of command.{name}, which has {can:.3g}")
        return self

    def topic_of(self, car: str, role: Role) -> str:
        """Return the full name of a car's topic, which is its Zenoh key as well."""
        return self.topics[role].name.format(car=car, body=car)


FOLDER = Path(__file__).parent / "profiles"


def load_profile(given: str | Mapping[str, Any], folder: Path = FOLDER) -> CarProfile:
    """Return a profile.

    Args:
        given: name of a shipped profile, a TOML file, or its content. With `base`, the name of another one, it has
            only what differs: entries of the tables, and whole topics.
        folder: what the paths of files are relative to.

    Raises:
        CoopenvError: one line that names the file and the field.
    """
    raw, where = _read(given, folder) if isinstance(given, str) else (dict(given), "profile")
    if isinstance(base := raw.pop("base", None), str):
        for key, value in _read(base, folder)[0].items():
            own = raw.get(key, value)
            raw[key] = {**value, **own} if isinstance(value, dict) and isinstance(own, dict) else own
    return validated(CarProfile, json.dumps(raw, default=str), where)


def _read(name: str, folder: Path) -> tuple[dict[str, Any], str]:
    """Return the content of a profile and its file's name."""
    path = folder / name if name.endswith(".toml") else FOLDER / f"{name}.toml"
    known = sorted(file.stem for file in FOLDER.glob("*.toml"))
    if not name.endswith(".toml") and name not in known:
        raise CoopenvError(
            f"unknown profile {shown(name)}{suggest(name, known)}; known: {listed(known)}, or a TOML file"
        )
    return read_toml(path), path.name


SVEA = load_profile("svea")
