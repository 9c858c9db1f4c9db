"""How well colours can be told from their background, as WCAG 2 defines it."""

import numpy as np
from matplotlib.colors import to_rgb

Colour = str | tuple[float, float, float]
LEAST = 4.5
"""Of text, as WCAG 2 asks for at level AA."""


def luminance(colour: Colour) -> float:
    """Return the relative luminance of a colour, 0 (black) to 1 (white)."""
    part = np.asarray(to_rgb(colour), float)
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def contrast(colour: Colour, background: Colour = "white") -> float:
    """Return the contrast of two colours, 1 (none) to 21 (black on white)."""
    low, high = sorted((luminance(colour), luminance(background)))
    return (high + 0.05) / (low + 0.05)
