"""A planar bearing-only extended Kalman filter that calibrates its robot's odometry (`PlanarMotion` has its state).

Its state is

    x, y [m], heading [rad], turn scale [-], speed scale [-], turn offset [rad/s], speed offset [m/s],
    slowdown in turns [s/rad], command lead [s], bearing bias [rad], wheels' share [-], drift [rad/s]

and the commands w, v, late by the lead and spread by the wheels' response, move it by

    turn = turn scale * (W - turn offset * G) + drift * dt,    path = speed scale * V + speed offset * T - slowdown * U

over a tick: W is the integral of w + share (g - 1) w, g the wheels' gain as it was measured on one kind of robot (a
share of 0 is another kind), G is that of g over the time in which a turn is commanded, T is that time, V and U are the
integrals of v and v |w|. A robot that is to drive straight does so. A step of the commanded rate takes effect a jitter
sooner or later, which leaves an error in the heading. All of this noise is as large as the innovations say
(`NoiseLevel`). With no spread in the last nine numbers and a fixed level it is the textbook filter.

The logarithm l of a factor on the noise's standard deviation follows the gradient of the innovations' likelihood. With
a share s of the innovation's variance that is due to motion and r the normalised innovation squared,

    d log p / dl = s (r - 1) / 2,    E[(d log p / dl)^2] = s^2 / 2

(in a steady state the covariance grows with the deviation of the noise, not with its square). r is bounded, so that an
outlier has little effect; old information fades, so that the level adapts to another floor.
"""

import math
from copy import copy
from typing import Self

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.observers.planar.model import (
    ARC,
    BIAS,
    COMMANDED,
    DRIFT,
    HEADING,
    LEAD,
    NEAREST_M,
    PATH,
    SHARE,
    SLOWDOWN,
    SLOWING,
    SPEED_OFFSET,
    SPEED_SCALE,
    STATES,
    SWITCHING,
    TURN,
    TURN_OFFSET,
    TURN_SCALE,
    TURNING,
    CommandHistory,
    OdometryStep,
    PlanarPose,
    Tuning,
    X,
    Y,
    growth,
    left_out,
    picked,
    unsure,
    wrapped,
)

MEMORY = 150.0  # bearings, over which what was learnt fades
LARGEST_RATIO = 9.0
HIGHEST = math.log(4.0)


class NoiseLevel:
    """The factor of one robot, 1 at the start; `std` is that of its logarithm before anything was seen, 0: fixed."""

    def __init__(self, std: float) -> None:
        self.factor = 1.0  # on variances
        self._log = 0.0
        self._prior = 1 / std**2 if std > 0 else math.inf
        self._information = 0.0

    def learn(self, ratio: float, share: float) -> None:
        """Take a normalised innovation squared, and the share of its variance that is due to motion."""
        if self._prior == math.inf:
            return
        self._information = (1 - 1 / MEMORY) * self._information + share**2 / 2
        slope = share * (min(ratio, LARGEST_RATIO) - 1) / 2 - self._prior * self._log / MEMORY
        step = slope / (self._information + self._prior)
        self._log = min(max(self._log + step, 0.0), HIGHEST)
        self.factor = math.exp(2 * self._log)


MAX_LEAD_S = 0.6


