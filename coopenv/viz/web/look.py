"""What of a scene is shown, and how large."""

from dataclasses import dataclass

import numpy as np
from matplotlib.colors import to_rgb

from coopenv.viz.style import vehicle_colour

_AT_ONCE = 4  # names and fields of view in a frame while it plays


@dataclass
class Look:
    """Choices of whoever looks, and measures that follow from the scene's size."""

    magnification: float = 1.0
    """Of the ellipsoids."""
    ellipsoids: bool = True
    estimates: bool = True
    sight: bool = True
    """Lines of sight."""
    only: int | None = None
    """The vehicle whose lines of sight alone are shown; None: those of all."""
    views: bool = True
    """Fields of view."""
    messages: bool = True
    trails: bool = True
    names: bool = True


def in_turn(turn: int | None, count: int) -> slice:
    """Return which of so many names, or fields of view, are sent in a turn: half, at most four; None: all of them."""
    parts = max(2, -(-count // _AT_ONCE))
    return slice(None) if turn is None else slice(turn % parts, None, parts)


def rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour of Matplotlib as three whole numbers up to 255."""
    r, g, b = (round(255 * part) for part in to_rgb(colour))
    return r, g, b


def linear(colours: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) as viser wants those of many things at once: linear in light, uint8."""
    share = np.asarray(colours, float) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(255.0 * light), np.uint8)


def vehicle_colours(count: int) -> np.ndarray:
    """Return (N, 3) uint8, the colour of each vehicle."""
    return np.array([rgb(vehicle_colour(i)) for i in range(count)], np.uint8).reshape(-1, 3)
