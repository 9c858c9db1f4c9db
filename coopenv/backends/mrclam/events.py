"""All five robots' samples as one stream in the order of time, as a replay feeds them to observers.

A bearing beta becomes the unit vector b = (cos beta, sin beta, 0) in the body frame, x forward, z up, towards what
was seen. Ranges stay beside them: the benchmark is bearing-only.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from coopenv.backends.mrclam.dataset import Dataset, Robot
from coopenv.backends.mrclam.files import ROBOTS, Array
from coopenv.errors import DataError, suggest

Variant = Literal["landmarks", "landmarks+robots", "blind"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
BLIND_ROBOTS = (3, 4, 5)


@dataclass(slots=True)
class OdometrySample:
    """A command that holds until the robot's next one.

    Attributes:
        t: s since the time origin.
        robot: 0..4.
        v: m/s forward.
        omega: rad/s about the vertical.
    """

    t: float
    robot: int
    v: float
    omega: float


@dataclass(slots=True, eq=False)
class CameraFrame:
    """Everything that one camera saw at one time stamp and that the variant lets through.

    Attributes:
        t: s since the time origin.
        robot: 0..4.
        targets: who was seen, 0..4 robots, 5..19 landmarks (subject - 1).
        bearings: (n, 3) unit vectors in the body frame.
        ranges: (n,) m, for observers beyond the bearing-only benchmark.
    """

    t: float
    robot: int
    targets: tuple[int, ...]
    bearings: Array
    ranges: Array


Event = OdometrySample | CameraFrame


def events(dataset: Dataset, variant: Variant) -> Iterator[Event]:
    """Yield all events in the order of time; at equal times odometry first, then by robot.

    Args:
        dataset: what to replay.
        variant: `landmarks`: no robot sees another; `landmarks+robots`: everything seen counts; `blind`: as before,
            but robots 3 to 5 see no landmark.

    Raises:
        DataError: unknown variant.
    """
    if variant not in VARIANTS:
        raise DataError(
            f"unknown variant {variant!r}{suggest(str(variant), VARIANTS)}; there are {', '.join(VARIANTS)}"
        )
    streams = [_odometry(robot) for robot in dataset.robots] + [_frames(robot, variant) for robot in dataset.robots]
    return (event for _, _, event in heapq.merge(*streams, key=lambda entry: entry[:2]))


Keyed = tuple[float, int, Event]


def _odometry(robot: Robot) -> Iterator[Keyed]:
    index = robot.subject - 1
    for t, v, omega in robot.odometry.tolist():
        yield t, index, OdometrySample(t, index, v, omega)


def _frames(robot: Robot, variant: Variant) -> Iterator[Keyed]:
    index = robot.subject - 1
    for frame in robot.frames:
        is_robot = frame.subjects <= len(ROBOTS)
        if variant == "landmarks":
            keep = ~is_robot
        elif variant == "blind" and robot.subject in BLIND_ROBOTS:
            keep = is_robot
        else:
            keep = np.ones_like(is_robot)
        keep &= frame.subjects != robot.subject  # its own barcode is a misreading
        if not keep.any():
            continue
        beta = frame.bearings[keep]
        bearings = np.stack([np.cos(beta), np.sin(beta), np.zeros_like(beta)], axis=-1)
        targets = tuple((frame.subjects[keep] - 1).tolist())
        yield frame.t, len(ROBOTS) + index, CameraFrame(frame.t, index, targets, bearings, frame.ranges[keep])
