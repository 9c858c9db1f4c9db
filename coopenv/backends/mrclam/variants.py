"""What of a recording an observer gets to see: the scored variants."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, get_args

import numpy as np

from coopenv.backends.mrclam.dataset import Frame, Robot
from coopenv.backends.mrclam.files import ROBOTS
from coopenv.errors import DataError, suggest

Variant = Literal["landmarks", "landmarks+robots", "blind"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
BLIND_ROBOTS = (3, 4, 5)


def check_variant(name: str) -> None:
    """Refuse a name that is no variant.

    Raises:
        DataError: it is none.
    """
    if name not in VARIANTS:
        raise DataError(f"unknown variant {name!r}{suggest(str(name), VARIANTS)}; there are {', '.join(VARIANTS)}")


def frames_of(robot: Robot, variant: Variant) -> Iterator[Frame]:
    """Yield a robot's camera frames with what the variant lets through; those with nothing left are left out.

    Args:
        robot: whose camera.
        variant: `landmarks`: no robot sees another; `landmarks+robots`: everything seen counts; `blind`: as before,
            but robots 3 to 5 see no landmark.
    """
    for frame in robot.frames:
        is_robot = frame.subjects <= len(ROBOTS)
        if variant == "landmarks":
            keep = ~is_robot
        elif variant == "blind" and robot.subject in BLIND_ROBOTS:
            keep = is_robot
        else:
            keep = np.ones_like(is_robot)
        keep &= frame.subjects != robot.subject  # its own barcode is a misreading
        if keep.any():
            yield Frame(frame.t, frame.subjects[keep], frame.ranges[keep], frame.bearings[keep])
