"""Replay a sub-dataset through one filter per robot, and judge them with motion capture."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from coopenv.backends.mrclam.dataset import Dataset, Robot, wrap
from coopenv.backends.mrclam.events import OdometrySample, Variant, events
from coopenv.backends.mrclam.files import ROBOTS, Array
from coopenv.backends.mrclam.planar import MESSAGE_BYTES, SIGHTING_BYTES, PlanarFilter, Tuning
from coopenv.errors import DataError

POSE_CHI_SQUARE = 3


@dataclass(frozen=True, slots=True)
class Score:
    """One robot's errors against motion capture, over all instants at which motion capture is valid.

    Attributes:
        subject: 1..5.
        position_rmse_m: m.
        heading_rmse_deg: deg.
        anees: mean normalised estimation error squared of x, y, heading, divided by 3 (1: consistent).
        accepted: bearings used.
        rejected: bearings that the gate dropped.
        sent_bytes_per_s: what the robot's messages cost.
        us_per_update: processor time per event.
    """

    subject: int
    position_rmse_m: float
    heading_rmse_deg: float
    anees: float
    accepted: int
    rejected: int
    sent_bytes_per_s: float
    us_per_update: float


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One robot's estimates.

    Attributes:
        t: (K,) s since the time origin.
        pose: (K, 3) m, m, rad.
        covariance: (K, 3, 3).
    """

    t: Array
    pose: Array
    covariance: Array


def start_of(robot: Robot) -> tuple[float, tuple[float, float, float]]:
    """Return time (s) and pose (m, m, rad) of the robot's first odometry sample with valid ground truth.

    Raises:
        DataError: motion capture never sees the robot.
    """
    position, heading, _, valid = robot.truth.at(robot.odometry[:, 0])
    if not valid.any():
        raise DataError(f"robot {robot.subject}: no ground truth while it records odometry")
    first = int(np.argmax(valid))
    pose = (float(position[first, 0]), float(position[first, 1]), float(heading[first]))
    return float(robot.odometry[first, 0]), pose


def replay(dataset: Dataset, variant: Variant | None, tuning: Tuning) -> tuple[list[Track], list[Score]]:
    """Run one filter per robot over a sub-dataset.

    Every filter starts at its robot's true pose. A robot that sees another is sent that one's estimate of the
    same instant.

    Args:
        dataset: what to replay.
        variant: who sees what; None for dead reckoning.
        tuning: of all filters.
    """
    starts = [start_of(robot) for robot in dataset.robots]
    filters = [PlanarFilter(tuning, *start) for start in starts]
    points = {subject - 1: (float(p[0]), float(p[1])) for subject, p in dataset.landmarks.items()}
    tracks: list[list[tuple[float, Array, Array]]] = [[] for _ in filters]
    sent, spent, count = [0] * len(filters), [0.0] * len(filters), [0] * len(filters)
    for event in events(dataset, variant or "landmarks"):
        own, i = filters[event.robot], event.robot
        before = time.perf_counter()
        last = own.t
        if isinstance(event, OdometrySample):
            own.odometry(event.t, event.v, event.omega)
        elif variant and event.t >= starts[i][0]:
            own.advance(event.t)
            for target, (x, y, _) in zip(event.targets, event.bearings.tolist(), strict=True):
                bearing = math.atan2(y, x)
                if target >= len(ROBOTS):
                    own.landmark(bearing, *points[target])
                elif event.t >= starts[target][0]:
                    filters[target].advance(event.t)
                    ours, theirs = own.message(), filters[target].message()
                    own.robot(bearing, theirs)
                    sent[target] += MESSAGE_BYTES
                    if tuning.mutual:
                        filters[target].seen(bearing, ours)
                        sent[i] += SIGHTING_BYTES
        spent[i] += time.perf_counter() - before
        count[i] += 1
        if own.t > last:
            tracks[i].append((own.t, own.state[:3].copy(), own.covariance[:3, :3]))
    results = [Track(*(np.array(column) for column in zip(*track, strict=True))) for track in tracks]
    scores = []
    for i, (robot, track, own) in enumerate(zip(dataset.robots, results, filters, strict=True)):
        lasted = max(float(track.t[-1] - track.t[0]), 1e-9)
        position, heading, anees = errors(robot, track)
        scores.append(
            Score(
                subject=robot.subject,
                position_rmse_m=position,
                heading_rmse_deg=heading,
                anees=anees,
                accepted=own.accepted,
                rejected=own.rejected,
                sent_bytes_per_s=sent[i] / lasted,
                us_per_update=1e6 * spent[i] / max(count[i], 1),
            )
        )
    return results, scores


def errors(robot: Robot, track: Track) -> tuple[float, float, float]:
    """Return position RMSE m, heading RMSE deg, and normalised estimation error squared over 3 (NaN where no truth)."""
    position, heading, valid, heading_valid = robot.truth.at(track.t)
    apart = track.pose[:, :2] - position
    turned = wrap(track.pose[:, 2] - heading)
    both = valid & heading_valid
    error = np.concatenate([apart, turned[:, None]], axis=1)[both]
    weighted = np.linalg.solve(track.covariance[both], error[..., None])[..., 0]
    return (
        _root_mean(np.sum(apart**2, axis=1)[valid]),
        math.degrees(_root_mean((turned**2)[heading_valid])),
        float(np.mean(np.sum(error * weighted, axis=1)) / POSE_CHI_SQUARE) if both.any() else math.nan,
    )


def _root_mean(squares: Array) -> float:
    return math.sqrt(float(np.mean(squares))) if squares.size else math.nan
