"""What `reset(options={...})` takes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, shown, suggest
from coopenv.scenario import Scenario
from coopenv.scenario.randomness import LEVELS, PARAMETERS

SETTINGS = ("parameters", "difficulty")
"""Options that hold until they are given again."""


def checked_options(options: object, known: tuple[str, ...], ignored: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return options by name.

    Raises:
        CoopenvError: they are not a dict, or one of them is not known.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise CoopenvError(f"options must be a dict, got {type(options).__name__}")
    for key in options:
        if key not in known and key not in ignored:
            raise CoopenvError(f"unknown option {shown(key)}{suggest(str(key), known)}; known: {', '.join(known)}")
    return dict(options)


def world_number(value: object) -> int:
    """Return the option `world`, a number below 2^32.

    Raises:
        CoopenvError: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= value < 2**32:
        raise CoopenvError(f"option 'world' must be a whole number from 0 to 2^32 - 1, got {shown(value)}")
    return int(value)


def world_mask(value: object, worlds: int, vehicles: int) -> np.ndarray:
    """Return the option `reset_mask`, one bool per row (world, vehicle) or per world, as (worlds,).

    Raises:
        CoopenvError: it is something else, or splits a world.
    """
    try:
        chosen = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        chosen = np.empty(0)
    if chosen.dtype != bool or not chosen.any():
        raise CoopenvError("reset_mask must be an array of bool with at least one True")
    if chosen.shape == (worlds * vehicles,):
        by_world = chosen.reshape(worlds, vehicles)
        split = np.flatnonzero(by_world.any(axis=1) != by_world.all(axis=1))
        if split.size:
            raise CoopenvError(f"reset_mask splits world {split[0]}: its {vehicles} rows are reset together")
        chosen = by_world[:, 0]
    if chosen.shape != (worlds,):
        expected = f"({worlds * vehicles},) rows or ({worlds},) worlds"
        raise CoopenvError(f"reset_mask has shape {chosen.shape}, expected {expected}")
    return chosen


def world_parameters(options: Mapping[str, Any], worlds: int, scenario: Scenario) -> dict[str, np.ndarray]:
    """Return the options `parameters` and `difficulty`, as far as they are given, as (worlds,) by name.

    Raises:
        CoopenvError: one is not known, or not what it must be.
    """
    factors = options.get("parameters") if options.get("parameters") is not None else {}
    if not isinstance(factors, Mapping):
        raise CoopenvError(f"option 'parameters' must be a dict, got {type(factors).__name__}")
    found = {}
    for name, value in factors.items():
        if name not in PARAMETERS:
            near = suggest(str(name), PARAMETERS)
            raise CoopenvError(f"unknown parameter {shown(name)}{near}; known: {', '.join(PARAMETERS)}")
        _, low, high = PARAMETERS[name]
        if name == "traffic_pace" and not scenario.paced:
            high = 1.0  # motions are worked out for the horizon alone
        found[name] = (
            np.full(worlds, np.nan) if value is None else _numbers(f"parameter '{name}'", value, worlds, low, high)
        )
    if "difficulty" in options:
        value = options["difficulty"]
        level = scenario.difficulty.number if value is None else value
        if isinstance(level, str):
            if level not in LEVELS:
                raise CoopenvError(
                    f"unknown difficulty {shown(level)}{suggest(level, LEVELS)}; known: {', '.join(LEVELS)}"
                )
            level = LEVELS[level]
        found["difficulty"] = _numbers("option 'difficulty'", level, worlds, 0.0, 1.0)
        if value is not None and not scenario.difficulty.matters:
            raise CoopenvError("option 'difficulty': nothing depends on it here: no factors under [difficulty]")
    return found


def _numbers(what: str, value: object, worlds: int, low: float, high: float) -> np.ndarray:
    """Return a number, or one per world, as (worlds,)."""
    try:
        given = np.asarray(value)
        numbers = given.astype(float) if given.dtype.kind in "fiu" else np.array(np.nan)
    except (TypeError, ValueError, RuntimeError):
        numbers = np.array(np.nan)
    if numbers.shape not in ((), (worlds,)):
        raise CoopenvError(f"{what} has shape {numbers.shape}, expected a number or one per world, ({worlds},)")
    if not ((numbers >= low) & (numbers <= high)).all():
        raise CoopenvError(f"{what} must be from {low:g} to {high:g}, got {shown(value)}")
    return np.broadcast_to(numbers, (worlds,)).copy()
