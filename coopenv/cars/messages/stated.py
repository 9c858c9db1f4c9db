"""Context that messages state beside their values, untested: frames, binning and region of a camera."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

LONGEST_FRAME = 128  # characters of a frame's name


@dataclass(frozen=True, slots=True)
class Stated:
    """Context of the value of a message, unchanged; defaults: not stated."""

    frame: str = ""  # of the header
    child_frame: str = ""  # of the twist of an Odometry, and of the body of a transform
    binning: tuple[int, int] = (1, 1)  # pixels of the sensor in a pixel of the image, across and down
    region: tuple[int, int, int, int] = (0, 0, 0, 0)  # left, top, width, height in pixels of the sensor; 0: all of it


NOTHING = Stated()
_stated = lru_cache(maxsize=256)(Stated)
"""Most messages of a topic state the same."""


def stated(message: Any) -> Stated:
    """Return what a message states beside its value; fields that are absent or of another kind count as not stated."""
    frame = str(getattr(getattr(message, "header", None), "frame_id", ""))[:LONGEST_FRAME]
    child = str(getattr(message, "child_frame_id", ""))[:LONGEST_FRAME]
    if not hasattr(message, "roi"):
        return _stated(frame, child)
    binning = tuple(max(1, int(getattr(message, f"binning_{axis}", 1))) for axis in "xy")
    sides = ("x_offset", "y_offset", "width", "height")
    return _stated(frame, child, binning, tuple(int(getattr(message.roi, name, 0)) for name in sides))
