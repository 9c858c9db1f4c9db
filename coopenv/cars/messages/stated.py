"""Context that messages state beside their values, untested: frames, variances, binning and region of a camera."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

LONGEST_FRAME = 128  # characters of a frame's name


@dataclass(frozen=True, slots=True)
class Stated:
    """Context of the value of a message, unchanged; defaults: not stated."""

    frame: str = ""  # of the header
    child_frame: str = ""  # of the twist of an Odometry, and of the body of a transform
    pose_variances: tuple[float, ...] = ()  # (6,) m^2 and rad^2: x, y, z, then about them; 0, -1 or NaN: unknown
    twist_variances: tuple[float, ...] = ()  # (6,) likewise, or (3,) of the turn rate of an IMU
    binning: tuple[int, int] = (1, 1)  # pixels of the sensor in a pixel of the image, across and down
    region: tuple[int, int, int, int] = (0, 0, 0, 0)  # left, top, width, height in pixels of the sensor; 0: all of it


NOTHING = Stated()


def stated(message: Any) -> Stated:
    """Return what a message states beside its value; fields that are absent or of another kind count as not stated."""
    header = getattr(message, "header", None)
    return _stated(
        str(getattr(header, "frame_id", ""))[:LONGEST_FRAME],
        str(getattr(message, "child_frame_id", ""))[:LONGEST_FRAME],
        _variances(getattr(getattr(message, "pose", None), "covariance", ())),
        _variances(
            getattr(getattr(message, "twist", None), "covariance", getattr(message, "angular_velocity_covariance", ()))
        ),
        *(_pixels(message) if hasattr(message, "roi") else ()),
    )


_stated = lru_cache(maxsize=256)(Stated)
"""Most messages of a topic state the same."""


def _pixels(message: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return binning and region of a CameraInfo."""
    sides = ("x_offset", "y_offset", "width", "height")
    binning = tuple(max(1, int(getattr(message, f"binning_{axis}", 1))) for axis in "xy")
    return binning, tuple(int(getattr(message.roi, name, 0)) for name in sides)


def _variances(covariance: Any) -> tuple[float, ...]:
    """Return the diagonal of a covariance, as a list of the rows of a matrix 6 x 6 or 3 x 3."""
    side = {36: 6, 9: 3}.get(np.size(covariance))
    return () if side is None else tuple(np.asarray(covariance[:: side + 1], dtype=np.float64).tolist())
