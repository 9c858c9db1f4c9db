"""A planar bearing-only extended Kalman filter that calibrates its robot's odometry (`PlanarFilter` has its state).

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
"""

import math
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Self

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.mrclam.planar_model import (
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
    NoiseLevel,
    OdometryStep,
    PlanarPose,
    Tuning,
    X,
    Y,
    growth,
    left_out,
    unsure,
    wrapped,
)

MAX_LEAD_S = 0.6
MISREAD = 0.02  # share of outliers among bearings


class PlanarFilter:
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
        """Take the commands over the last dt in s."""
        if self.history is None:
            self.history = CommandHistory(self.tuning.wheels, MAX_LEAD_S, dt)
        self.history.add(dt, turn, path)

    def move(self, dt: float) -> OdometryStep:
        """Propagate the estimate by the commands over dt in s."""
        if self.history is None:
            return OdometryStep(0.0, 0.0, 0.0, 0.0)
        k, s = self.tuning, self.state.tolist()  # numbers of Python: those of NumPy are slow one by one
        done, late = (sums.tolist() for sums in self.history.response(dt, s[LEAD]))
        turning, turning_late = (
            sums[COMMANDED] + s[SHARE] * (sums[TURN] - sums[COMMANDED]) - s[TURN_OFFSET] * sums[TURNING]
            for sums in (done, late)
        )
        turned = s[TURN_SCALE] * turning + s[DRIFT] * dt
        driven = s[SPEED_SCALE] * done[PATH] + s[SPEED_OFFSET] * done[ARC] - s[SLOWDOWN] * done[SLOWING]
        middle = s[HEADING] + turned / 2
        c, sn = math.cos(middle), math.sin(middle)
        shrunk, astray = self._astray(driven)
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
        self.state[[X, Y, HEADING]] += driven * c, driven * sn, turned
        p = f @ self.covariance @ f.T
        p.flat[:: STATES + 1] += self._walk * dt
        speed, rate = abs(done[PATH]) / dt, abs(done[TURN]) / dt
        factor = self.level.factor
        q_path = factor * (k.path_noise[0] + k.path_noise[1] * speed) ** 2 * dt + astray[0]
        q_side = factor * (k.slide_noise * speed) ** 2 * dt + astray[1]
        q_turn = (k.turn_noise[0] + k.turn_noise[1] * rate + k.turn_noise[2] * speed) ** 2 * dt
        q_turn = factor * (q_turn + k.jitter**2 * done[SWITCHING])
        p[HEADING, HEADING] += q_turn
        p[X, X] += q_path * c * c + q_side * sn * sn
        p[Y, Y] += q_path * sn * sn + q_side * c * c
        p[X, Y] += (q_path - q_side) * c * sn
        p[Y, X] = p[X, Y]
        self.covariance = p
        return OdometryStep(turned, driven, q_turn, q_path)

    def _astray(self, driven: float) -> tuple[float, tuple[float, float]]:
        """Return the shrinkage of a path in m, and the variances of an uncertain heading along and across it, m^2.

        The heading's error lasts, so that what it adds grows by lengths and not by variances.
        """
        if not self.tuning.second_order:
            return 1.0, (0.0, 0.0)
        shrunk, *more = unsure(float(self.covariance[HEADING, HEADING]))
        before, self._off = self._off, self._off + abs(driven) * np.array(more)
        along, across = (self._off**2 - before**2).tolist()
        return shrunk, (along, across)

    def landmark(self, bearing: float, x: float, y: float) -> float:
        """Correct with a bearing in rad to a known point in m; return its normalised innovation squared."""
        h, direction, bent = self._line(x, y, self.covariance[:2, :2])
        return self._correct(*self._to(bearing, h, direction), self.tuning.bearing_std**2 + bent, self.covariance)

    def robot(self, bearing: float, other: PlanarPose, seen: bool = False) -> float:
        """Correct with a bearing in rad to a robot at its reported pose, or `seen` by it; return the same."""
        k = self.tuning
        h, innovation, theirs, bent = self._between(bearing, other, seen)
        noise = k.bearing_std**2 + bent
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

    def _line(self, x: float, y: float, covariance: Array) -> tuple[Array, float, float]:
        """Return derivatives and direction of the line from here to a point, and the variance that they leave out."""
        dx, dy = x - float(self.state[X]), y - float(self.state[Y])
        square = max(dx * dx + dy * dy, NEAREST_M**2)
        h = np.zeros(STATES)
        h[X], h[Y] = dy / square, -dx / square
        if not self.tuning.second_order:
            return h, math.atan2(dy, dx), 0.0
        return h, math.atan2(dy, dx), left_out(dx, dy, square, covariance)

    def _between(self, bearing: float, other: PlanarPose, seen: bool) -> tuple[Array, float, float, float]:
        """Return derivatives and innovation of a bearing to or from a robot, and variances.

        These are the one due to its reported pose, and the one that the linearisation leaves out.
        """
        x, y = other.pose[:2].tolist()
        h, direction, bent = self._line(x, y, self.covariance[:2, :2] + other.covariance[:2, :2])
        by_theirs = np.array([-h[X], -h[Y], -float(seen)])
        theirs = float(by_theirs @ other.covariance @ by_theirs)
        if seen:  # from them to us; its derivatives are those of the line from us to them
            return h, wrapped(bearing - (direction + math.pi - float(other.pose[2]))), theirs, bent
        return *self._to(bearing, h, direction), theirs, bent

    def _to(self, bearing: float, h: Array, direction: float) -> tuple[Array, float]:
        """Return derivatives and innovation of a bearing of this robot's camera."""
        h[HEADING], h[BIAS] = -1.0, 1.0
        return h, wrapped(bearing - (direction - float(self.state[HEADING]) + float(self.state[BIAS])))

    def misfit(self, bearing: float, other: PlanarPose, seen: bool) -> tuple[float, float]:
        """Return the normalised innovation squared of such a bearing and its variance, rad^2; nothing is corrected."""
        h, innovation, theirs, bent = self._between(bearing, other, seen)
        known = theirs + self.tuning.bearing_std**2 + bent
        variance = float(h @ self.covariance @ h) + known
        return innovation**2 / variance, variance

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


