"""The table of the kinds of motion: columns of their commands, by name, unit and limit.

It stands below the scenario, which checks limits and counts columns without loading any Warp function.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coopenv.base.errors import CoopenvError, check_one_of, shown
from coopenv.base.installation import blamed, check_reference, is_reference, load_reference


@dataclass(frozen=True)
class CommandColumn:
    """One column of a command: what an entry of an action spans as it goes from -1 to 1."""

    name: str  # of what is commanded
    unit: str  # of low and high
    low: float  # value of -1
    high: float  # value of 1
    limit: str = ""  # key of `[dynamics]` that sets `high`; empty: the class of the user's own drive sets it


@dataclass(frozen=True)
class MotionKind:
    """A kind of motion; the first column of its command is the forward speed, the second one turns the body."""

    functions: str
    """Place of its Warp function, `module:name`, see `coopenv.motions.dispatch`."""
    columns: tuple[tuple[str, str, str], ...] = ()
    """Name, unit, and key of `[dynamics]` that is the largest magnitude; empty: commands do not move it."""
    turning: tuple[str, str] = ("", "")
    """Keys of `[dynamics]` for the second column: the largest rate of its change, and its lag (s)."""


SPEED = ("speed", "m/s", "max_speed")
TURN_RATE = ("turn_rate", "rad/s", "max_turn_rate")
LATERAL_SPEED = ("lateral_speed", "m/s", "max_lateral_speed")

MOTIONS: Mapping[str, MotionKind] = {
    "bicycle": MotionKind(
        "coopenv.motions.bicycle:displacement",
        (SPEED, ("steering", "rad", "max_steering")),
        ("max_steering_rate", "steering_time_constant"),
    ),
    "differential_drive": MotionKind(
        "coopenv.motions.differential_drive:displacement",
        (SPEED, TURN_RATE),
        ("max_turn_acceleration", "turn_time_constant"),
    ),
    "omnidirectional": MotionKind(
        "coopenv.motions.omnidirectional:displacement",
        (SPEED, TURN_RATE, LATERAL_SPEED),
        ("max_turn_acceleration", "turn_time_constant"),
    ),
    "prescribed": MotionKind("coopenv.motions.prescribed:displacement"),
}
"""Kinds by name. `dynamics.model` chooses among those with columns; `motion.kind` chooses prescribed motion."""

DRIVES = tuple(name for name, kind in MOTIONS.items() if kind.columns)
"""Values of `dynamics.model`, beside `file.py:Class`; the place in this list is the kind's number in kernels."""


def check_model(model: str) -> None:
    """Check the name of a drive, or the place of the user's own class, without running its code.

    Raises:
        CoopenvError: there is no such drive, file or class.
    """
    if is_reference(model):
        check_reference(model)
    else:
        check_one_of("unknown model", model, (*DRIVES, "file.py:Class"))


def columns_of(limits: Any) -> tuple[CommandColumn, ...]:
    """Return the columns of the command of a vehicle by its `[dynamics]`.

    Raises:
        CoopenvError: the class of the user's own drive cannot be loaded, fails, or has no such columns.
    """
    if is_reference(limits.model):
        return own_columns(limits.model, made(limits))
    found = []
    for name, unit, key in MOTIONS[limits.model].columns:
        high = getattr(limits, key)
        found.append(CommandColumn(name, unit, 0.0 if name == "speed" and not limits.reverse else -high, high, key))
    return tuple(found)


def made(limits: Any) -> Any:
    """Return the user's own drive, made from the vehicle's `[dynamics]`. Raises CoopenvError: its code fails."""
    kind = load_reference(limits.model)
    with blamed(f"dynamics.model: {limits.model}"):
        return kind(limits)


def own_columns(model: str, drive: Any) -> tuple[CommandColumn, ...]:
    """Return the columns of a user's own drive, checked. Raises CoopenvError: they are not name, unit, low and high."""
    where, given = f"dynamics.model: {model}", getattr(drive, "columns", None)
    if not isinstance(given, list | tuple) or len(given) < 2:
        raise CoopenvError(f"{where}: columns: expected two or more (name, unit, low, high), got {shown(given)}")
    for row in given:
        try:
            name, unit, low, high = row
            valid = name.isidentifier() and isinstance(unit, str) and -1e9 <= float(low) < float(high) <= 1e9
        except (TypeError, ValueError, AttributeError):
            valid = False
        if not valid:
            raise CoopenvError(f"{where}: columns: expected (name, unit, low, high) with low < high, got {shown(row)}")
    return tuple(CommandColumn(name, unit, float(low), float(high)) for name, unit, low, high in given)
