"""Terms: what an observation holds, what a reward weighs, what ends a vehicle's episode; a row each.

A row says what a term is and names the function that computes it. From the rows come the layout of an observation, the
weights that a scenario may set, the kernel (`coopenv.api.terms`), and the tables of `coopenv describe`.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import ConfigDict, Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from coopenv.base import user_code
from coopenv.base.errors import CoopenvError, shown, suggest
from coopenv.scenario.base import Number, Part, Positive, Text
from coopenv.scenario.term_rows import COLUMNS, CONDITIONS, FIELDS, REWARDS

Scale = Literal[
    "position_scale", "velocity_scale", "angular_velocity_scale", "age_scale", "map_scale", "steering", "pan", "targets"
]
"""A setting of `[observation]`, the steering or the pan angle at action 1, or the number of targets."""
Per = Literal["vehicle", "target", "neighbour", "landmark"]
"""One value of the vehicle itself, one of every target (landmarks, then vehicles), one of every other vehicle, or one
of each of the landmarks that are nearest by the vehicle's own estimate."""


def _or_text(schema: dict[str, Any]) -> None:
    """Say, for editors, that a row may be the text of its function alone."""
    row = dict(schema)
    schema.clear()
    schema["anyOf"] = [{"type": "string", "description": row["properties"]["function"]["description"]}, row]


class Row(Part):
    """What every term says of itself; a text alone is its function."""

    model_config = ConfigDict(json_schema_extra=_or_text)

    function: str | SkipJsonSchema[Callable[..., Any]]
    """`file.py:name`, the file relative to the scenario's, or `package.module:name`."""
    unit: Text = "1"
    meaning: Text = ""

    @model_validator(mode="before")
    @classmethod
    def _text_alone(cls, row: Any) -> Any:
        return {"function": row} if isinstance(row, str) else row

    @field_validator("function")
    @classmethod
    def _names_a_place(cls, function: Any) -> Any:
        if isinstance(function, str) and not user_code.is_reference(function):
            raise ValueError(f"expected file.py:name or package.module:name, got {shown(function)}")
        return function


class Term(Row):
    """A term of the reward, or a condition that ends a vehicle's episode."""

    privileged: bool = False
    """Whether it uses the truth, as every function of two records does."""

    @property
    def described(self) -> str:
        """The meaning, with unit and privilege."""
        unit = "" if self.unit == "1" else f", {self.unit}"
        return f"{self.meaning}{unit}{' (privileged)' if self.privileged else ''}"


class ObservationField(Row):
    """A field of the observation; every entry is (value - center) / scale, clipped to [low, 1]."""

    group: Text = ""
    """What `observation.include` calls it; empty: its own name."""
    per: Per = "vehicle"
    size: int = Field(default=1, ge=1, le=64)
    """Entries of one value."""
    scale: Positive | Scale = 1.0
    low: Literal[-1, 0] = -1
    center: Number = 0.0
    """The value that reads 0."""
    planar: tuple[Annotated[int, Field(ge=0, lt=64)], ...] | None = None
    """Entries of a value that `observation.planar` keeps (none: all); an empty list drops the field."""


R = TypeVar("R", bound=Row)


class Registry(Generic[R]):
    """All terms of one kind: those of coopenv and those registered in this program."""

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
        ValueError: a term whose weight or switch in `used` is on uses the truth, and nothing says so.
    """
    known = kind.known(part.custom)
    for name, weight in used.items():
        if weight and known[name].privileged and not part.privileged:
            raise ValueError(f"privileged: must be true, because the {kind.kind} '{name}' uses the truth")


GROUPS = tuple(FIELDS)
"""Groups of fields of coopenv, in their order in an observation."""
USUAL_GROUPS = ("estimate", "quality", "bearings", "odometry", "messages", "goal")
"""Those of a scenario that does not name any."""
VALUES = "coopenv.api.terms.values"
"""Module that computes the values of the built-in fields and reward terms, in the order of their rows."""

OBSERVATION_FIELDS = Registry(
    "observation field",
    {
        name: ObservationField(
            function=f"{VALUES}:{row[0]}_values", group=group, **dict(zip(COLUMNS, row, strict=False))
        )
        for group, rows in FIELDS.items()
        for name, *row in rows
    },
)
REWARD_TERMS = Registry(
    "reward term",
    {
        name: Term(function=f"{VALUES}:reward_values", unit=unit, privileged=privileged, meaning=about)
        for name, unit, privileged, about in REWARDS
    },
)
TERMINATION_CONDITIONS = Registry(
    "termination condition",
    {name: Term(function=f"coopenv.world.collision:{place}", meaning=about) for name, place, about in CONDITIONS},
)
