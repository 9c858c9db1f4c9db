"""Errors that a user can cause, each a `ValueError` with one clear line."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class CoopenvError(ValueError):
    """Base of all errors that name a mistake in the input."""


class UnknownEnvironmentError(CoopenvError):
    """The name is neither a file stem of `envs/` nor a readable TOML path."""


class ScenarioError(CoopenvError):
    """A scenario file or an override does not describe a possible world."""


class ActionError(CoopenvError):
    """An action has the wrong shape, dtype, agent or value."""


class DeviceError(CoopenvError):
    """The device or precision asked for does not exist here."""


class OutputError(CoopenvError):
    """A result cannot be written where it should go."""


class DataError(CoopenvError):
    """A recorded file is not what it claims to be."""


class ScenarioWarning(UserWarning):
    """The scenario is possible but the theory's conditions may not hold."""


class DataWarning(UserWarning):
    """A recorded file is what it claims to be, but says less than it should."""


def checked_seed(seed: object) -> int:
    """Return a seed as an int.

    Raises:
        CoopenvError: it is not a whole number, or negative.
    """
    if isinstance(seed, bool) or not hasattr(seed, "__index__"):
        raise CoopenvError(f"seed must be a whole number, got {seed!r}")
    number = seed.__index__()
    if number < 0:
        raise CoopenvError(f"seed must not be negative, got {number}")
    return int(number)


def suggest(word: str, valid: Iterable[str]) -> str:
    """Return ` (did you mean 'x'?)` for the nearest valid word, else the empty string."""
    near = get_close_matches(word, list(valid), n=1, cutoff=0.5)
    return f" (did you mean '{near[0]}'?)" if near else ""