WIDEST = 0.5  # rad, of the heading of one filter
MOST = 15
PARTS = ((-1.0575, 0.2252), (0.0, 0.5496), (1.0575, 0.2252))  # offset in standard deviations, weight
NARROWED = 0.6716  # standard deviation of a part
LEAST_WEIGHT = 1e-3
LEAST_SHARE = 5e-3  # of a kind of robot; the drifting one with no drift to be seen comes to less
SAME = 1.0  # squared distance of two poses, normalised, up to which they are merged
TEMPERED = 0.3  # power of a robot's likelihood: its errors last over many of its messages


class Mixture:
    """One robot's estimate as a weighted sum of filters, mostly of one; it has the methods of one filter.

    Bearings and paths are linear in a heading that is known to half a radian, and in none that is not. A filter less
    sure than that is split along its heading into three, each with the wheels that lead there (a Gaussian is nearly the
    sum of three narrower ones; the numbers are those of least squares between the densities). Bearings then decide
    between them by their likelihood; filters that have become unlikely are dropped, and filters with nearly the same
    pose are merged: Alspach, Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Trans.
    Automatic Control 17(4), 1972.

    Another filter is for the few robots whose heading drifts while their commands are to drive straight. It is dropped
    as soon as it is unlikely.
    """

    def __init__(self, tuning: Tuning, pose: Array, covariance: Array) -> None:
        self.tuning = tuning
        kinds = [tuning]
        share = tuning.drifting[1]
        if share > 0:
            kinds.append(replace(tuning, std=(*tuning.std[:-1], tuning.drifting[0])))
        self.filters = [PlanarFilter(kind, pose, covariance) for kind in kinds]
        self._weights = np.array([1 - share, share][: len(kinds)])
        self._known: tuple[Array, Array] | None = None  # mean and covariance, once they were asked for
        self._share()

    @property
    def state(self) -> Array:
        """Mean of the state."""
        return self.filters[0].state if len(self.filters) == 1 else self._moments()[0]

    @property
    def covariance(self) -> Array:
        """Covariance of the state, including the spread of the filters."""
        return self.filters[0].covariance if len(self.filters) == 1 else self._moments()[1]

    def advance(self, dt: float, turn: float, path: float) -> OdometryStep:
        """Move all filters on; return the step of the likeliest one."""
        self._known = None
        self.filters[0].command(dt, turn, path)
        self._share()
        steps = [one.move(dt) for one in self.filters]
        return steps[int(np.argmax(self._weights))]

    def landmark(self, bearing: float, x: float, y: float) -> float:
        """Correct with a bearing in rad to a known point in m; return its normalised innovation squared."""
        return self._take(lambda one: one.landmark(bearing, x, y), 1.0)

    def robot(self, bearing: float, other: PlanarPose, seen: bool = False) -> float:
        """Correct with a bearing in rad to a robot at its reported pose, or `seen` by it; return the same."""
        return self._take(lambda one: one.robot(bearing, other, seen), TEMPERED)

    def misfit(self, bearing: float, other: PlanarPose, seen: bool) -> tuple[float, float]:
        """Return the normalised innovation squared of a bearing to or from a robot, and its variance, rad^2."""
        return self.filters[int(np.argmax(self._weights))].misfit(bearing, other, seen)

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose (3,) and its covariance (3, 3); the calibration stays."""
        if len(self.filters) > 1:
            self._join([*range(len(self.filters))])
        self._known = None
        self.filters[0].set_pose(pose, covariance)

    def reset_calibration(self) -> None:
        """Reset the covariance of the calibration; its values are clipped to two initial standard deviations."""
        self._known = None
        for one in self.filters:
            one.reset_calibration()

    def _take(self, correct: Callable[[PlanarFilter], float], power: float) -> float:
        if len(self.filters) == 1:
            return correct(self.filters[0])
        ratios = np.array([correct(one) for one in self.filters])
        logs = np.log(self._weights) + power * np.array([one.evidence for one in self.filters])
        likely = self._weights @ np.exp(-(ratios - ratios.min()) / 2)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        best = self.filters[int(np.argmax(weights))].tuning
        least = np.array([LEAST_WEIGHT if one.tuning is best else LEAST_SHARE for one in self.filters])
        kept = np.flatnonzero(weights > least)
        self._keep([self.filters[k] for k in kept], weights[kept])
        self._merge()
        return float(ratios.min() - 2 * math.log(likely))

    def _keep(self, filters: list[PlanarFilter], weights: Array) -> None:
        self.filters, self._weights = filters, weights / weights.sum()
        self._share()

    def _share(self) -> None:
        """Share the command history and the noise level of the likeliest filter, which alone adapts it."""
        self._known = None
        best = self.filters[int(np.argmax(self._weights))]
        for one in self.filters:
            one.learns = one is best
            one.level, one.history = best.level, self.filters[0].history

    def split(self) -> None:
        """Split the likeliest filter that is not sure of its heading, if there is one."""
        wide = [k for k, one in enumerate(self.filters) if one.covariance[HEADING, HEADING] > WIDEST**2]
        if not wide or len(self.filters) + 2 > MOST:
            return
        k = max(wide, key=lambda k: float(self._weights[k]))
        one, weight = self.filters[k], float(self._weights[k])
        variance = float(one.covariance[HEADING, HEADING])
        slope = one.covariance[:, HEADING] / variance
        narrow = one.covariance - (1 - NARROWED**2) * variance * np.outer(slope, slope)
        parts = []
        for offset, _ in PARTS:
            part = one.copy()
            part.state = one.state + offset * math.sqrt(variance) * slope
            part.covariance = narrow.copy()
            parts.append(part)
        filters = [other for other in self.filters if other is not one] + parts
        weights = [*np.delete(self._weights, k).tolist(), *(weight * share for _, share in PARTS)]
        self._keep(filters, np.array(weights))

    def _merge(self) -> None:
        """Merge the first two filters with nearly the same pose."""
        for i, one in enumerate(self.filters):
            for j in range(i):
                other = self.filters[j]
                off = one.state[:3] - other.state[:3]
                turns = wrapped(float(off[HEADING])) - float(off[HEADING])
                off[HEADING] += turns
                if one.tuning is not other.tuning or abs(off[HEADING]) > WIDEST:
                    continue
                joint = one.covariance[:3, :3] + other.covariance[:3, :3]
                if float(off @ np.linalg.solve(joint, off)) < SAME:
                    one.state[HEADING] += turns
                    self._join([i, j])
                    return

    def _join(self, chosen: list[int]) -> None:
        """Merge filters into the likeliest of them, in the place of the last."""
        weights, gone = self._weights[chosen], chosen[:-1]
        kept = self.filters[chosen[int(np.argmax(weights))]]
        kept.state, kept.covariance = _moments(weights / weights.sum(), [self.filters[k] for k in chosen])
        self.filters[chosen[-1]], self._weights[chosen[-1]] = kept, weights.sum()
        self._keep([one for k, one in enumerate(self.filters) if k not in gone], np.delete(self._weights, gone))

    def _moments(self) -> tuple[Array, Array]:
        if self._known is None:
            self._known = _moments(self._weights, self.filters)
        return self._known


def _moments(weights: Array, filters: list[PlanarFilter]) -> tuple[Array, Array]:
    """Return the mean and the covariance of a weighted sum of Gaussians."""
    states = np.array([one.state for one in filters])
    mean = weights.dot(states)
    off = states - mean
    within = weights.dot(np.array([one.covariance.ravel() for one in filters]))
    return mean, within.reshape(STATES, STATES) + (off.T * weights).dot(off)
