"""Bodies of the scene: landmarks, vehicles, buildings, and their motions."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import Field, field_serializer, field_validator, model_validator

from coopenv.base import units
from coopenv.base.sections import (
    NonNegative,
    NonNegativeVector3,
    Number,
    Positive,
    PositiveVector2,
    PositiveVector3,
    QuaternionWxyz,
    Section,
    Vector2,
    Vector3,
    Word,
    parsed,
)
from coopenv.scenario.dynamics import Dynamics
from coopenv.scenario.sensing import Camera, Faults, Noise


class Body(Section):
    """An oriented box that occludes and collides."""

    size: Annotated[PositiveVector3, units.LENGTH]
    """Length, width and height in m along the body's x, y and z axes."""
    center: Annotated[Vector3, units.LENGTH] = (0.0, 0.0, 0.0)
    """Centre of the box in the body frame, m."""


class Obstacle(Section):
    """A building: a box that stands still."""

    name: Word = Field(min_length=1, max_length=64)
    center: Annotated[Vector3, units.PLACE]
    """Centre in the coordinates of this file, m."""
    size: Annotated[PositiveVector3, units.EXTENT]
    """Length, width and height, m."""
    yaw: Annotated[Number, units.HEADING] = 0.0
    """Rotation about z, rad."""


class Road(Section):
    """A straight strip drawn under the top view; it has no effect on the motion."""

    start: Annotated[Vector2, units.PLACE]
    end: Annotated[Vector2, units.PLACE]
    width: Annotated[Positive, units.EXTENT]
    marked: bool = True
    """Draw a dashed line along the middle."""


class StaticMotion(Section):
    """Stands still."""

    kind: Literal["static"] = "static"


class ConstantMotion(Section):
    """Keeps one body twist for ever."""

    kind: Literal["constant"] = "constant"
    linear: Annotated[Vector3, units.SPEED]
    """Linear velocity in the body frame, m/s."""
    angular: Annotated[Vector3, units.TURN_RATE] = (0.0, 0.0, 0.0)
    """Angular velocity in the body frame, rad/s."""


class TwistSegment(Section):
    """Constant body twist for a duration."""

    duration: Annotated[Positive, units.TIME]
    linear: Annotated[Vector3, units.SPEED] = (0.0, 0.0, 0.0)
    """Linear velocity in the body frame, m/s."""
    angular: Annotated[Vector3, units.TURN_RATE] = (0.0, 0.0, 0.0)
    """Angular velocity in the body frame, rad/s."""


class SegmentMotion(Section):
    """Drives a list of held body twists (straight lines and circular arcs), then stands still."""

    kind: Literal["segments"] = "segments"
    segments: tuple[TwistSegment, ...] = Field(min_length=1)


FASTEST = 1e6  # m/s, on average from one waypoint to the next


class Waypoint(Section):
    """A place to be at a time."""

    time: Annotated[NonNegative, units.TIME]
    position: Annotated[Vector3, units.PLACE]
    """Position in the coordinates of this file, m."""


class WaypointMotion(Section):
    """Follows a monotone cubic (PCHIP) in time through waypoints, heading along the path, then stands still.

    Equal waypoints in a row mean waiting.
    """

    kind: Literal["waypoints"] = "waypoints"
    waypoints: tuple[Waypoint, ...] = Field(min_length=2)
    heading: Literal["path", "fixed"] = "path"
    """`path` turns the body's x axis along the horizontal velocity, `fixed` keeps the initial orientation."""

    @model_validator(mode="after")
    def _times_increase(self) -> Self:
        times = [w.time for w in self.waypoints]
        if times[0] != 0.0 or any(b <= a for a, b in pairwise(times)):
            raise ValueError("waypoint times must start at 0 and increase")
        for n, (a, b) in enumerate(pairwise(self.waypoints)):
            if math.dist(a.position, b.position) > FASTEST * (b.time - a.time):
                raise ValueError(f"waypoints.{n + 1}: reaching it in time takes more than {FASTEST:g} m/s")
        return self


class DrivenMotion(Section):
    """Driven by the agent's actions through the drive of `[dynamics]`."""

    kind: Literal["driven"] = "driven"
    driver: Annotated[str, Field(min_length=1, max_length=1_000)] | None = None
    """Agent that drives it in place of actions: name, folder or `file.py:Class` (none: actions)."""
    initial_speed: Annotated[Number, units.DRIVEN_SPEED] = 0.0
    initial_speed_spread: Annotated[NonNegative, units.DRIVEN_SPEED] = 0.0
    """Half-width of a uniform deviation of it, m/s; the result is clipped to the limits of `[dynamics]`."""


class TrafficMotion(Section):
    """Driven by a model of traffic, not by actions.

    It is the backend's own, or in simulated worlds the intelligent driver model along the vehicle's routes.
    """

    kind: Literal["traffic"] = "traffic"


LandmarkMotion = Annotated[StaticMotion | ConstantMotion | SegmentMotion | WaypointMotion, Field(discriminator="kind")]
VehicleMotion = Annotated[
    StaticMotion | ConstantMotion | SegmentMotion | WaypointMotion | DrivenMotion | TrafficMotion,
    Field(discriminator="kind"),
]


Oriented = TypeVar("Oriented", "InitialPose", "InitialEstimate")


def _has_one_orientation(given: Oriented) -> Oriented:
    if given.yaw is not None and given.quaternion_wxyz is not None:
        raise ValueError("give yaw or quaternion_wxyz, not both")
    return given


class InitialPose(Section):
    """Start of an agent, fixed or drawn anew at each reset; an agent with routes starts on the drawn route."""

    position: Annotated[Vector3 | None, units.PLACE] = None
    """Position in the coordinates of this file, m; needed without routes."""
    yaw: Annotated[Number | None, units.HEADING] = None
    """Rotation about z, rad (0 when neither yaw nor a quaternion is given)."""
    quaternion_wxyz: QuaternionWxyz | None = None
    """Full orientation, body to map."""
    position_spread: Annotated[NonNegativeVector3, units.LENGTH] = (0.0, 0.0, 0.0)
    """Half-widths of a uniform offset along the start's own x, y, z axes, m."""
    yaw_spread: Annotated[NonNegative, units.TURN] = 0.0
    """Half-width of a uniform turn about the body's z axis, rad."""

    _one_orientation = model_validator(mode="after")(_has_one_orientation)


class InitialEstimate(Section):
    """The observer's estimate at t = 0, fixed or drawn anew at each reset."""

    position: Annotated[Vector3 | None, units.PLACE] = None
    """Estimated position in the coordinates of this file, m (default: the true one; an override says so by `true`)."""
    position_offset: Annotated[Vector3, units.EXTENT] = (0.0, 0.0, 0.0)
    """Added to the estimated position, map axes, m."""
    position_radius: Annotated[NonNegative, units.LENGTH] = 0.0
    """A further offset is drawn uniformly from a ball of this radius, m."""
    orientation_offset_wxyz: QuaternionWxyz = (1.0, 0.0, 0.0, 0.0)
    """Rhat(0) = R(0) Rot(offset)."""
    orientation_angle: Annotated[NonNegative | Literal["uniform"], units.TURN] = 0.0
    """A further turn about a random axis by an angle drawn from [0, this] rad; `uniform`: over SO(3)."""
    yaw: Annotated[Number | None, units.HEADING] = None
    """Absolute estimated yaw, rad; replaces R(0) above."""
    quaternion_wxyz: QuaternionWxyz | None = None
    """Absolute estimated orientation; replaces R(0) above."""

    @field_validator("position", mode="before")
    @classmethod
    def _true_position(cls, value: Any) -> Any:
        if value is True:
            return None
        return tuple(value) if isinstance(value, list) else value  # a validator's result is no JSON any more

    _one_orientation = model_validator(mode="after")(_has_one_orientation)


class Goal(Section):
    """Goal of a driven vehicle. With routes, the goal is the end of the drawn route."""

    position: Annotated[Vector3 | None, units.PLACE] = None
    """Position in the coordinates of this file, m; needed without routes."""
    radius: Annotated[Positive, units.LENGTH] = 0.5
    """The vehicle has arrived within this horizontal distance, m."""


