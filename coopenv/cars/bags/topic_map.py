"""The map of a bag: the environment of its cars, their topics, and the treatment of its clocks."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from coopenv.base.errors import CoopenvError, DataError, check_one_of, listed, suggest
from coopenv.base.installation import SCENES, scenario_path
from coopenv.base.sections import Section, read_toml, validated
from coopenv.cars.messages.readings import READERS
from coopenv.cars.settings.deployment import Car, Marker, refuse_repeated, with_tables
from coopenv.cars.settings.limits import Number, Positive
from coopenv.cars.settings.profile import (
    AUTHORS,
    PREFIX,
    SVEA,
    TRANSFORMS,
    VELOCITY,
    CarProfile,
    Role,
    VisionSettings,
    load_profile,
)
from coopenv.cars.settings.sensors import Correction, Name, TopicName, read_calibration

PATTERNS: dict[str, dict[Role, tuple[str, ...]]] = {
    "authors": {role: tuple(f"/{name}" for name in names) for role, names in AUTHORS.items()},
    "none": {},
}
"""Candidate topics by name and role: the first in the bag counts."""


def patterns_of(names: str, make: CarProfile) -> dict[Role, tuple[str, ...]]:
    """Return the names of topics by role, of a scheme or a profile."""
    if names in PATTERNS:
        return PATTERNS[names]
    found = {}
    for role in READ:
        topic = make.topics[role]
        given = (topic.name, *(topic.bag_names or (topic.name.removeprefix(f"{PREFIX}/"),)))
        found[role] = tuple(dict.fromkeys(f"/{name}" for name in given))
    return found


class TopicMapError(CoopenvError):
    """A file is no valid map of a bag."""


class Topics(Section):
    """Topics of one car, in place of the naming scheme's."""

    detections: TopicName | None = None
    """pixy_camera/ObjectInfoArrayStamped: blocks in pixels; sensor_msgs/Image or CompressedImage: frames with tags;
    apriltag_msgs, apriltag_ros or isaac_ros_apriltag_interfaces/AprilTagDetectionArray, vision_msgs/Detection2DArray
    or Detection3DArray, aruco_msgs/MarkerArray, aruco_opencv_msgs/ArucoDetection, ros2_aruco_interfaces/ArucoMarkers,
    fiducial_msgs/FiducialArray or FiducialTransformArray, ar_track_alvar_msgs/AlvarMarkers, or the authors'
    ArucoArray."""
    bearings: TopicName | None = None
    """pixy_camera/ObjectBearingArrayStamped: unit vectors from the target to the camera, optical frame."""
    camera_info: TopicName | None = None
    """sensor_msgs/CameraInfo: calibration, instead of the environment's."""
    wheel: TopicName | None = None
    """geometry_msgs/TwistWithCovarianceStamped, TwistStamped, Twist or nav_msgs/Odometry: body twist by the wheels."""
    imu: TopicName | None = None
    """sensor_msgs/Imu: turn rate, instead of the wheels'."""
    odometry: TopicName | None = None
    """nav_msgs/Odometry or a twist: body twist by the car's own filter."""
    estimate: TopicName | None = None
    """geometry_msgs/PoseStamped, PoseWithCovarianceStamped or nav_msgs/Odometry: pose broadcast by a moving
    landmark."""
    point: TopicName | None = None
    """geometry_msgs/PointStamped: position broadcast by a moving landmark."""
    manual: TopicName | None = None
    """Message of the profile from the gate to the car, for `identify`."""
    command: TopicName | None = None
    """ackermann_msgs/AckermannDriveStamped: commands to the car, for `identify` where there is no `manual`."""
    truth: TopicName | None = None
    """geometry_msgs/PoseStamped, PoseWithCovarianceStamped, TransformStamped, nav_msgs/Odometry, or transforms (`/tf`)
    of the frame `body`: motion capture, for errors only, never observed."""

    @property
    def given(self) -> dict[Role, str]:
        """Topics that are set, by role."""
        return {role: name for role in READ if (name := getattr(self, role.value)) is not None}


READ = tuple(Role(name) for name in Topics.model_fields)
"""Roles that are of use in a bag."""
COMMANDS = (Role.MANUAL, Role.COMMAND)
UNNEEDED = (Role.CAMERA_INFO, Role.TRUTH, *COMMANDS)
"""Roles without which there are ticks."""

FrameName = Annotated[str, Field(max_length=64, pattern=r"^[A-Za-z][A-Za-z0-9_/]*$")]


class BagCar(Car):
    """One car of the bag."""

    body: FrameName | None = None
    """Name of the car in motion capture, or its frame in transforms (default: its name)."""
    topics: Topics = Topics()

    @property
    def names(self) -> dict[str, str]:
        """Placeholders of the car in the names of a scheme."""
        agent = self.name if self.agent_number is None else f"agent{self.agent_number}"
        return {"car": self.name, "agent": agent, "body": self.body or self.name}


