"""Terms of one's own, made known by name in a program; docs/terms.md shows how."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import ValidationError

from coopenv.errors import CoopenvError
from coopenv.scenario.term_tables import OBSERVATION_FIELDS, REWARD_TERMS, TERMINATION_CONDITIONS
from coopenv.scenario.terms import ObservationField, Per, Registry, RewardTerm, Scale, Term, TerminationCondition
from coopenv.scenario.validation import one_line

Row = TypeVar("Row", bound=Term)


def register_reward(name: str, function: Callable[..., Any], *, unit: str = "1", meaning: str = "") -> None:
    """Make a reward term known by name; a scenario weighs it with `reward.weights.<name>`.

    Args:
        name: an identifier.
        function: of the records `Ego`, or `Ego` and `Truth` (`coopenv.api.terms.records`); returns a number. A Warp
            function, or a plain one that can be one. Taking the truth makes the term privileged.
        unit: of the value.
        meaning: one line for tables; empty: the first line of the function's docstring.

    Raises:
        CoopenvError: the name is no identifier or taken, or it is no function of one or two records.
    """
    privileged = _records(REWARD_TERMS, name, function, (1, 2)) == 2
    _register(REWARD_TERMS, RewardTerm, name, function, meaning, unit=unit, privileged=privileged)


def register_termination(name: str, function: Callable[..., Any], *, meaning: str = "") -> None:
    """Make a termination condition known by name; a scenario switches it on with `termination.<name> = true`.

    It is checked after every decision, and `info["outcome"]` of the vehicles whose episodes it ends is its name.

    Args:
        name: an identifier.
        function: as for `register_reward`, but returns whether the vehicle's episode ends.
        meaning: one line for tables; empty: the first line of the function's docstring.

    Raises:
        CoopenvError: the name is no identifier or taken, or it is no function of one or two records.
    """
    privileged = _records(TERMINATION_CONDITIONS, name, function, (1, 2)) == 2
    _register(TERMINATION_CONDITIONS, TerminationCondition, name, function, meaning, privileged=privileged)


def register_observation(
    name: str,
    function: Callable[..., Any],
    *,
    per: Per = "vehicle",
    size: int = 1,
    unit: str = "1",
    scale: float | Scale = 1.0,
    low: int = -1,
    meaning: str = "",
) -> None:
    """Make an observation field known by name; a scenario lists it in `observation.include`.

    Args:
        name: an identifier.
        function: of the record `Ego`, and of `Target` or `Neighbour` if there is one value for each of these
            (`coopenv.api.terms.records`); returns a number, or a vector of `size`. A Warp function, or a plain one that
            can be one. No truth is at hand in these records.
        per: "vehicle": one value; "target": one for every landmark and vehicle; "neighbour": one for every other
            vehicle.
        size: entries of one value.
        unit: of the value.
        scale: what the value is divided by: a number, or the name of a scale of `[observation]`.
        low: -1, or 0 for what is never negative: the lower end of the range.
        meaning: one line for tables; empty: the first line of the function's docstring.

    Raises:
        CoopenvError: the name is no identifier or taken, another argument has no such value, or it is no function of
            these records.
    """
    _records(OBSERVATION_FIELDS, name, function, (1 if per == "vehicle" else 2,))
    columns = {"per": per, "size": size, "unit": unit, "scale": scale, "low": low}
    _register(OBSERVATION_FIELDS, ObservationField, name, function, meaning, **columns)


def _records(kind: Registry[Any], name: object, function: Any, allowed: tuple[int, ...]) -> int:
    """Return how many records a function takes, which has to be one of the numbers allowed."""
    plain = getattr(function, "func", function)  # a Warp function holds the plain one
    if not inspect.isfunction(plain):
        raise CoopenvError(f"{kind.kind} '{name}': expected a function, got {function!r:.60}")
    taken = len(inspect.signature(plain).parameters)
    if taken not in allowed:
        expected = " or ".join(map(str, allowed))
        raise CoopenvError(f"{kind.kind} '{name}': its function takes {taken} records, expected {expected}")
    return taken


def _register(
    kind: Registry[Row], row: type[Row], name: str, function: Callable[..., Any], meaning: str, **columns: Any
) -> None:
    text = meaning or (inspect.getdoc(function) or "").partition("\n")[0]
    try:
        made = row(function=function, meaning=text, **columns)
    except ValidationError as error:
        raise CoopenvError(one_line(error, f"{kind.kind} '{name}'", row)) from None
    kind.register(name, made)
