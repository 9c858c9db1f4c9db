"""Rows of the term tables: what an observation holds, what a reward weighs, what ends a vehicle's episode.

A row says what a term is and names the function that computes it. From the rows come the layout of an observation, the
weights that a scenario may set, the kernel (`coopenv.api.terms`), and the tables of `coopenv describe`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Generic, Literal, TypeVar

from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from coopenv import user_code
from coopenv.errors import CoopenvError, suggest
from coopenv.scenario.base import Part, Positive

Scale = Literal["position_scale", "velocity_scale", "angular_velocity_scale", "age_scale", "targets"]
"""A setting of `[observation]`, or the number of targets."""
Per = Literal["vehicle", "target", "neighbour"]
"""One value of the vehicle itself, one of every target (landmarks, then vehicles), or one of every other vehicle."""


class Term(Part):
    """A term of any kind; a text alone is its function."""

    function: str | SkipJsonSchema[Callable[..., Any]]
    """`file.py:name`, the file relative to the scenario's, or `package.module:name`."""
    unit: str = "1"
    meaning: str = ""

    @model_validator(mode="before")
    @classmethod
    def _text_alone(cls, row: Any) -> Any:
        return {"function": row} if isinstance(row, str) else row

    @field_validator("function")
    @classmethod
    def _names_a_place(cls, function: Any) -> Any:
        if isinstance(function, str) and not user_code.is_reference(function):
            raise ValueError(f"expected file.py:name or package.module:name, got '{function:.60}'")
        return function


class TruthTerm(Term):
    """A term that may read the truth."""

    privileged: bool = False
    """Whether it reads the truth."""

    @property
    def described(self) -> str:
        """The meaning, with unit and privilege."""
        unit = "" if self.unit == "1" else f", {self.unit}"
        return f"{self.meaning}{unit}{' (privileged)' if self.privileged else ''}"


class RewardTerm(TruthTerm):
    """A term of the reward."""


class TerminationCondition(TruthTerm):
    """What ends a vehicle's episode, checked after every decision."""


class ObservationField(Term):
    """A field of the observation; every entry is value / scale, clipped to [low, 1]."""

    group: str = ""
    """What `observation.include` calls it; empty: its own name."""
    per: Per = "vehicle"
    size: int = Field(default=1, ge=1, le=64)
    """Entries of one value."""
    scale: Positive | Scale = 1.0
    low: Literal[-1, 0] = -1


Row = TypeVar("Row", bound=Term)


class Registry(Generic[Row]):
    """All terms of one kind: those of coopenv and those registered in this program."""

    def __init__(self, kind: str, built_in: Mapping[str, Row]) -> None:
        self.kind = kind
        self.built_in = built_in
        self._registered: dict[str, Row] = {}

    def known(self, custom: Mapping[str, Row]) -> dict[str, Row]:
        """Return every term that a scenario may name whose own terms are `custom`."""
        return {**self.built_in, **self._registered, **custom}

    def check_name(self, name: object) -> None:
        """Check that a new term may have a name.

        Raises:
            CoopenvError: it is no identifier, or taken by coopenv.
        """
        if not isinstance(name, str) or not name.isidentifier():
            raise CoopenvError(f"the name of a {self.kind} is an identifier, got {name!r}")
        if name in self.built_in or name in ("custom", "privileged"):
            raise CoopenvError(f"a {self.kind} named '{name}' exists already")

    def check_names(self, names: Iterable[str]) -> None:
        """Check the names of a scenario's own terms.

        Raises:
            ValueError: one of them is no identifier, or taken by coopenv.
        """
        for name in names:
            try:
                self.check_name(name)
            except CoopenvError as error:
                raise ValueError(f"custom.{name}: {error}") from None

    def register(self, name: str, row: Row) -> None:
        """Make a term known by name in this program; one that is defined anew replaces its former self.

        Raises:
            CoopenvError: it is no identifier, or taken by another term.
        """
        self.check_name(name)
        former = self._registered.get(name)
        if former is not None and _home(former.function) != _home(row.function):
            raise CoopenvError(f"a {self.kind} named '{name}' exists already")
        self._registered[name] = row

    def check_known(self, names: Iterable[str], custom: object, where: str = "") -> None:
        """Check the names that a scenario uses.

        Args:
            names: which they are.
            custom: the scenario's own terms, plain data.
            where: begins the error.

        Raises:
            ValueError: no term has one of them.
        """
        known = {*self.built_in, *self._registered, *(custom if isinstance(custom, dict) else ())}
        for name in names:
            if name not in known:
                near = suggest(name, known) or f"; allowed: {', '.join(sorted(known))}"
                raise ValueError(f"{where}{name}: unknown key{near}")


def _home(function: Any) -> tuple[str, str]:
    return function.__module__, function.__qualname__