class Landmark(Section):
    """A target whose position all vehicles know, static or moving."""

    name: str = Field(min_length=1, max_length=64, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    position: Annotated[Vector3, units.PLACE]
    """Position (of its origin, at t = 0) in the coordinates of this file, m."""
    position_spread: Annotated[NonNegativeVector3, units.EXTENT] = (0.0, 0.0, 0.0)
    """Half-widths of a uniform offset along its own x, y, z axes, drawn at every reset, m; vehicles know it."""
    presence: units.Chance = 1.0
    """Chance that it is there, drawn at every reset; vehicles know."""
    pace_spread: units.Chance = 0.0
    """Half-width of a uniform factor about 1 of the pace of its motion, drawn at every reset."""
    group: str | None = None
    """The group of `landmark_groups` that draws its position; written by the group."""
    yaw: Annotated[Number, units.HEADING] = 0.0
    """Orientation of a moving landmark's body at t = 0, rad."""
    motion: LandmarkMotion = StaticMotion()
    body: Body | None = None
    """A landmark with a body occludes targets behind it."""
    anchor: bool = False
    """True for a radio, which cameras do not see."""
    marker: Annotated[Vector3, units.LENGTH] = (0.0, 0.0, 0.0)
    """The point that cameras see, in the landmark's body frame, m."""
    accuracy: Annotated[NonNegative | None, units.DETAIL] = None
    """Accuracy of its position on the map, m (default: `map.accuracy`)."""

    @property
    def is_drawn(self) -> bool:
        """True if a reset draws its position or its presence."""
        return self.group is not None or any(self.position_spread) or self.presence < 1.0


class Vehicle(Section):
    """A vehicle that estimates its own pose; named vehicle_1, vehicle_2, ... in file order."""

    initial_pose: InitialPose | None = None
    """Needed unless the motion is by waypoints, which start at the first waypoint, the vehicle has routes, or
    highway-env draws the start."""
    initial_estimate: InitialEstimate = InitialEstimate()
    motion: VehicleMotion = StaticMotion()
    body: Body | None = None
    marker: Annotated[Vector3, units.LENGTH] = (0.0, 0.0, 0.0)
    """The point of this vehicle that other cameras see, in its body frame, m."""
    presence: units.Chance = 1.0
    """Chance that it is there, drawn at every reset; one vehicle is always left, a driven one where there is any."""
    pace_spread: units.Chance = 0.0
    """Half-width of a uniform factor about 1 of the pace of a prescribed motion, drawn at every reset."""
    entry: Annotated[tuple[NonNegative, NonNegative] | None, units.TIME] = None
    """First and last time at which it appears at its start, drawn uniformly, s (none: at the reset). It waits until no
    other vehicle is near."""
    next_routes: tuple[str, ...] = Field(default=(), max_length=1000)
    """Routes that may follow its routes where `termination.after_arrival` is `continue` or `transit` (default: all)."""
    connected: bool = True
    """Whether it has a V2X radio. Without one it neither sends nor receives; cameras measure it all the same."""
    neighbours: tuple[str, ...] | None = None
    """Targets it may measure: landmark names and vehicle names (default: every landmark and every leader)."""
    goal: Goal | None = None
    routes: tuple[str, ...] = Field(default=(), max_length=1000)
    """Names of routes, one of which is drawn at each reset: the vehicle starts at its beginning and goes to its end."""
    camera: Camera | None = None
    """The vehicle's own settings; settings left out are the scenario's [camera]. Likewise the next three."""
    noise: Noise | None = None
    dynamics: Dynamics | None = None
    faults: Faults | None = None

    @property
    def goal_radius(self) -> float:
        """Distance to the goal, m, within which the vehicle has arrived; 0 without a goal."""
        return (self.goal or Goal()).radius if self.goal or self.routes else 0.0

    @field_serializer("camera", "noise", "dynamics", "faults")
    def _given(self, part: Section | None) -> dict[str, Any] | None:
        """Omit the scenario's settings."""
        return None if part is None else part.model_dump(exclude_unset=True)

    @model_validator(mode="after")
    def _has_one_start_and_goal(self) -> Self:
        if self.motion.kind == "waypoints" and self.initial_pose is not None:
            raise ValueError("initial_pose: a motion by waypoints starts at its first waypoint; leave this out")
        drives = self.motion.kind in ("driven", "traffic")
        if self.routes and not drives:
            raise ValueError(f"routes: for driven vehicles and traffic; the motion of this one is '{self.motion.kind}'")
        if self.entry and (not drives or self.entry[0] > self.entry[1]):
            raise ValueError("entry: the first time, then the last one, of driven vehicles and traffic")
        for name, does in (("initial_pose", "starts on its route"), ("goal", "goes to the end of its route")):
            part = getattr(self, name)
            values = vars(part) if part else {}
            given = [key for key in ("position", "yaw", "quaternion_wxyz") if values.get(key) is not None]
            if self.routes and given:
                raise ValueError(f"{name}.{given[0]}: a vehicle with routes {does}; leave this out")
            if not self.routes and part is not None and part.position is None:
                raise ValueError(f"{name}.position: needed by a vehicle without routes")
        return self


class Area(Section):
    """A rectangle whose sides are parallel to the axes."""

    center: Annotated[Vector2, units.PLACE]
    """Centre in the coordinates of this file, m."""
    half: Annotated[PositiveVector2, units.EXTENT]
    """Half of its sides along x and y, m."""


class Line(Section):
    """A straight line."""

    start: Annotated[Vector2, units.PLACE]
    end: Annotated[Vector2, units.PLACE]
    """End in the coordinates of this file, m."""


class LandmarkGroup(Section):
    """Landmarks NAME_1, NAME_2, ..., each drawn uniformly over areas, or along lines, and over heights."""

    name: str = Field(min_length=1, max_length=56, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    count: int = Field(ge=1, le=1000)
    boxes: tuple[Area, ...] = Field(default=(), max_length=1000)
    lines: tuple[Line, ...] = Field(default=(), max_length=1000)
    height: Annotated[tuple[Number, Number], units.EXTENT]
    """Lowest and highest z, m."""
    presence: units.Chance = 1.0
    """Chance that a landmark of the group is there, drawn for each."""

    @model_validator(mode="after")
    def _is_somewhere(self) -> Self:
        if bool(self.boxes) == bool(self.lines):
            raise ValueError("give either boxes or lines")
        if self.height[0] > self.height[1]:
            raise ValueError(f"height: the lowest is {self.height[0]:g} m, the highest {self.height[1]:g} m")
        for i, line in enumerate(self.lines):
            if line.start == line.end:
                raise ValueError(f"lines.{i}: has no length")
        return self

    @property
    def parallelograms(self) -> list[tuple[Vector2, Vector2, Vector2]]:
        """Corner and two edges of each area, m; the second edge of a line is zero."""
        boxes = [
            ((b.center[0] - b.half[0], b.center[1] - b.half[1]), (2 * b.half[0], 0.0), (0.0, 2 * b.half[1]))
            for b in self.boxes
        ]
        lines = [(li.start, (li.end[0] - li.start[0], li.end[1] - li.start[1]), (0.0, 0.0)) for li in self.lines]
        return [*boxes, *lines]

    @property
    def weights(self) -> list[float]:
        """Size of each area, m^2, or length of each line, m."""
        boxes = [4.0 * b.half[0] * b.half[1] for b in self.boxes]
        return [*boxes, *(math.dist(line.start, line.end) for line in self.lines)]


MOST_LANDMARKS = 50_000


def with_groups(raw: Any) -> Any:
    """Return the plain data of a scenario with an entry of `landmarks` for each that its groups draw.

    What is not as it should be is left for the schema to complain about.
    """
    groups = raw.get("landmark_groups") if isinstance(raw, Mapping) else None
    landmarks = raw.get("landmarks", []) if isinstance(raw, Mapping) else None
    if not isinstance(groups, list) or not isinstance(landmarks, list):
        return raw
    there = {mark.get("name") for mark in landmarks if isinstance(mark, Mapping) and "group" in mark}
    added: list[dict[str, Any]] = []
    for group in groups:
        try:
            made = parsed(LandmarkGroup, group)
        except ValueError:
            return raw
        x, y = made.parallelograms[0][0]
        for k in range(made.count):
            name = f"{made.name}_{k + 1}"
            if name not in there and len(added) <= MOST_LANDMARKS:  # the schema refuses more
                added.append(
                    {"name": name, "position": [x, y, made.height[0]], "group": made.name, "presence": made.presence}
                )
    return {**raw, "landmarks": [*landmarks, *added]}
