"""Parts of a recording, changed: other odometry, hidden landmarks, wrong barcodes, clocks that are off."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.mrclam.dataset import Dataset, MotionCapture, Robot

LANDMARKS_FROM = 6  # subjects below that are robots
Change = Callable[[Robot, np.random.Generator], Robot]


def part(data: Dataset, start: float, seconds: float) -> Dataset:
    """Return a stretch of a sub-dataset, from a time in s."""
    return replace(
        data, duration_s=seconds, robots=tuple(_part(robot, start, start + seconds) for robot in data.robots)
    )


def changed(data: Dataset, seed: int, *changes: Change) -> Dataset:
    """Return a sub-dataset with every robot changed."""
    rng, robots = np.random.default_rng(seed), data.robots
    for change in changes:
        robots = tuple(change(robot, rng) for robot in robots)
    return replace(data, robots=robots)


def odometry(turns: float = 1.0, speed: float = 1.0, rate: float | None = None) -> Change:
    """Tell turns and speeds so many times larger, and log them at a rate in Hz."""

    def change(robot: Robot, rng: np.random.Generator) -> Robot:
        told = robot.odometry * (1.0, speed, turns)
        if rate is not None:
            at = np.arange(told[-1, 0] * rate) / rate + rng.uniform(0, 1 / rate)
            told = told[np.unique(np.clip(np.searchsorted(told[:, 0], at), 0, len(told) - 1))]
        return replace(robot, odometry=told)

    return change


def hidden(seen: tuple[float, float], gap: tuple[float, float]) -> Change:
    """Hide the landmarks for a gap in s, again and again, between stretches in s in which they are seen."""

    def change(robot: Robot, rng: np.random.Generator) -> Robot:
        t, of = robot.detections[:, 0], robot.detections[:, 1]
        kept, end = np.ones(len(t), dtype=bool), 0.0
        while end < t[-1]:
            start = end + rng.uniform(*seen)
            end = start + rng.uniform(*gap)
            kept &= ~((t > start) & (t < end) & (of >= LANDMARKS_FROM))
        return replace(robot, detections=robot.detections[kept])

    return change


def misread(share: float) -> Change:
    """Let a share of the sightings be of any landmark."""

    def change(robot: Robot, rng: np.random.Generator) -> Robot:
        seen = robot.detections.copy()
        wrong = rng.random(len(seen)) < share
        seen[wrong, 1] = rng.integers(LANDMARKS_FROM, 21, wrong.sum())
        return replace(robot, detections=seen)

    return change


def clocks(off: float) -> Change:
    """Date the sightings later by a time in s."""

    def change(robot: Robot, rng: np.random.Generator) -> Robot:
        return replace(robot, detections=np.add(robot.detections, (off, 0.0, 0.0, 0.0)))

    return change


def drifting(rate: float) -> Change:
    """Let the odometry turn by a rate in rad/s more than the robot."""

    def change(robot: Robot, rng: np.random.Generator) -> Robot:
        return replace(robot, odometry=np.add(robot.odometry, (0.0, 0.0, rate)))

    return change


def _part(robot: Robot, start: float, end: float) -> Robot:
    told, seen, truth = robot.odometry, robot.detections, robot.truth
    before = max(int(np.searchsorted(told[:, 0], start, side="right")) - 1, 0)  # the command held at the start
    told = _from(told[before:][told[before:, 0] <= end], start)
    told[0, 0] = max(told[0, 0], 0.0)
    at = (truth.t >= start) & (truth.t <= end + 1.0)
    return replace(
        robot,
        odometry=told,
        detections=_from(seen[(seen[:, 0] >= start) & (seen[:, 0] <= end)], start),
        truth=MotionCapture(truth.t[at] - start, truth.position[at], truth.heading[at]),
    )


def _from(rows: Array, start: float) -> Array:
    return np.asarray(rows - (start, *(0.0,) * (rows.shape[1] - 1)))
