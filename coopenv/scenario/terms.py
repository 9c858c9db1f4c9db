"""Terms of observations, rewards and ends of episodes; a row each.

A row describes a term and names the function that computes it. From the rows come the layout of an observation, the
weights that a scenario may set (`coopenv.scenario.task`), the kernel (`coopenv.api.terms`), and the tables of
`coopenv describe`.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from coopenv.base import installation
from coopenv.base.errors import CoopenvError, shown, suggest
from coopenv.base.sections import Number, Positive, Section, Text

LOG_SCALE = 10.0
"""Decades (or nepers of log det P / 6) that fill the range of a logarithmic entry."""

ROLES = 16
"""Vehicles with a role of their own, the first ones of a fleet."""

COLUMNS = ("per", "size", "unit", "scale", "low", "meaning", "planar", "center")
"""Columns of a field; the last two only if unusual: entries for a vehicle on a plane, and the value read as 0."""
XY = (0, 1)
FIELDS: dict[str, list[tuple[Any, ...]]] = {  # group: name, columns
    "estimate": [
        ("estimate_position", "vehicle", 3, "m", "position_scale", -1, "estimated position, map frame", XY),
        ("estimate_forward", "vehicle", 3, "1", 1, -1,
         "estimated direction of the body's x axis (forward), map frame", XY),
        ("estimate_left", "vehicle", 3, "1", 1, -1,
         "estimated direction of the body's y axis (to the left), map frame", ()),
    ],
    "quality": [
        ("covariance_diagonal", "vehicle", 6, "log10", LOG_SCALE, -1,
         "log10 of the diagonal of the observer's P: attitude about x, y, z, then position", (2, 3, 4)),
        ("log_determinant", "vehicle", 1, "1", LOG_SCALE, -1, "log det P / 6, the mean logarithm of P's eigenvalues"),
        ("gramian_min_eigenvalue", "vehicle", 1, "log10", LOG_SCALE, -1,
         "log10 of the smallest eigenvalue of the sliding observability Gramian, at least 1e-9"),
        ("targets_in_view", "vehicle", 1, "targets", "targets", 0, "number of targets measured in this frame"),
    ],
    "bearings": [
        ("bearing", "target", 3, "1", 1, -1,
         "unit vector camera to target, body frame; 0: never seen"),
        ("bearing_mask", "target", 1, "bool", 1, 0, "1: measured in this frame"),
        ("bearing_age", "target", 1, "s", "age_scale", 0,
         "time since measured; 1: longer ago than the scale, or never"),
    ],
    "odometry": [
        ("velocity", "vehicle", 3, "m/s", "velocity_scale", -1,
         "velocity of the last odometry sample, body frame", (0,)),
        ("angular_velocity", "vehicle", 3, "rad/s", "angular_velocity_scale", -1,
         "angular velocity of the last odometry sample, body frame", (2,)),
        ("odometry_age", "vehicle", 1, "s", "age_scale", 0, "age of the last odometry sample"),
    ],
    "messages": [
        ("message_position", "neighbour", 3, "m", "position_scale", -1,
         "neighbour's estimate seen from one's own estimate", XY),
        ("message_forward", "neighbour", 3, "1", 1, -1, "neighbour's forward axis in one's own estimated frame", XY),
        ("message_mask", "neighbour", 1, "bool", 1, 0, "1: a message is at hand and not stale"),
        ("message_age", "neighbour", 1, "s", "age_scale", 0, "time since the message was sent"),
    ],
    "clearance": [
        ("message_clearance", "neighbour", 2, "m", 2, -1,
         "least distance within 6 s to the neighbour, if that drives straight on at top speed and this vehicle follows "
         "its route at top speed, or stands; 4: farther, or nothing received", None, 2.0),
    ],
    "precedence": [
        ("message_precedence", "neighbour", 1, "bool", 1, 0,
         "1: a message is at hand from a neighbour with the right of way: not driven, or earlier in the order"),
    ],
    "goal": [
        ("goal", "vehicle", 3, "m", "position_scale", -1,
         "goal seen from one's own estimate, body frame; 0 without a goal", XY),
    ],
    "uncertainty": [
        ("position_std", "vehicle", 1, "log10 m", 1.5, -1,
         "log10 of the standard deviation of the position, sqrt(trace P_pos)", None, -1.25),
        ("axis_std", "vehicle", 3, "log10 m", 1.5, -1,
         "log10 of the position's standard deviation along the estimated body's axes", XY, -1.25),
        ("heading_std", "vehicle", 1, "log10 rad", 1.5, -1, "log10 of the standard deviation of the heading",
         None, -2.0),
        ("soft_observability", "vehicle", 1, "log10", 2.5, -1,
         "log10 of (floor + smallest eigenvalue of the sliding observability Gramian)", None, -2.5),
    ],
    "protection": [
        ("protection_position", "vehicle", 1, "log10 m", 1.5, -1,
         "log10 of the observer's bound of the horizontal error; 1: at least 10 m, unknown, or none stated",
         None, -0.5),
        ("protection_angle", "vehicle", 1, "log10 rad", 1.5, -1,
         "log10 of the observer's bound of the angle of the error; 1: at least 1 rad, unknown, or none stated",
         None, -1.5),
    ],
    "sightings": [
        ("sighting", "neighbour", 3, "1", 1, -1,
         "unit vector camera to neighbour, body frame; 0: never seen", XY),
        ("sighting_mask", "neighbour", 1, "bool", 1, 0, "1: measured in this frame"),
        ("sighting_age", "neighbour", 1, "s", "age_scale", 0, "time since it was measured"),
    ],
    "seen": [
        ("seen_mask", "neighbour", 1, "bool", 1, 0,
         "1: a message is at hand by which the neighbour measured this vehicle in the frame of its sending"),
        ("seen_age", "neighbour", 1, "s", "age_scale", 0,
         "time since the neighbour measured this vehicle, by its last message; 1: longer ago than the scale, or never"),
    ],
    "map": [
        ("map_position", "landmark", 3, "m", "map_scale", -1,
         "landmark of the map seen from one's own estimate, body frame", XY),
        ("map_mask", "landmark", 1, "bool", 1, 0, "1: there is such a landmark"),
        ("map_in_view", "landmark", 1, "bool", 1, 0,
         "1: visible by one's own estimate: in range, in the image, hidden by nothing known"),
        ("map_age", "landmark", 1, "s", "age_scale", 0, "time since its bearing was measured"),
    ],
    "route": [
        ("route_offset", "vehicle", 1, "m", 1, -1, "offset to the left of the route, by one's own estimate"),
        ("route_heading", "vehicle", 1, "rad", 1, -1, "estimated heading less the direction of the route"),
        ("route_left", "vehicle", 1, "m", "position_scale", -1, "length of the route that is left"),
        ("route_ahead", "vehicle", 4, "rad", 1, -1,
         "direction of the route 1, 2, 4 and 8 times `route_step` ahead, from the estimated body's x axis to the left"),
    ],
    "self": [
        ("steering", "vehicle", 1, "rad", "steering", -1, "steering angle, positive to the left"),
        ("turn_rate", "vehicle", 1, "rad/s", "turn_rate", -1,
         "turn rate of a drive without steering, positive to the left"),
        ("lateral_speed", "vehicle", 1, "m/s", "lateral_speed", -1, "speed of an omnidirectional drive to the left"),
        ("last_action", "vehicle", 3, "1", 1, -1, "action of the last decision, its first three entries at most"),
        ("time_left", "vehicle", 1, "horizon", 0.5, -1, "share of the horizon that is left", None, 0.5),
    ],
    "stated": [
        ("message_std", "neighbour", 1, "log10 m", 1.5, -1,
         "log10 of the standard deviation of the neighbour's position that its last report states; 1: none at hand",
         None, -1.25),
    ],
    "found": [
        ("bearing_found", "target", 1, "bool", 1, 0, "1: its bearing was measured in this episode"),
        ("sighting_found", "neighbour", 1, "bool", 1, 0, "1: the neighbour was measured in this episode"),
        ("seen_found", "neighbour", 1, "bool", 1, 0,
         "1: by its last message, the neighbour has measured this vehicle in this episode"),
        ("map_found", "landmark", 1, "bool", 1, 0, "1: its bearing was measured in this episode"),
    ],
    "role": [
        ("role", "vehicle", ROLES, "bool", 1, 0,
         "1 at the vehicle's number in the fleet, 0 elsewhere: a shared policy can distinguish vehicles"),
    ],
    "pan": [
        ("camera_pan", "vehicle", 1, "rad", "pan", -1, "angle by which the camera is turned, positive to the left"),
    ],
}  # fmt: skip

SETTINGS: dict[str, tuple[str, ...]] = {  # what entries mean also depends on these, beside their scale and center
    "gramian_min_eigenvalue": ("observer.gramian_window", "observer.gramian_distance"),
    "soft_observability": ("observer.gramian_window", "observer.gramian_distance", "reward.observability_floor"),
    "message_clearance": ("observation.route_step", "dynamics.max_speed"),
    "route_ahead": ("observation.route_step",),
}
SETTINGS_OF_ACTIONS = ("rates.decision", "dynamics.max_speed")

SETTLED_FROM = 3.0
"""Time (s) from which errors count in the score: before it they are the initial estimate's."""
LOST = 1.0
"""Position error (m) that counts in the score for a lost vehicle, and for every larger error."""
REWARDS: list[tuple[str, str, bool, str]] = [  # name, unit, privileged, meaning
    ("progress", "m", True,
     "Decrease of the true distance to the goal: along the drawn route, or else in a straight line"),
    ("arrival", "1", False, "1 in the step of arrival"),
    ("collision", "1", False, "-1 in the step of a collision"),
    ("off_route", "1", False, "-1 in the step in which the vehicle has left its route"),
    ("control", "1", False, "Minus the squared length of the action"),
    ("time", "s", False, "Minus the time that has passed"),
    ("radio", "kB", False,
     "Minus the size of what was sent: a report by its estimator (`robust`: 172 bytes and 42 per correlation), a pose "
     "56 bytes; a broadcast counts once, with `action.radio` every receiver"),
    ("position_error", "m", True, "Minus the position error"),
    ("orientation_error", "rad", True, "Minus the orientation error"),
    ("scored_error", "m s", True,
     "Minus the errors of the score, times the time: the position error from 3 s on, at most 1 m, and 1 m for the rest "
     "of the way of a vehicle that collides or does not arrive"),
    ("position_uncertainty", "m^2", False,
     "Per metre gained: minus the part of sqrt(trace P_pos) above the threshold, at most the cap"),
    ("position_error_per_metre", "m^2", True,
     "Per metre gained: minus the part of the true position error above the threshold, at most the cap"),
    ("information_gain", "1", False, "Decrease of log det P / 6: a difference of potentials"),
    ("uncertainty", "1", False, "-log det P / 6: minus the mean log variance"),
    ("observability", "1", False, "log10 of the smallest eigenvalue of the sliding Gramian (floor 1e-9)"),
    ("observability_shortfall", "m", False,
     "Per metre gained: minus what log10(floor + smallest eigenvalue of the sliding Gramian) lacks to the level"),
    ("visibility", "1", False, "Share of its possible targets that the vehicle has in view"),
]  # fmt: skip

