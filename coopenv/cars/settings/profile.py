"""The profile of a make of cars (topics, command message, limits, conditions)."""

import json
import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypedDict

from pydantic import Field, model_validator

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.base.sections import Section, TagFamily, read_toml, validated
from coopenv.cars.gate.wheel_command import CommandMessage
from coopenv.cars.settings.limits import SLACK, Limits, Positive


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


MAX_COMMAND_AGE = 0.15
"""s, above which a gate refuses a command; no profile permits older ones."""

TopicPattern = Annotated[
    str, Field(max_length=256, pattern=r"^([A-Za-z0-9_~]|\{car\}|\{body\})([A-Za-z0-9_/~]|\{car\}|\{body\})*$")
]


class Way(TypedDict, total=False):
    """Way of a message; what is not given is False."""

    urgent: bool  # it goes at once and before others
    reliable: bool  # its sender waits for the network instead of losing it


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

    @property
    def way(self) -> Way:
        """Way of its messages, as transports take it."""
        return {"urgent": self.urgent, "reliable": self.reliable}


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


IMAGE, COMPRESSED = IMAGES = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
"""Types of a camera's frames."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of messages with transforms between frames."""

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
    most_hamming: int = Field(default=1, ge=0, le=10)
    """Corrected bits of a detected tag, above which it is left out."""
    least_margin: float = Field(default=10.0, ge=0.0, le=1e3)
    """Decision margin of a detected tag, below which it is left out; 0 in a message means not stated."""
    least_score: float = Field(default=0.2, ge=0.0, le=1.0)
    """Score of a detected box, below which it is left out; 0 in a message means not stated."""

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
