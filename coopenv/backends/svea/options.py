"""What `env.reset(options={...})` takes on cars, and on what they have recorded."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coopenv.backends.base import IGNORED_OPTIONS
from coopenv.errors import CoopenvError, shown, suggest

OPTIONS = ("arm", "release")


@dataclass(frozen=True)
class Wishes:
    """What is asked for."""

    arm: bool = False
    """Whether cars are to drive."""
    release: bool = False
    """Whether that holds for cars, too, that somebody else has stopped."""


def wishes_of(options: Mapping[str, Any]) -> Wishes:
    """Return what is asked for.

    Raises:
        CoopenvError: an option is not known, or not what it must be.
    """
    for key in options:
        if key not in OPTIONS and key not in IGNORED_OPTIONS:
            raise CoopenvError(f"unknown option {shown(key)}{suggest(str(key), OPTIONS)}; known: arm, release")
    found = {name: options.get(name, False) for name in OPTIONS}
    for name, value in found.items():
        if not isinstance(value, bool):
            raise CoopenvError(f"option '{name}' must be true or false, got {shown(value)}")
    return Wishes(**found)
