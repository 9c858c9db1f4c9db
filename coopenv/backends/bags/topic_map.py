"""The map of a bag: which environment its cars drive in, which topic tells what, and how its clocks are read."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from coopenv.backends.bags.names import READ
from coopenv.errors import CoopenvError
from coopenv.scenario.validation import one_line
from coopenv.svea.deployment import Car, Marker, Name, Number, Positive, refuse_repeated
from coopenv.svea.network import Part
from coopenv.svea.topics import Role

TopicName = Annotated[str, Field(max_length=256, pattern=r"^/[A-Za-z0-9_/~]+$")]


class TopicMapError(CoopenvError):
    """A file does not say what is in a bag."""


class Topics(Part):
    """Topics of one car, in place of those of the naming scheme."""

    detections: TopicName | None = None
    """pixy_camera/ObjectInfoArrayStamped: blocks in pixels."""
    bearings: TopicName | None = None
    """pixy_camera/ObjectBearingArrayStamped: unit vectors from the target to the camera, optical frame."""
    camera_info: TopicName | None = None
    """sensor_msgs/CameraInfo, in place of the environment's camera."""
    wheel: TopicName | None = None
    """geometry_msgs/TwistWithCovarianceStamped, TwistStamped or nav_msgs/Odometry: body twist by the wheels."""
    imu: TopicName | None = None
    """sensor_msgs/Imu: its turn rate."""
    odometry: TopicName | None = None
    """nav_msgs/Odometry, or a twist, of the car's own filter."""
    estimate: TopicName | None = None
    """geometry_msgs/PoseStamped, PoseWithCovarianceStamped or nav_msgs/Odometry: where a car is that is a landmark."""
    point: TopicName | None = None
    """geometry_msgs/PointStamped, likewise."""
    truth: TopicName | None = None
    """geometry_msgs/PoseStamped, PoseWithCovarianceStamped or nav_msgs/Odometry: motion capture."""

    @property
    def given(self) -> dict[Role, str]:
        """What is set, by role."""
        return {role: name for role in READ if (name := getattr(self, role.value)) is not None}


class BagCar(Car):
    """One car of the bag."""

    body: Name | None = None
    """{body} in the names of motion capture (default: its name)."""
    topics: Topics = Topics()

    @property
    def names(self) -> dict[str, str]:
        """What stands for it in the names of a scheme."""
        agent = self.name if self.agent_number is None else f"agent{self.agent_number}"
        return {"car": self.name, "agent": agent, "body": self.body or self.name}


class Clocks(Part):
    """How times are read."""

    mode: Literal["auto", "stamps", "received"] = "auto"
    """`auto`: stamps, moved by the offset of their clock where that is more than `tolerance`; `stamps`: stamps as they
    are; `received`: when the recorder received a message, of sources without usable stamps."""
    tolerance: Positive = 0.02
    """s by which clocks may differ before stamps are moved: less is what networks need."""
    offsets: dict[str, Number] = Field(default={}, max_length=64)
    """s to add to the stamps of a car, or of `truth`, in place of the offset that was found."""


class Frame(Part):
    """Where the frame of positions in a bag is in the environment's coordinates."""

    position: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    """Its origin, m."""
    yaw: Number = 0.0
    """By which it is turned to the left, rad."""


class Frames(Part):
    """Frames of the bag's positions."""

    map: Frame = Frame()
    """Of what cars say."""
    truth: Frame | None = None
    """Of motion capture (default: the same)."""


class TopicMap(Part):
    """What a bag holds."""

    environment: str
    """Name of an environment, or TOML file (relative to this file): landmarks, cameras, noise and observer."""
    overrides: dict[str, Any] = Field(default={})
    """Dotted keys of it."""
    names: Literal["svea", "authors", "none"] = "svea"
    """Scheme by which topics are named unless `cars.topics` says otherwise."""
    cars: tuple[BagCar, ...] = Field(min_length=1, max_length=64)
    markers: dict[str, Marker] = Field(default={})
    """Numbers of the markers of landmarks, by name."""
    odometry: Literal["auto", "wheel+imu", "wheel", "odometry"] = "auto"
    """Where body twists come from; `auto`: the first of wheel+imu, odometry and wheel that the bag has."""
    camera: Literal["auto", "detections", "bearings"] = "auto"
    """What is read of the camera; `auto`: detections where the bag has them, or else bearings."""
    distorted: bool = True
    """Whether `bearings` were made of pixels whose distortion had not been removed, as the authors' are."""
    start: float = Field(default=0.0, ge=0.0, le=1e6)
    """s to leave out after the moment at which everything has begun to come."""
    duration: Positive | None = None
    """s to use after that (none: all)."""
    clocks: Clocks = Clocks()
    frames: Frames = Frames()
    path: Path = Field(default=Path("topics.toml"), exclude=True)
    """The file; set by `load_map`."""

    @model_validator(mode="after")
    def _nothing_is_used_twice(self) -> Self:
        refuse_repeated(self.cars, self.markers)
        known = {car.name for car in self.cars} | {"truth"}
        for name in self.clocks.offsets:
            if name not in known:
                raise ValueError(f"clocks.offsets: {name!r} is none of {', '.join(sorted(known))}")
        return self

    @property
    def environment_path(self) -> str:
        """The environment as `load_scenario` takes it."""
        beside = self.path.parent / self.environment
        return str(beside) if self.environment.endswith(".toml") else self.environment


def load_map(path: str | Path) -> TopicMap:
    """Read the map of a bag.

    Raises:
        TopicMapError: it cannot be read, or one line says which field is not what it must be.
    """
    path = Path(path)
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise TopicMapError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise TopicMapError(f"{path}: not valid TOML: {error}") from None
    try:
        made = TopicMap.model_validate(raw)
    except ValidationError as error:
        raise TopicMapError(one_line(error, path.name, TopicMap)) from None
    return made.model_copy(update={"path": path})
