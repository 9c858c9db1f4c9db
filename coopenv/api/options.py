"""What `reset(options={...})` takes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from coopenv.errors import CoopenvError, shown, suggest

OF_TESTS = ("options",)
"""What PettingZoo's own tests of conformance pass to every environment."""


def checked_options(options: object, known: tuple[str, ...], ignored: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return options by name, without those that are None.

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
    return {key: value for key, value in options.items() if value is not None}


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
