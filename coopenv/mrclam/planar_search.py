"""Search for the pose of a lost robot: bearings of several frames, propagated by odometry, to known points.

For a heading, each bearing is a line on which the robot lies, so that its position follows from linear least squares;
72 headings are tried at once. The prior is a Gaussian. Misread bearings are
weighted down (Geman, McClure). The best poses are refined over position and heading. A pose is accepted if most
bearings agree with it, every other pose costs much more, and its covariance is small enough.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.mrclam.planar_model import OdometryStep, PlanarPose, wrapped

REFUSED = 16.0  # normalised innovation squared (4 standard deviations) of a bearing that does not fit
WINDOW = 10  # bearings
MOST_REFUSED = 6  # of them
LONG_WINDOW = 30
HIGHEST_MEAN = 5.0  # of the normalised innovation squared over the long window, 1 for an honest filter
LARGEST = 25.0  # that one bearing counts in it
FITS = 9.0  # the same up to which a bearing to a landmark shows that the robot is not lost
LOCALISED_S = 15.0  # for which that holds; in this time another robot whose bearings do not fit is lost or faulty
SHORTEST_S = 1.0  # that the window must span: one bad frame is no loss


class LossTest:
    """The normalised innovations squared of one robot's last bearings."""

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=LONG_WINDOW)
        self._localised = -math.inf

    def clear(self) -> None:
        """Clear the test."""
        self._last.clear()
        self._localised = -math.inf

    def take(self, time: float, ratio: float) -> None:
        """Take the normalised innovation squared of a bearing to a landmark at a time in s."""
        if ratio <= FITS:
            self._localised = time
        self._last.append((time, min(ratio, LARGEST)))

    def take_of_robot(self, time: float, ratio: float) -> None:
        """Take that of a bearing to or from a robot, which counts where no landmark was seen lately."""
        if not self.localised(time):
            self._last.append((time, min(ratio, LARGEST)))

    def localised(self, time: float) -> bool:
        """Return whether a recent bearing to a landmark fitted the pose."""
        return time - self._localised <= LOCALISED_S

    @property
    def since(self) -> float:
        """Time (s) of the first of the last bearings that do not fit."""
        refused = [time for time, ratio in list(self._last)[-WINDOW:] if ratio > REFUSED]
        return refused[0] if refused else -math.inf

    @property
    def lost(self) -> bool:
        """True if most of the last bearings do not fit, or all together fit badly."""
        last = list(self._last)
        short = last[-WINDOW:]
        lasting = len(short) == WINDOW and short[-1][0] - short[0][0] >= SHORTEST_S
        if lasting and sum(ratio > REFUSED for _, ratio in short) >= MOST_REFUSED:
            return True
        return len(last) == LONG_WINDOW and sum(ratio for _, ratio in last) > HIGHEST_MEAN * LONG_WINDOW


MOST = 60  # sightings
LARGEST_ERROR = 0.3  # rad; a sighting whose bearing is less certain by now is of no use


class Sighting(NamedTuple):
    """A line from the robot to a point, or the direction from a point to the robot, when it was seen."""

    time: float  # s
    target: int
    angle: float  # rad: a bearing from the robot's heading, or a direction in the map
    own: bool  # whether the robot's own camera saw it, so that the angle counts from its heading
    x: float  # m, of the point, map
    y: float  # m
    variance: float  # m^2, of the point along an axis
    angle_variance: float  # rad^2


class SightingLines(NamedTuple):
    """Lines of m sightings relative to the robot's current pose: offset (m, 2) in m, body frame; others (m,)."""

    offset: Array
    angle: Array  # rad, from the robot's present heading, or in the map
    own: Array  # 1 or 0
    point: Array  # (m, 2)
    variance: Array  # m^2
    angle_variance: Array  # rad^2
    target: Array


class SightingHistory:
    """The dead reckoning of one robot, and its recent sightings."""

    def __init__(self) -> None:
        self._trail = np.zeros(5)
        """Odometry pose: x m, y m, heading rad; and the sums of its variances, rad^2 and m^2."""
        self._seen: deque[tuple[Sighting, Array]] = deque(maxlen=MOST)
        """Sightings with the trail at their time."""

    def forget(self, before: float) -> None:
        """Forget the sightings before a time in s."""
        while self._seen and self._seen[0][0].time < before:
            self._seen.popleft()

    def move(self, step: OdometryStep) -> None:
        """Propagate the dead reckoning by the odometry of a tick."""
        middle = self._trail[2] + step.turned / 2
        moved = step.driven * np.cos(middle), step.driven * np.sin(middle)
        self._trail += (*moved, step.turned, step.turn_variance, step.path_variance)

    def add(self, sighting: Sighting) -> None:
        """Add a sighting."""
        self._seen.append((sighting, self._trail.copy()))

    def lines(self, now: float, span: float, scale_variance: float) -> SightingLines:
        """Return the sightings of the last `span` in s; `scale_variance` is that of the odometry's scale of turns."""
        x, y, heading, turn_sum, path_sum = self._trail
        recent = [(*s, *at) for s, at in self._seen if now - s.time <= span]
        seen, trail = np.split(np.array(recent, np.float64).reshape(-1, 13), [8], axis=1)
        _, target, angle, own, _, _, variance, angle_variance = seen.T
        away, turned = trail[:, :2] - (x, y), trail[:, 2] - heading
        offset = _turned(away, -heading)
        lost = np.abs(turn_sum - trail[:, 3]) + scale_variance * turned**2
        spread = angle_variance + own * lost
        # an error of the present heading also shifts the earlier positions
        drift = np.abs(path_sum - trail[:, 4]) + lost * (offset**2).sum(axis=1) / 3
        lines = offset, angle + own * turned, own, seen[:, 4:6], variance + drift, spread, target
        return SightingLines(*(part[spread < LARGEST_ERROR**2] for part in lines))


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
CERTAIN = (1.0, 0.35)  # m, rad: largest standard deviations of an accepted pose
NEAREST_M = 0.3
GROWTH = 2.0  # factor on the covariance of the sightings in that test
SHARED = 2.0  # least factor on the covariance of the result: sightings with the same odometry share errors


class PoseInformation(NamedTuple):
    """A pose (x m, y m, heading rad) and the information (3, 3) about it."""

    pose: Array
    information: Array


def find_pose(lines: SightingLines, before: PoseInformation) -> tuple[PlanarPose | None, bool]:
    """Return the pose that agrees with the sightings and with the prior `before`, None if it is unknown or ambiguous.

    The second is whether no pose fits both the sightings and the prior.
    """
    if len(lines.angle) < FEWEST:
        return None, False
    headings = np.arange(HEADINGS, dtype=np.float64) * (2 * np.pi / HEADINGS) - np.pi
    poses: Array = np.column_stack([_positions(lines, headings, before), headings])
    best = np.argsort(_cost(lines, poses, before))[:REFINED]
    poses, information = _refined(lines, poses[best], before)
    cost = _cost(lines, poses, before)
    first = int(np.argmin(cost))
    apart = poses - poses[first]
    other = (np.hypot(apart[:, 0], apart[:, 1]) > APART[0]) | (np.abs(wrapped(apart[:, 2])) > APART[1])
    squares = _squares(lines, poses[first : first + 1])[0]
    agree = squares < AGREES
    if agree.sum() < max(FEWEST, SHARE * len(agree)):
        return None, True
    worse = float(squares[agree].mean())  # than noise, which has 1
    few = len(np.unique(lines.target[agree])) < FEWEST_TARGETS
    of_sightings = information[first] / GROWTH
    left = np.linalg.inv(of_sightings + before.information)
    unsure = left[0, 0] + left[1, 1] > CERTAIN[0] ** 2 or left[2, 2] > CERTAIN[1] ** 2
    if worse > WORST or few or unsure or (other & (cost < cost[first] + MARGIN)).any():
        return None, False
    return PlanarPose(poses[first], np.linalg.inv(of_sightings / max(SHARED, worse) + before.information)), False


def _positions(lines: SightingLines, headings: Array, before: PoseInformation) -> Array:
    """Return (n, 2) where the lines meet for headings (n,), m."""
    off = wrapped(headings - before.pose[2])
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


def _turned(offset: Array, heading: Array | float) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * offset[:, 0] - s * offset[:, 1], s * offset[:, 0] + c * offset[:, 1]], axis=-1)


def _residuals(lines: SightingLines, poses: Array) -> tuple[Array, Array, Array]:
    """Return angles between lines and points, rad, their variances, and vectors to the points, for poses (n, 3)."""
    away = lines.point - poses[:, None, :2] - _turned(lines.offset, poses[:, 2:])
    square = np.maximum((away**2).sum(axis=-1), NEAREST_M**2)
    direction = lines.angle + lines.own * poses[:, 2:]
    residual = wrapped(np.arctan2(away[..., 1], away[..., 0]) - direction)
    return residual, lines.angle_variance + lines.variance / square, away


def _squares(lines: SightingLines, poses: Array) -> Array:
    residual, variance, _ = _residuals(lines, poses)
    return residual**2 / variance


def _off(poses: Array, before: PoseInformation) -> Array:
    """Return (n, 3) the differences of poses from the prior."""
    off: Array = poses - before.pose
    off[:, 2] = wrapped(off[:, 2])
    return off


def _cost(lines: SightingLines, poses: Array, before: PoseInformation) -> Array:
    """Return (n,) how badly poses fit; a bearing that does not fit at all counts as one that hardly does."""
    off = _off(poses, before)
    unlikely = np.einsum("ni,ij,nj->n", off, before.information, off)
    return np.asarray(np.minimum(_squares(lines, poses), AGREES).sum(axis=-1) + unlikely)


def _refined(lines: SightingLines, poses: Array, before: PoseInformation) -> tuple[Array, Array]:
    """Return poses (n, 3) after some Gauss-Newton steps and the information of the lines alone (n, 3, 3)."""
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
    poses[:, 2] = wrapped(poses[:, 2])
    return poses, information