class ClockSettings(Section):
    """Settings for reading times."""

    mode: Literal["auto", "stamps", "received"] = "auto"
    """`auto`: stamps, shifted by the offset of their clock if that exceeds `tolerance`; `stamps`: unchanged stamps;
    `received`: times of reception, for sources without usable stamps."""
    tolerance: Positive = 0.02
    """Offset of a clock above which its stamps are shifted, s."""
    offsets: dict[str, Number] = Field(default={}, max_length=64)
    """Time added to the stamps of a car, of `truth`, or of a topic, instead of the estimated offset, s."""
    leads: dict[TopicName, Number] = Field(default={}, max_length=64)
    """Lead of a topic's stamps in every drive, s: added before offsets are estimated."""


TURN = round(2.0 * math.pi, 4)  # rad


class MapFrame(Section):
    """Pose of the bag's position frame in the environment's coordinates."""

    position: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    """Origin of the frame in the environment's coordinates, m."""
    yaw: float = Field(default=0.0, ge=-TURN, le=TURN)
    """Rotation of the frame to the left, rad."""


class PositionFrames(Section):
    """Frames of the bag's positions."""

    map: MapFrame = MapFrame()
    """Frame of the cars' messages."""
    truth: MapFrame | None = None
    """Frame of motion capture (default: the same)."""


class TopicMap(Section):
    """Topics, cars and frames of a bag."""

    environment: str
    """Name of an environment, or TOML file (relative to this file): landmarks, cameras, noise and observer."""
    overrides: dict[str, Any] = Field(default={})
    """Dotted keys of the environment with other values."""
    calibration: str | None = None
    """File that `coopenv calibrate` has written (relative to this file): its overrides, leads of clocks and corrections
    replace those of this file."""
    corrections: dict[Name, Correction] = Field(default={})
    """Constants by the name of a car, instead of the published ones."""
    names: str = "svea"
    """Scheme of topic names, unless `cars.topics` gives others: `authors`, `none`, or a profile as in a deployment
    file, `svea` or a TOML file (relative to this file)."""
    cars: tuple[BagCar, ...] = Field(min_length=1, max_length=64)
    """One table `[[cars]]` per car."""
    markers: dict[str, Marker] = Field(default={})
    """Numbers of the markers of landmarks, by name."""
    odometry: Literal["auto", "wheel+imu", "wheel", "odometry"] = "auto"
    """Source of body twists; `auto`: the first of wheel+imu, odometry and wheel in the bag."""
    camera: Literal["auto", "detections", "bearings"] = "auto"
    """Source of bearings; `auto`: detections if the bag has them, or else bearings."""
    distorted: bool = True
    """Treat `bearings` as computed from distorted pixels, as the authors' are."""
    trust: tuple[str, ...] = Field(default=(), max_length=64)
    """Topics, or other subjects of findings, that are used unchanged although other streams contradict; `all`: each."""
    start: float = Field(default=0.0, ge=0.0, le=1e6)
    """Time left out after all needed topics have begun, s."""
    duration: Positive | None = None
    """Time used after that, s (default: all)."""
    clocks: ClockSettings = ClockSettings()
    frames: PositionFrames = PositionFrames()
    vision: VisionSettings = VisionSettings()
    """Frames and tags (default: the profile's)."""
    make: CarProfile = Field(default=SVEA, exclude=True)
    """Profile of `names`, or SVEA's; set by `load_map`."""
    path: Path = Field(default=Path("topics.toml"), exclude=True)
    """The file; set by `load_map`."""

    @model_validator(mode="after")
    def _nothing_is_used_twice(self) -> Self:
        refuse_repeated(self.cars, self.markers)
        known = {car.name for car in self.cars} | {"truth"}
        for name in self.clocks.offsets:
            if name not in known and not name.startswith("/"):
                raise ValueError(f"clocks.offsets: {name!r} is none of {', '.join(sorted(known))}, or a topic")
        for name in self.corrections:
            check_one_of("corrections: unknown car", name, sorted(known - {"truth"}), ValueError)
        return self

    @property
    def environment_path(self) -> str:
        """The environment as `load_scenario` takes it. Raises TopicMapError: there is none."""
        name = str(self.path.parent / self.environment) if self.environment.endswith(".toml") else self.environment
        try:
            _ = name.partition(":")[0] in SCENES or scenario_path(name)
        except CoopenvError as error:
            raise TopicMapError(f"{self.path.name}: environment: {error}") from None
        return name


def load_map(path: str | Path) -> TopicMap:
    """Read the map of a bag.

    Raises:
        TopicMapError: it cannot be read, or one line says which field is not what it must be.
    """
    path = Path(path)
    data = read_toml(path, TopicMapError)
    if isinstance(name := data.get("calibration"), str):
        both = f"{path.name} and {name}"
        found = read_calibration(path.parent / name, f"{path.name}: calibration: {name}", TopicMapError)
        own = with_tables(data, {}, ("clocks",), path.name, TopicMapError)["clocks"]
        data = with_tables(data, found, ("overrides", "corrections"), both, TopicMapError)
        data["clocks"] = with_tables(own, found["clocks"], ("leads",), f"{both}: clocks", TopicMapError)
    made = validated(TopicMap, json.dumps(data, default=str), path.name, TopicMapError)
    try:
        make = SVEA if made.names in PATTERNS else load_profile(made.names, path.parent)
    except CoopenvError as error:
        raise TopicMapError(f"{path.name}: names: {error}; also: authors, none") from None
    vision = made.vision if "vision" in made.model_fields_set else make.vision
    return made.model_copy(update={"path": path, "make": make, "vision": vision})


