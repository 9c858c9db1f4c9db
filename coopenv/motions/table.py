"""The table of the kinds of motion: columns of their commands, by name, unit and limit.

It stands below the scenario, which checks limits and counts columns without loading any Warp function.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coopenv.base.errors import check_one_of
from coopenv.base.installation import check_reference, is_reference
from coopenv.motions.own import POSE, CommandColumn, OwnDrive


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
        return OwnDrive(limits).columns
    found = []
    for name, unit, key in MOTIONS[limits.model].columns:
        high = getattr(limits, key)
        found.append(CommandColumn(name, unit, 0.0 if name == "speed" and not limits.reverse else -high, high, key))
    return tuple(found)


def further_bodies(limits: Any) -> int:
    """Return the number of boxes that a user's own drive has besides the vehicle's body. Raises CoopenvError."""
    import numpy as np

    drive = OwnDrive(limits)
    return len(drive.bodies(drive.start(np.zeros(len(POSE)))))
