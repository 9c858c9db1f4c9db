"""How faults are written on the command line.

    FAULT = PART[+PART...]                                several faults in one variant
    PART  = NAME=VALUE[@VEHICLE[:VEHICLE...]][,OPTION=VALUE...]

For example `lie=drift:0.05@vehicle_2,from=10` or `gyro_bias=0.0175+odometry_scale=0.05`.
"""

import math
import re
from dataclasses import dataclass

from coopenv.base.errors import CoopenvError, shown

GRAMMAR = "NAME=VALUE[@VEHICLE[:VEHICLE...]][,OPTION=VALUE...], several of them with + between"


@dataclass(frozen=True)
class Part:
    """One fault as it is written."""

    where: str
    """The beginning of an error about it."""
    name: str
    value: str
    who: tuple[str, ...]
    """Names of vehicles; empty: left to the fault."""
    options: dict[str, float]

    @property
    def amount(self) -> float:
        """The value as a number.

        Raises:
            CoopenvError: it is none.
        """
        return number(self.value, f"{self.where}: {self.name}")


def parts_of(text: str) -> tuple[Part, ...]:
    """Read the faults of one variant.

    Raises:
        CoopenvError: it is not written as the grammar says.
    """
    where = f"--fault {text}"
    return tuple(_part(word, where) for word in re.split(r"\+(?=[A-Za-z_])", text.strip()))


def number(text: str, where: str) -> float:
    """Return a finite number that is not negative.

    Raises:
        CoopenvError: it is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise CoopenvError(f"{where}: expected a number from 0 on, got {shown(text)}")
    return value


def _part(text: str, where: str) -> Part:
    first, *more = text.split(",")
    name, equals, rest = first.partition("=")
    value, at, who = rest.partition("@")
    if not (name and equals and value) or (at and not all(who.split(":"))):
        raise CoopenvError(f"{where}: expected {GRAMMAR}")
    options = {}
    for word in more:
        key, equals, given = word.partition("=")
        if not equals:
            raise CoopenvError(f"{where}: {shown(word)} is no OPTION=VALUE")
        options[key] = number(given, f"{where}: {key}")
    return Part(where, name, value, tuple(who.split(":")) if at else (), options)