CONDITIONS = [  # name, function, meaning
    ("collision", "touches_anything", "Touching a building or another body, at any camera tick"),
    ("off_route", "has_left_route", "Being farther from its route than the given distance, after a decision"),
    ("arrival", "reaches_goal", "Reaching the goal, or passing the end of a drawn route, at any camera tick"),
]


Scale = Literal[
    "position_scale", "velocity_scale", "angular_velocity_scale", "age_scale", "map_scale", "targets",
    "steering", "turn_rate", "lateral_speed", "pan",
]  # fmt: skip
"""A setting of `[observation]`, the number of targets, or the value of an entry at action 1."""
Per = Literal["vehicle", "target", "neighbour", "landmark"]
"""Subjects of a value: the vehicle itself, every target (landmarks, then vehicles), every other vehicle, or each of the
landmarks that are nearest to the vehicle's own estimate."""


class TermRow(Section):
    """Entries of every term; a text alone is its function."""

    function: str | SkipJsonSchema[Callable[..., Any]]
    """`file.py:name`, the file relative to the scenario's, or `package.module:name`."""
    unit: Text = "1"
    meaning: Text = ""

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> Any:
        """Return the JSON schema; for editors the text of the function alone is a row, too."""
        schema = super().__get_pydantic_json_schema__(core_schema, handler)
        whole = handler.resolve_ref_schema(schema)
        row = dict(whole)
        whole.clear()
        whole["anyOf"] = [{"type": "string", "description": cls.meanings()["function"]}, row]
        return schema

    @model_validator(mode="before")
    @classmethod
    def _text_alone(cls, row: Any) -> Any:
        return {"function": row} if isinstance(row, str) else row

    @field_validator("function")
    @classmethod
    def _names_a_place(cls, function: Any) -> Any:
        if isinstance(function, str) and not installation.is_reference(function):
            raise ValueError(f"expected file.py:name or package.module:name, got {shown(function)}")
        return function