TRUTH = "truth"
"""The source of motion capture, as the sources of other topics have the name of their car."""


@dataclass(frozen=True)
class Chosen:
    """A topic that is read."""

    topic: str
    car: str
    role: Role
    leads: bool = False  # whether the car is a moving landmark
    frame: str = ""  # of its body, if the topic has transforms

    @property
    def sample_role(self) -> Role:
        """Role of its samples: motion capture of a moving landmark counts as its estimate."""
        return Role.ESTIMATE if self.leads and self.role is Role.TRUTH else self.role

    @property
    def needed(self) -> bool:
        """True if ticks cannot be built without it."""
        return self.leads or self.role not in UNNEEDED

    @property
    def source(self) -> str:
        """Clock of its stamps."""
        return TRUTH if self.role is Role.TRUTH else self.topic if self.role is Role.COMMAND else self.car

    @property
    def clock(self) -> str:
        """Name of its clock as a reference of others."""
        return f"the camera of {self.car}" if self.role in (Role.DETECTIONS, Role.BEARINGS) else self.source


def select(given: TopicMap, topics: Mapping[str, str], where: str) -> list[Chosen]:
    """Return the topics that are read.

    Args:
        given: the map.
        topics: type of every topic of the bag.
        where: names the bag in errors.

    Raises:
        DataError: a needed topic is absent, or holds messages that cannot be read in the role of the map.
    """
    found: dict[tuple[str, str], Chosen] = {}
    for entry in (entry for car in given.cars for entry in _of_car(given, car, topics, where)):
        if (other := found.setdefault((entry.topic, entry.frame), entry)) is not entry:
            both = f"cars.{other.car}.topics.{other.role} and cars.{entry.car}.topics.{entry.role}"
            raise DataError(f"{given.path.name}: {both} are one topic, {entry.topic}")
    return [*found.values()]


def _of_car(given: TopicMap, car: BagCar, topics: Mapping[str, str], where: str) -> list[Chosen]:
    """Return the topics of one car that are read; a moving landmark has a position alone."""
    table, patterns = f"{given.path.name}: cars.{car.name}.topics", patterns_of(given.names, given.make)
    names = {role: tuple(name.format(**car.names) for name in some) for role, some in patterns.items()}
    names |= {role: (name,) for role, name in car.topics.given.items()}

    def absent(name: str) -> str:
        known = listed(sorted(topics)) or "none at all"
        return f"{where} has no topic {name}{suggest(name, topics)}; it has {known}"

    def first(what: str, choices: Sequence[tuple[Role, ...]]) -> tuple[Role, ...]:
        """Return the first choice of roles of which the bag has all topics."""
        for roles in choices:
            if all(role in found for role in roles):
                return roles
        missing = dict.fromkeys(role for roles in choices for role in roles if role not in found)
        if not (wanted := [name for role in missing for name in names.get(role, ())]):
            raise DataError(f"{table}: names no topic of its {what} ({listed([role.value for role in missing])})")
        raise DataError(f"{car.name} has no {what}: {absent(wanted[0])}")

    for role, name in car.topics.given.items():
        if name not in topics:
            hint = "; without this key the environment's calibration counts" if role is Role.CAMERA_INFO else ""
            raise DataError(f"{table}.{role}: {absent(name)}{hint}")
    found = {role: there[0] for role, some in names.items() if (there := [name for name in some if name in topics])}
    for role, name in found.items():
        readable = [*READERS.get(role, topics.values()), *(TRANSFORMS if role is Role.TRUTH else ())]
        if topics[name] not in readable:
            kinds = f"{topics[name] or 'several types'}, {role} is one of {listed(readable)}"
            raise DataError(f"{where}: topic {name} of {car.name} holds {kinds}")
    if car.landmark:  # motion capture is its position where it publishes none
        chosen: tuple[Role, ...] = first("position", [(role,) for role in (Role.ESTIMATE, Role.POINT, Role.TRUTH)])
    else:
        twists = [VELOCITY[given.odometry]] if given.odometry != "auto" else [*VELOCITY.values()]
        cameras = [Role(given.camera)] if given.camera != "auto" else [Role.DETECTIONS, Role.BEARINGS]
        chosen = first("odometry", twists) + first("camera", [(role,) for role in cameras])
        found.pop(Role.COMMAND if Role.MANUAL in found else Role.MANUAL, None)
        chosen += tuple(role for role in UNNEEDED if role in found)
    frames = {role: car.names["body"] if topics[found[role]] in TRANSFORMS else "" for role in chosen}
    return [Chosen(found[role], car.name, role, car.landmark is not None, frames[role]) for role in chosen]