class PlanarMotion:
    """One robot's estimate, which starts at a pose (x m, y m, heading rad) with a covariance (3, 3)."""

    def __init__(self, tuning: Tuning, pose: Array, covariance: Array) -> None:
        self.tuning = tuning
        self.state: Array = np.array([*pose, *tuning.mean])
        self.covariance: Array = np.diag(np.square([0.0, 0.0, 0.0, *tuning.std]))
        self.covariance[:3, :3] = covariance
        self._walk = np.square([0.0, 0.0, 0.0, *tuning.walk])
        self.history: CommandHistory | None = None
        self.level = NoiseLevel(tuning.level_std)
        self.learns = True  # how large the noise is
        self.evidence = 0.0  # logarithm of the likelihood of the last bearing
        self._off = np.zeros(2)  # m, along and across, that an unsure heading has led astray since it was seen

    def copy(self) -> Self:
        """Return a copy that shares the command history and the noise level."""
        other = copy(self)
        other.state, other.covariance = self.state.copy(), self.covariance.copy()
        return other

    def advance(self, dt: float, turn: float, path: float) -> OdometryStep:
        """Move the estimate on by dt in s, over which the commands amount to a turn in rad and a path in m."""
        self.command(dt, turn, path)
        return self.move(dt)

    def command(self, dt: float, turn: float, path: float) -> None:
        """Take what was commanded over the last dt in s."""
        if self.history is None:
            self.history = CommandHistory(self.tuning.wheels, MAX_LEAD_S, dt)
        self.history.add(dt, turn, path)

    def move(self, dt: float) -> OdometryStep:
        """Move the estimate on by dt in s, by what was commanded."""
        k, s = self.tuning, self.state
        if self.history is None:
            return OdometryStep(0.0, 0.0, 0.0, 0.0)
        done, late = self.history.response(dt, float(s[LEAD]))
        turning, turning_late = (
            sums[COMMANDED] + s[SHARE] * (sums[TURN] - sums[COMMANDED]) - s[TURN_OFFSET] * sums[TURNING]
            for sums in (done, late)
        )
        turned = s[TURN_SCALE] * turning + s[DRIFT] * dt
        driven = s[SPEED_SCALE] * done[PATH] + s[SPEED_OFFSET] * done[ARC] - s[SLOWDOWN] * done[SLOWING]
        middle = float(s[HEADING] + turned / 2)
        c, sn = math.cos(middle), math.sin(middle)
        shrunk, astray = self._astray(float(driven))
        turn_row, along = np.zeros(STATES), np.zeros(STATES)
        turn_row[TURN_SCALE], turn_row[TURN_OFFSET] = turning, -s[TURN_SCALE] * done[TURNING]
        turn_row[LEAD], turn_row[SHARE] = s[TURN_SCALE] * turning_late, s[TURN_SCALE] * (done[TURN] - done[COMMANDED])
        turn_row[DRIFT] = dt
        along[SPEED_SCALE], along[SPEED_OFFSET], along[SLOWDOWN] = done[PATH], done[ARC], -done[SLOWING]
        along[LEAD] = s[SPEED_SCALE] * late[PATH] + s[SPEED_OFFSET] * late[ARC] - s[SLOWDOWN] * late[SLOWING]
        across = turn_row * (driven / 2)
        along, across, driven = shrunk * along, shrunk * across, shrunk * driven
        across[HEADING] = driven
        f = np.eye(STATES)
        f[X] += c * along - sn * across
        f[Y] += sn * along + c * across
        f[HEADING] += turn_row
        s[X] += driven * c
        s[Y] += driven * sn
        s[HEADING] += turned
        p = f @ self.covariance @ f.T
        p.flat[:: STATES + 1] += self._walk * dt
        speed, rate = abs(done[PATH]) / dt, abs(done[TURN]) / dt
        factor = self.level.factor
        q_path = factor * (k.path_noise[0] + k.path_noise[1] * speed) ** 2 * dt + astray[0]
        q_side = factor * (k.slide_noise * speed) ** 2 * dt + astray[1]
        q_turn = (k.turn_noise[0] + k.turn_noise[1] * rate + k.turn_noise[2] * speed) ** 2 * dt
        q_turn = factor * (q_turn + k.jitter**2 * float(done[SWITCHING]))
        p[HEADING, HEADING] += q_turn
        p[X, X] += q_path * c * c + q_side * sn * sn
        p[Y, Y] += q_path * sn * sn + q_side * c * c
        p[X, Y] += (q_path - q_side) * c * sn
        p[Y, X] = p[X, Y]
        self.covariance = p
        return OdometryStep(float(turned), float(driven), q_turn, q_path)

    def _astray(self, driven: float) -> tuple[float, tuple[float, float]]:
        """Return what a path in m shrinks by, and what an unsure heading adds along and across, m^2.

        The heading's error lasts, so that what it adds grows by lengths and not by variances.
        """
        if not self.tuning.second_order:
            return 1.0, (0.0, 0.0)
        shrunk, *more = unsure(float(self.covariance[HEADING, HEADING]))
        before, self._off = self._off, self._off + abs(driven) * np.array(more)
        along, across = (self._off**2 - before**2).tolist()
        return shrunk, (along, across)


MISREAD = 0.02  # share of outliers among bearings


class PlanarFilter(PlanarMotion):
    """One robot's estimate, corrected by bearings."""

    def landmark(self, bearing: float, x: float, y: float) -> float:
        """Correct with a bearing in rad to a known point in m; return its normalised innovation squared."""
        h, direction, bent = self._line(x, y, self.covariance[:2, :2])
        return self._correct(*self._to(bearing, h, direction), self.tuning.bearing_std**2 + bent, self.covariance)

    def robot(self, bearing: float, other: PlanarPose) -> float:
        """Correct with a bearing in rad to a robot at its reported pose; return the same."""
        h, direction, bent = self._line_to(other)
        theirs = np.array([-h[X], -h[Y], 0.0])
        return self._fuse(*self._to(bearing, h, direction), bent, theirs, other)

    def seen(self, bearing: float, other: PlanarPose) -> float:
        """Correct with a received bearing in rad from a robot at its reported pose to this one; return the same."""
        h, direction, bent = self._line_to(other)
        theirs = np.array([-h[X], -h[Y], -1.0])
        back = direction + math.pi  # from them to us; its derivatives are those of the line from us to them
        return self._fuse(h, wrapped(bearing - (back - float(other.pose[2]))), bent, theirs, other)

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose (3,) and its covariance (3, 3); the calibration stays."""
        self.state[:3] = pose
        self.covariance[:3] = 0.0
        self.covariance[:, :3] = 0.0
        self.covariance[:3, :3] = covariance

    def reset_calibration(self) -> None:
        """Reset the covariance of the calibration; its values are clipped to two initial standard deviations."""
        k = self.tuning
        std = np.array(k.std)
        self.state[3:] = np.clip(self.state[3:], k.mean - 2 * std, k.mean + 2 * std)
        self.covariance[3:] = 0.0
        self.covariance[:, 3:] = 0.0
        self.covariance[range(3, STATES), range(3, STATES)] = std**2
        self.level = NoiseLevel(k.level_std)

    def broadcast_pose(self) -> PlanarPose:
        """Return the pose to broadcast: its heading is that of the camera, without the bearing bias."""
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
        if ours_by == 0.0 or ratio > k.others_gate:  # no gain of information, or an inconsistent message
            return ratio
        grown = np.where(np.arange(STATES) <= HEADING, math.sqrt(ours_by), 1.0)  # calibrations are independent
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
        """Store the likelihood of a bearing; with a small probability it is an outlier."""
        fits = math.exp(-ratio / 2) / math.sqrt(2 * math.pi * variance)
        self.evidence = math.log((1 - MISREAD) * fits + MISREAD / (2 * math.pi))
