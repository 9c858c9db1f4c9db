"""Where a robot is that hardly knows: bearings of several frames, carried by odometry, to points whose place is known.

For a heading, each bearing is a line on which the robot lies, so that its position follows from linear least squares;
72 headings are tried at once. What was known before, however little, counts as a Gaussian. Misread bearings are
weighted down (Geman, McClure). The best poses are refined over position and heading. One counts as found when most
bearings agree with it, no other pose comes near, and it is certain enough; otherwise the answer stays unknown.
"""

from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.memory import Lines

HEADINGS = 72
ROUNDS = 6  # of reweighting
REFINED = 6  # of the headings tried
FEWEST = 6  # bearings that agree
FEWEST_TARGETS = 3  # of them
AGREES = 9.0  # normalised square of the angle up to which a bearing agrees with a pose
SHARE = 0.75  # of all bearings that must agree
WORST = 4.0  # mean of those squares of the bearings that agree, 1 where all is as it should be
MARGIN = 12.0  # by which the cost of any other pose is larger
APART = (0.5, 0.3)  # m, rad: poses further apart than that are different ones
CERTAIN = (1.0, 0.35)  # m, rad: standard deviation of a pose that counts
NEAREST_M = 0.3
GROWTH = 2.0  # of the covariance of what bearings say, for a pose to be certain
SHARED = 2.0  # by which it is larger still, or as much as they fit worse: those of the same odometry share errors


class Known(NamedTuple):
    """A pose (x m, y m, heading rad) and the information (3, 3) about it."""

    pose: Array
    information: Array


class Answer(NamedTuple):
    """What a search gives."""

    found: Known | None  # the pose, and what the sightings alone say about it; None: unknown, or one of several
    contradicted: bool = False  # whether no pose fits the sightings and what was known before


def find_pose(lines: Lines, before: Known) -> Answer:
    """Return the pose that the sightings agree on with each other and with what was known before."""
    if len(lines.angle) < FEWEST:
        return Answer(None)
    headings = np.arange(HEADINGS, dtype=np.float64) * (2 * np.pi / HEADINGS) - np.pi
    poses: Array = np.column_stack([_positions(lines, headings, before), headings])
    best = np.argsort(_cost(lines, poses, before))[:REFINED]
    poses, information = _refined(lines, poses[best], before)
    cost = _cost(lines, poses, before)
    first = int(np.argmin(cost))
    apart = poses - poses[first]
    other = (np.hypot(apart[:, 0], apart[:, 1]) > APART[0]) | (np.abs(_wrapped(apart[:, 2])) > APART[1])
    squares = _squares(lines, poses[first : first + 1])[0]
    agree = squares < AGREES
    if agree.sum() < max(FEWEST, SHARE * len(agree)):
        return Answer(None, contradicted=True)
    worse = float(squares[agree].mean())  # than noise, which has 1
    if worse > WORST or len(np.unique(lines.target[agree])) < FEWEST_TARGETS:
        return Answer(None)
    if (other & (cost < cost[first] + MARGIN)).any():
        return Answer(None)
    said = information[first] / GROWTH
    left = np.linalg.inv(said + before.information)
    if left[0, 0] + left[1, 1] > CERTAIN[0] ** 2 or left[2, 2] > CERTAIN[1] ** 2:
        return Answer(None)
    return Answer(Known(poses[first], said / max(SHARED, worse)))


def _positions(lines: Lines, headings: Array, before: Known) -> Array:
    """Return (n, 2) where the lines meet for headings (n,), m."""
    off = _wrapped(headings - before.pose[2])
    expected = before.information[:2, :2] @ before.pose[:2] - off[:, None] * before.information[:2, 2]
    direction = lines.angle + lines.own * headings[:, None]
    normal = np.stack([-np.sin(direction), np.cos(direction)], axis=-1)  # (n, m, 2)
    at = lines.point - _turned(lines.offset, headings[:, None])  # of the line, seen from where the robot is now
    along = (normal * at).sum(axis=-1)
    weight = 1 / (9.0 * lines.angle_variance + lines.variance) * np.ones_like(along)
    for _ in range(ROUNDS):
        a = np.einsum("nm,nmi,nmj->nij", weight, normal, normal) + before.information[:2, :2]
        b = np.einsum("nm,nm,nmi->ni", weight, along, normal) + expected
        p = np.linalg.solve(a, b[..., None])[..., 0]
        away = at - p[:, None]
        variance = lines.angle_variance * np.maximum((away**2).sum(axis=-1), NEAREST_M**2) + lines.variance
        square = (normal * away).sum(axis=-1) ** 2 / variance
        ahead = np.cos(direction) * away[..., 0] + np.sin(direction) * away[..., 1] > 0
        weight = np.where(ahead, 1.0, 0.1) / variance / (1 + square / AGREES) ** 2
    return p


def _turned(offset: Array, heading: Array) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * offset[:, 0] - s * offset[:, 1], s * offset[:, 0] + c * offset[:, 1]], axis=-1)


def _residuals(lines: Lines, poses: Array) -> tuple[Array, Array, Array]:
    """Return angles between lines and points, rad, their variances, and vectors to the points, for poses (n, 3)."""
    away = lines.point - poses[:, None, :2] - _turned(lines.offset, poses[:, 2:])
    square = np.maximum((away**2).sum(axis=-1), NEAREST_M**2)
    direction = lines.angle + lines.own * poses[:, 2:]
    residual = _wrapped(np.arctan2(away[..., 1], away[..., 0]) - direction)
    return residual, lines.angle_variance + lines.variance / square, away


def _squares(lines: Lines, poses: Array) -> Array:
    residual, variance, _ = _residuals(lines, poses)
    return residual**2 / variance


def _off(poses: Array, before: Known) -> Array:
    """Return (n, 3) how far poses are from what was known."""
    off: Array = poses - before.pose
    off[:, 2] = _wrapped(off[:, 2])
    return off


def _cost(lines: Lines, poses: Array, before: Known) -> Array:
    """Return (n,) how badly poses fit; a bearing that does not fit at all counts as one that hardly does."""
    off = _off(poses, before)
    unlikely = np.einsum("ni,ij,nj->n", off, before.information, off)
    return np.asarray(np.minimum(_squares(lines, poses), AGREES).sum(axis=-1) + unlikely)


def _refined(lines: Lines, poses: Array, before: Known) -> tuple[Array, Array]:
    """Return poses (n, 3) after some Gauss-Newton steps and what the lines alone say about them (n, 3, 3)."""
    poses = poses.copy()
    for _ in range(ROUNDS):
        residual, variance, away = _residuals(lines, poses)
        square = np.maximum((away**2).sum(axis=-1), NEAREST_M**2)
        h = np.empty((*residual.shape, 3))  # of the residual
        h[..., 0], h[..., 1] = away[..., 1] / square, -away[..., 0] / square
        swing = _turned(lines.offset, poses[:, 2:])
        h[..., 2] = h[..., 1] * swing[..., 0] - h[..., 0] * swing[..., 1] - lines.own
        weight = 1 / variance / (1 + residual**2 / variance / AGREES) ** 2
        information = np.einsum("nm,nmi,nmj->nij", weight, h, h)
        slope = np.einsum("nm,nm,nmi->ni", weight, residual, h) + _off(poses, before) @ before.information
        poses -= np.linalg.solve(information + before.information, slope[..., None])[..., 0]
    poses[:, 2] = _wrapped(poses[:, 2])
    return poses, information


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi
