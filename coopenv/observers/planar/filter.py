"""A planar bearing-only extended Kalman filter that calibrates its robot's odometry (`motion.py` has its state)."""

import math

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.bearing import NEAREST_M, left_out, wrapped
from coopenv.observers.planar.intersection import growth
from coopenv.observers.planar.level import NoiseLevel
from coopenv.observers.planar.motion import MAX_LEAD_S, PlanarMotion
from coopenv.observers.planar.state import BIAS, HEADING, LEAD, STATES, PlanarPose, X, Y, picked

MISREAD = 0.02  # share of bearings that may be anything


class PlanarFilter(PlanarMotion):
    """One robot's estimate, corrected by bearings."""

    def landmark(self, bearing: float, x: float, y: float) -> float:
        """Correct with a bearing in rad to a known point in m; return its normalised innovation squared."""
        h, direction, bent = self._line(x, y, self.covariance[:2, :2])
        return self._correct(*self._to(bearing, h, direction), self.tuning.bearing_std**2 + bent, self.covariance)

    def robot(self, bearing: float, other: PlanarPose) -> float:
        """Correct with a bearing in rad to a robot that tells where it thinks it is; return the same."""
        h, direction, bent = self._line_to(other)
        theirs = np.array([-h[X], -h[Y], 0.0])
        return self._fuse(*self._to(bearing, h, direction), bent, theirs, other)

    def seen(self, bearing: float, other: PlanarPose) -> float:
        """Correct with the bearing in rad under which another robot, which tells its pose, sees this one; the same."""
        h, direction, bent = self._line_to(other)
        theirs = np.array([-h[X], -h[Y], -1.0])
        back = direction + math.pi  # from them to us; its derivatives are those of the line from us to them
        return self._fuse(h, wrapped(bearing - (back - float(other.pose[2]))), bent, theirs, other)

    def place(self, pose: Array, covariance: Array) -> None:
        """Put it at a pose (3,) with a covariance (3, 3); what is known of the wheels stays."""
        self.state[:3] = pose
        self.covariance[:3] = 0.0
        self.covariance[:, :3] = 0.0
        self.covariance[:3, :3] = covariance

    def doubt(self) -> None:
        """Doubt what was found out about the wheels as much as at the start, and keep what is plausible of it."""
        k = self.tuning
        std = np.array(k.std)
        self.state[3:] = np.clip(self.state[3:], k.mean - 2 * std, k.mean + 2 * std)
        self.covariance[3:] = 0.0
        self.covariance[:, 3:] = 0.0
        self.covariance[range(3, STATES), range(3, STATES)] = std**2
        self.level = NoiseLevel(k.level_std)

    def tell(self) -> PlanarPose:
        """Return what others need: the heading is the camera's, from which bearings count (bias taken off)."""
        return picked(self.state, self.covariance)

    def _line(self, x: float, y: float, covariance: Array) -> tuple[Array, float, float]:
        """Return derivatives and direction of the line from here to a point, and the variance that they leave out."""
        dx, dy = x - float(self.state[X]), y - float(self.state[Y])
        square = max(dx * dx + dy * dy, NEAREST_M**2)
        h = np.zeros(STATES)
        h[X], h[Y] = dy / square, -dx / square
        if not self.tuning.second_order:
            return h, math.atan2(dy, dx), 0.0
        return h, math.atan2(dy, dx), left_out(dx, dy, square, covariance)

    def _line_to(self, other: PlanarPose) -> tuple[Array, float, float]:
        x, y = other.pose[:2].tolist()
        return self._line(x, y, self.covariance[:2, :2] + other.covariance[:2, :2])

    def _to(self, bearing: float, h: Array, direction: float) -> tuple[Array, float]:
        """Return derivatives and innovation of a bearing of this robot's camera."""
        h[HEADING], h[BIAS] = -1.0, 1.0
        return h, wrapped(bearing - (direction - float(self.state[HEADING]) + float(self.state[BIAS])))

    def misfit(self, bearing: float, other: PlanarPose, seen: bool) -> tuple[float, float]:
        """Return the normalised innovation squared of such a bearing and its variance, rad^2; nothing is corrected."""
        h, direction, bent = self._line_to(other)
        theirs = np.array([-h[X], -h[Y], -float(seen)])
        if seen:
            innovation = wrapped(bearing - (direction + math.pi - float(other.pose[2])))
        else:
            h, innovation = self._to(bearing, h, direction)
        known = float(theirs @ other.covariance @ theirs) + self.tuning.bearing_std**2 + bent
        variance = float(h @ self.covariance @ h) + known
        return innovation**2 / variance, variance

    def _fuse(self, h: Array, innovation: float, bent: float, by_theirs: Array, other: PlanarPose) -> float:
        k = self.tuning
        theirs, noise = float(by_theirs @ other.covariance @ by_theirs), k.bearing_std**2 + bent
        if k.fusion == "plain":
            return self._correct(h, innovation, noise + theirs, self.covariance)
        p, arm = self.covariance, k.arm_m**2
        ph = p @ h
        own, gain = float(h @ ph), float(ph[X] ** 2 + ph[Y] ** 2 + arm * ph[HEADING] ** 2)
        cost = float(p[X, X] + p[Y, Y] + arm * p[HEADING, HEADING])
        ours_by, theirs_by = growth(own, gain, cost, theirs, noise, k.dependent)
        ratio = innovation**2 / (own + theirs + noise)
        self._weigh(ratio, own + theirs + noise)
        if ours_by == 0.0 or ratio > k.others_gate:  # nothing is gained, or it is a lie
            return ratio
        grown = np.where(np.arange(STATES) <= HEADING, math.sqrt(ours_by), 1.0)  # nobody shares a calibration
        return self._correct(h, innovation, noise + theirs * theirs_by, p * np.outer(grown, grown))

    def _correct(self, h: Array, innovation: float, noise: float, prior: Array) -> float:
        k = self.tuning
        ph = prior @ h
        spread = float(h @ ph)
        ratio = innovation**2 / (spread + noise)
        self._weigh(ratio, spread + noise)
        if self.learns:
            self.level.learn(ratio, spread / (spread + noise))
        if ratio > k.gate:
            return ratio
        if ratio > k.soft:
            noise = max(innovation**2 / k.soft - spread, noise)
        gain = ph / (spread + noise)
        self.state += gain * innovation
        self.state[LEAD] = min(max(float(self.state[LEAD]), 0.0), MAX_LEAD_S)
        p = prior - np.outer(gain, ph)
        self._off = self._off * math.sqrt(max(p[HEADING, HEADING] / prior[HEADING, HEADING], 0.0))
        self.covariance = (p + p.T) / 2
        return ratio

    def _weigh(self, ratio: float, variance: float) -> None:
        """Remember how likely a bearing was; it may be anything once in a while."""
        fits = math.exp(-ratio / 2) / math.sqrt(2 * math.pi * variance)
        self.evidence = math.log((1 - MISREAD) * fits + MISREAD / (2 * math.pi))