class Term(TermRow):
    """A term of the reward, or a condition that ends a vehicle's episode."""

    privileged: bool = False
    """True if it uses the truth, as every function of two records does."""

    @property
    def described(self) -> str:
        """The meaning, with unit and privilege."""
        unit = "" if self.unit == "1" else f", {self.unit}"
        return f"{self.meaning}{unit}{' (privileged)' if self.privileged else ''}"


class ObservationField(TermRow):
    """A field of the observation; every entry is (value - center) / scale, clipped to [low, 1]."""

    group: Text = ""
    """Its name in `observation.include`; empty: its own name."""
    per: Per = "vehicle"
    size: int = Field(default=1, ge=1, le=64)
    """Entries of one value."""
    scale: Positive | Scale = 1.0
    low: Literal[-1, 0] = -1
    center: Number = 0.0
    """The value that reads 0."""
    planar: tuple[Annotated[int, Field(ge=0, lt=64)], ...] | None = None
    """Entries of a value that `observation.planar` keeps (none: all); an empty list drops the field."""


R = TypeVar("R", bound=TermRow)


class Registry(Generic[R]):
    """All terms of one kind: built-in terms and terms registered in this program."""

    def __init__(self, kind: str, built_in: Mapping[str, R]) -> None:
        self.kind, self.built_in = kind, built_in
        self._taken = {*built_in, *(getattr(row, "group", "") for row in built_in.values()), "custom", "privileged"}
        self._registered: dict[str, R] = {}

    def known(self, custom: Mapping[str, R]) -> dict[str, R]:
        """Return every term that a scenario may name whose own terms are `custom`."""
        return {**self.built_in, **self._registered, **custom}

    def free(self, name: str) -> str:
        """Return the name of a new term.

        Raises:
            CoopenvError: it is no identifier, or taken by coopenv.
        """
        if not isinstance(name, str) or not name.isidentifier():
            raise CoopenvError(f"the name of a {self.kind} is an identifier, got {shown(name)}")
        if name in self._taken:
            raise CoopenvError(f"a {self.kind} cannot be named '{name}', which coopenv uses")
        return name

    def register(self, name: str, row: R) -> None:
        """Make a term known by name in this program; one that is defined anew replaces its former self.

        Raises:
            CoopenvError: it is no identifier, or taken by another term.
        """
        former = self._registered.get(self.free(name), row)
        if _home(former.function) != _home(row.function):
            raise CoopenvError(f"a {self.kind} named '{name}' is registered already")
        self._registered[name] = row


def _home(function: Any) -> tuple[str, str]:
    function = getattr(function, "func", function)  # a Warp function holds the plain one
    return function.__module__, function.__qualname__


def check_known(kind: Registry[Any], names: Iterable[str], custom: Mapping[str, Any], where: str = "") -> None:
    """Check that the terms that a scenario names exist; `where` begins the name of a key in an error.

    Raises:
        ValueError: one does not.
    """
    known = kind.known(custom)
    for name in names:
        if name not in known:
            near = suggest(name, known) or f"; allowed: {', '.join(sorted(known))}"
            raise ValueError(f"{where}{name}: unknown key{near}")


def check_privilege(kind: Registry[Term], used: Mapping[str, float], part: Any) -> None:
    """Check that a part of a scenario, which has `custom` and `privileged`, declares its use of the truth.

    Raises:
        ValueError: a term whose weight or switch in `used` is on uses the truth without being declared privileged.
    """
    known = kind.known(part.custom)
    for name, weight in used.items():
        if weight and known[name].privileged and not part.privileged:
            raise ValueError(f"privileged: must be true, because the {kind.kind} '{name}' uses the truth")


READINGS, READING = "readings", "reading_"
"""Group of the fields about sensors beside the camera, and the begin of their names; the sensor's name follows."""
GROUPS = (*FIELDS, READINGS)
"""Groups of fields of coopenv, in their order in an observation."""
USUAL_GROUPS = ("estimate", "quality", "bearings", "odometry", "messages", "goal")
"""Groups of a scenario that names none."""

OBSERVATION_FIELDS = Registry(
    "observation field",
    {
        name: ObservationField(
            function=f"coopenv.api.terms.records:{row[0]}_values", group=group, **dict(zip(COLUMNS, row, strict=False))
        )
        for group, rows in FIELDS.items()
        for name, *row in rows
    },
)
REWARD_TERMS = Registry(
    "reward term",
    {
        name: Term(function="coopenv.api.terms.results:reward_values", unit=unit, privileged=privileged, meaning=about)
        for name, unit, privileged, about in REWARDS
    },
)
TERMINATION_CONDITIONS = Registry(
    "termination condition",
    {name: Term(function=f"coopenv.world.referee:{place}", meaning=about) for name, place, about in CONDITIONS},
)
