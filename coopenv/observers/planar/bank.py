"""Planar filters side by side, one per guess of how much a robot's wheels turn: a Gaussian sum.

How much of a commanded turn comes about differs by more between robots than a linear filter can find out: with the
scale of a turn known to a quarter, two turns leave the heading open. Each filter starts from one scale, the bearings
weigh them, and those that are unlikely or agree with the best are dropped, so that after a few turns one is left.
"""

import math

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.filter import BIAS, HEADING, STATES, TURN_SCALE, PlanarFilter, PlanarPose, Step, X, Y, wrapped
from coopenv.observers.planar.tuning import Tuning

TEMPER = 0.7  # of the bearings' evidence: those of one frame share errors of the motion
UNLIKELY = math.log(1e-3)  # below the best
SAME = (0.04, 0.1, 0.03)  # of the scale, m, rad: nearer than that to the best a filter says nothing new


class PlanarBank:
    """One robot's estimate: a mixture of filters, which start at a pose (3,) with a covariance (3, 3)."""

    def __init__(self, tuning: Tuning, pose: Array, covariance: Array) -> None:
        self._tuning = tuning
        self.restart(pose, covariance)

    def restart(self, pose: Array, covariance: Array) -> None:
        """Begin again at a pose, with all guesses."""
        self.filters: list[PlanarFilter] = []
        self._weights = [math.log(weight) for _, weight in self._tuning.scales]
        for scale, _ in self._tuning.scales:
            one = PlanarFilter(self._tuning, pose, covariance)
            one.state[TURN_SCALE] = scale
            self.filters.append(one)

    @property
    def best(self) -> PlanarFilter:
        """The likeliest filter."""
        return self.filters[int(np.argmax(self._weights))]

    def mixture(self) -> tuple[Array, Array]:
        """Return the mean (11,) and covariance (11, 11) of all."""
        best = self.best
        if len(self.filters) == 1:
            return best.state, best.covariance
        weight = np.exp(np.array(self._weights) - max(self._weights))
        weight /= weight.sum()
        off = np.array([one.state - best.state for one in self.filters])
        off[:, HEADING] = [wrapped(float(angle)) for angle in off[:, HEADING]]
        mean = weight @ off
        covariance = sum(w * one.covariance for w, one in zip(weight, self.filters, strict=True))
        off -= mean
        return best.state + mean, covariance + np.einsum("n,ni,nj->ij", weight, off, off)

    def tell(self) -> PlanarPose:
        """Return what others need: the heading is the camera's, from which bearings count (bias taken off)."""
        state, covariance = self.mixture()
        pick = np.eye(3, STATES)
        pick[HEADING, BIAS] = -1.0
        return PlanarPose(pick @ state, pick @ covariance @ pick.T)

    def advance(self, dt: float, turn: float, path: float) -> Step:
        """Move all on by dt in s, as `PlanarFilter.advance`; return what the likeliest makes of it."""
        steps = [one.advance(dt, turn, path) for one in self.filters]
        return steps[int(np.argmax(self._weights))]

    def landmark(self, bearing: float, x: float, y: float) -> float:
        """Correct with a bearing in rad to a known point in m; return the likeliest's normalised innovation squared."""
        return self._weighed([one.landmark(bearing, x, y) for one in self.filters])

    def robot(self, bearing: float, other: PlanarPose) -> float:
        """Correct with a bearing in rad to a robot that tells where it thinks it is; return the same."""
        return self._weighed([one.robot(bearing, other) for one in self.filters])

    def seen(self, bearing: float, other: PlanarPose) -> float:
        """Correct with the bearing in rad under which another robot sees this one; return the same."""
        return self._weighed([one.seen(bearing, other) for one in self.filters])

    def place(self, pose: Array, covariance: Array) -> None:
        """Put all at a pose (3,) with a covariance (3, 3); they keep what they know of the wheels."""
        for one in self.filters:
            one.place(pose, covariance)

    def _weighed(self, ratios: list[float]) -> float:
        """Weigh the filters by their evidence, and drop those that are not needed; return the likeliest's ratio."""
        ratio = ratios[int(np.argmax(self._weights))]
        if len(self.filters) > 1:
            weights = [w + TEMPER * one.evidence for w, one in zip(self._weights, self.filters, strict=True)]
            first = int(np.argmax(weights))
            best = self.filters[first]
            kept = [
                n
                for n, one in enumerate(self.filters)
                if n == first or (weights[n] - weights[first] > UNLIKELY and not _same(one, best))
            ]
            self.filters = [self.filters[n] for n in kept]
            self._weights = [weights[n] - weights[first] for n in kept]
        return ratio


def _same(one: PlanarFilter, best: PlanarFilter) -> bool:
    off = one.state - best.state
    scale, place, turn = SAME
    return bool(
        abs(off[TURN_SCALE]) < scale
        and math.hypot(off[X], off[Y]) < place
        and abs(wrapped(float(off[HEADING]))) < turn
    )
