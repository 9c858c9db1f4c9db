"""A Gaussian sum of planar filters, for a heading that is too uncertain for a single Gaussian.

Bearings and paths are linear in a heading that is known to half a radian, and in none that is not. A filter less sure
than that is split along its heading into three, each with the wheels that lead there (a Gaussian is nearly the sum of
three narrower ones; the numbers are those of least squares between the densities). Bearings then decide between them by
their likelihood; filters that have become unlikely are dropped, and filters with nearly the same pose are merged:
Alspach, Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Trans. Automatic Control
17(4), 1972.

Another filter is for the few robots whose heading drifts while their commands are to drive straight. It is dropped as
soon as it is unlikely.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.observers.planar.filter import PlanarFilter
from coopenv.observers.planar.model import HEADING, STATES, OdometryStep, PlanarPose, Tuning, picked, wrapped

WIDEST = 0.5  # rad, of the heading of one filter
MOST = 15
PARTS = ((-1.0575, 0.2252), (0.0, 0.5496), (1.0575, 0.2252))  # offset in standard deviations, weight
NARROWED = 0.6716  # standard deviation of a part
LEAST_WEIGHT = 1e-3
LEAST_SHARE = 5e-3  # of a kind of robot; the drifting one with no drift to be seen comes to less
SAME = 1.0  # squared distance of two poses, normalised, up to which they are merged
TEMPERED = 0.3  # power of a robot's likelihood: its errors last over many of its messages


class Mixture:
    """One robot's estimate as a weighted sum of filters, mostly of one; it has the methods of one filter."""

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
        """Covariance of the state, with what the filters differ in."""
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

    def robot(self, bearing: float, other: PlanarPose) -> float:
        """Correct with a bearing in rad to a robot at its reported pose; return the same."""
        return self._take(lambda one: one.robot(bearing, other), TEMPERED)

    def seen(self, bearing: float, other: PlanarPose) -> float:
        """Correct with a received bearing in rad from a robot at its reported pose to this one; return the same."""
        return self._take(lambda one: one.seen(bearing, other), TEMPERED)

    def misfit(self, bearing: float, other: PlanarPose, seen: bool) -> tuple[float, float]:
        """Return the normalised innovation squared of a bearing to or from a robot, and its variance, rad^2."""
        return self.filters[int(np.argmax(self._weights))].misfit(bearing, other, seen)

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose (3,) and its covariance (3, 3); the calibration stays."""
        if len(self.filters) > 1:
            mean, joint = self._moments()
            one = self.filters[int(np.argmax(self._weights))]
            one.state, one.covariance = mean, joint
            self._keep([one], np.ones(1))
        self._known = None
        self.filters[0].set_pose(pose, covariance)

    def reset_calibration(self) -> None:
        """Reset the covariance of the calibration; its values are clipped to two initial standard deviations."""
        self._known = None
        for one in self.filters:
            one.reset_calibration()

    def broadcast_pose(self) -> PlanarPose:
        """Return the pose to broadcast."""
        return self.filters[0].broadcast_pose() if len(self.filters) == 1 else picked(*self._moments())

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
                    self._join(i, j)
                    return

    def _join(self, i: int, j: int) -> None:
        pair = [i, j]
        weights = self._weights[pair] / self._weights[pair].sum()
        kept = self.filters[pair[int(np.argmax(weights))]]
        kept.state, kept.covariance = _moments(weights, [self.filters[k] for k in pair])
        self._weights[j] += self._weights[i]
        self.filters[j] = kept
        self._keep([one for k, one in enumerate(self.filters) if k != i], np.delete(self._weights, i))

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
