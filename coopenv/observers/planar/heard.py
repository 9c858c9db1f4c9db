"""What other robots tell, looked at before it is believed: no message may end a run or outweigh what was measured."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Received
from coopenv.observers.planar.state import PlanarPose

OLDEST_S = 2.0
SPEED = 0.15  # m/s, by which a robot may have moved since it told where it is
LEAST_STD = (0.01, 0.002)  # m, rad; nobody knows better
FARTHEST_M = 1e6
MOST_SEEN = 64  # robots, of which one message may tell
POSE_NUMBERS = 9  # x, y, heading and the triangle of their covariance
LOWER = np.tril_indices(3)


def place_of(received: Received) -> PlanarPose | None:
    """Return where a robot is by its own word; None where that is no place or older than 2 s.

    Of a neighbour's heading nothing is needed, so it is 0 and certain.
    """
    position, told = received.message.position, received.message.covariance
    if position is None or told is None or not 0.0 <= received.age <= OLDEST_S:
        return None
    p, P = np.asarray(position, dtype=float), np.asarray(told, dtype=float)
    if p.shape != (3,) or P.ndim != 2 or min(P.shape) < 2 or not _plausible(p[:2], P[:2, :2]):
        return None
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = (P[:2, :2] + P[:2, :2].T) / 2
    covariance[[0, 1], [0, 1]] += LEAST_STD[0] ** 2 + (SPEED * received.age) ** 2
    return PlanarPose(np.array([p[0], p[1], 0.0]), covariance)


class Sightings(NamedTuple):
    """What a robot tells of whom it saw."""

    by: PlanarPose  # where it was
    seen: list[tuple[int, float]]  # targets and bearings, rad
    sure: bool  # whether landmarks showed it lately that it is not lost


def sightings_of(extra: Mapping[str, Array]) -> Sightings | None:
    """Return what a robot tells of whom it saw; None where that makes no sense."""
    seen, bearing, told, sure = (np.asarray(extra.get(name, ())) for name in ("seen", "bearing", "from", "sure"))
    if any(numbers.dtype.kind not in "buif" for numbers in (seen, bearing, told, sure)):
        return None
    if told.shape != (POSE_NUMBERS,) or seen.ndim != 1 or bearing.shape != seen.shape or len(seen) > MOST_SEEN:
        return None
    pose, covariance = told[:3].astype(float), np.zeros((3, 3))
    covariance[LOWER] = told[3:]
    covariance += np.tril(covariance, -1).T
    if not _plausible(pose, covariance) or not np.isfinite(bearing.astype(float)).all():
        return None
    by = PlanarPose(pose, covariance + np.diag(np.square([LEAST_STD[0], *LEAST_STD])))
    angles = zip(seen.tolist(), bearing.astype(float).tolist(), strict=True)
    return Sightings(by, list(angles), sure.shape == (1,) and bool(sure[0]))


def _plausible(where: Array, covariance: Array) -> bool:
    """Return whether numbers are finite, a place is on this site and a covariance is one."""
    if not (np.isfinite(where).all() and np.isfinite(covariance).all()) or np.abs(where).max() > FARTHEST_M:
        return False
    scale = float(np.abs(covariance).max())
    if scale > FARTHEST_M**2 or not np.allclose(covariance, covariance.T, atol=1e-3 * scale):
        return False
    return bool(np.linalg.eigvalsh(covariance)[0] >= -1e-3 * scale)
