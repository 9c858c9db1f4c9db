"""The pose from the bearings of one frame (P3P, PnP); odometry carries it to the next one, and counts no further.

Source: candidates by p3p.py; among them the one that agrees with most bearings, then the one nearest to the pose
predicted by odometry (Fischler and Bolles, Random sample consensus, Communications of the ACM 24(6), 1981, with all
triples in place of random ones); then Gauss-Newton over all bearings that agree. Where Gauss-Newton from the predicted
pose ends at a pose that fits, that is the candidate nearest to it, and the closed form is not needed.

Source: composition of the increments; covariance as in the prediction of the left-error filter.
"""

from itertools import combinations
from math import inf, sqrt

import numpy as np

from coopenv.estimation.poses import Array, solve
from coopenv.observers.bearing_measurements import (
    LEFT,
    BearingMeasurements,
    UncertainPose,
    linearised,
    normalised,
    usable_bearings,
)
from coopenv.observers.contract import Estimate, Message, Tick
from coopenv.observers.error_state_filters import PoseObserver
from coopenv.observers.p3p import solve_p3p

MOST_TRIPLES = 20
ITERATIONS = 8
CONVERGED = 1e-2  # squared length of a step in standard deviations
LONGEST_TURN = 1.0  # rad, of a step
BEARING_GATE = 25.0  # squared residual of a bearing over its variance, (5 sigma)^2
POSE_GATE = 45.0
"""Squared distance to the predicted pose over its variance; chi-square with 6 degrees of freedom beyond it: 5e-8."""
PATIENCE = 1.0  # s for which bearings must contradict the predicted pose before a pose far from it is accepted
NARROW_STD = 0.5
"""rad, of the predicted orientation: below it Gauss-Newton from there finds the pose near it."""
LARGEST_STD = 0.15
"""Largest standard deviation of the position over the distance to the nearest point; beyond it geometry is weak."""

ALL = np.eye(6)
ADJUGATE = np.array([[1.0, -1.0], [-1.0, 1.0]])


class PerspectivePoints(PoseObserver):
    """A pose per frame from three bearings, no memory.

    With fewer bearings it adds odometry. It sends position and covariance.
    """

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.contradicted = 0.0

    def update(self, tick: Tick) -> Estimate:
        """Append the increment, and replace the pose by that of the frame where it has one."""
        self.state = self.state.predicted(tick)
        seen = usable_bearings(tick) if tick.due else None
        if seen is not None and len(seen.targets) >= 3:
            self.take(tick, seen)
        return self.state.estimate()

    def take(self, tick: Tick, data: BearingMeasurements) -> None:
        """Take the pose of a frame if it is accepted."""
        found = refined(self.state, tick, data)
        if found is None or distance(found, self.state) > POSE_GATE:
            expected = (misfits(self.state, tick, data, self.state.P) < BEARING_GATE).all()
            self.contradicted = 0.0 if expected else self.contradicted + tick.dt
            if expected and self.state.P[0, 0] + self.state.P[1, 1] + self.state.P[2, 2] < NARROW_STD**2:
                return  # weak geometry at a plausible pose
            found = self.chosen(tick, data)
        if found is not None and (distance(found, self.state) < POSE_GATE or self.contradicted > PATIENCE):
            self.state, self.contradicted = found, 0.0

    def chosen(self, tick: Tick, data: BearingMeasurements) -> UncertainPose | None:
        """Return the candidate that agrees with most bearings, then the one nearest to the predicted pose."""
        best, most, nearest = None, 3, inf
        triples = np.array(list(combinations(range(len(data.bearings)), 3))[:MOST_TRIPLES])
        turns, cameras, mask = solve_p3p(data.bearings[triples], data.positions[triples])
        for R, camera in zip(turns[mask], cameras[mask], strict=True):
            start = UncertainPose(LEFT, R, camera - R @ tick.lever_arm, self.state.P)
            agrees = misfits(start, tick, data) < BEARING_GATE
            if (count := int(agrees.sum())) < most:
                continue
            pose = refined(start, tick, data.only(agrees))
            if pose is not None and (count > most or distance(pose, self.state) < nearest):
                best, most, nearest = pose, count, distance(pose, self.state)
        return best


def misfits(pose: UncertainPose, tick: Tick, data: BearingMeasurements, P: Array | None = None) -> Array:
    """Return (m,) the squared residuals over their variance, infinite for bearings from behind.

    With P, the variance is that given a pose with this covariance.
    """
    residual, H, N, _, ahead = linearised(pose, tick, data)
    if P is not None:
        N = N + H @ P @ H.transpose(0, 2, 1)
    return np.where(ahead, normalised(residual, N), inf)


def refined(start: UncertainPose, tick: Tick, data: BearingMeasurements) -> UncertainPose | None:
    """Return the least-squares pose near a start with its covariance, None where it fails, misfits or is too weak."""
    pose = start
    for _ in range(ITERATIONS):
        residual, H, N, *_ = linearised(pose, tick, data)
        determinants = N[:, 0, 0] * N[:, 1, 1] - N[:, 0, 1] * N[:, 0, 1]
        weighted = (N[:, ::-1, ::-1] * ADJUGATE / determinants[:, None, None] @ H).reshape(-1, 6)
        try:
            P = solve(H.reshape(-1, 6).T.dot(weighted), ALL)
        except np.linalg.LinAlgError:
            return None
        gradient = residual.ravel().dot(weighted)
        step = P.dot(gradient)
        nearest = sqrt(((data.positions - pose.p) ** 2).sum(1).min())
        firm = 0.0 < P[3, 3] + P[4, 4] + P[5, 5] < (LARGEST_STD * nearest) ** 2  # else geometry is too weak
        if not (step[:3].dot(step[:3]) < LONGEST_TURN**2 and firm):  # NaN fails as well
            return None
        pose = pose.moved(step, (P + P.T) / 2)
        if step.dot(gradient) < CONVERGED:
            ahead = linearised(pose, tick, data).ahead
            fits = ahead & (normalised(residual - H @ step, N) < BEARING_GATE)
            return pose if fits.all() else None
    return None


def distance(pose: UncertainPose, predicted: UncertainPose) -> float:
    """Return the squared Mahalanobis distance of two poses whose errors are independent.

    The rotation counts by twice the vector part of its quaternion.
    """
    tilde = predicted.R.T.dot(pose.R)
    vector = np.array([tilde[2, 1] - tilde[1, 2], tilde[0, 2] - tilde[2, 0], tilde[1, 0] - tilde[0, 1]])
    e = np.concatenate([vector / sqrt(max(1.0 + tilde.trace(), 1e-9)), predicted.R.T.dot(pose.p - predicted.p)])
    return float(e.dot(solve(pose.P + predicted.P, e)))


class DeadReckoning(PoseObserver):
    """Adds up odometry and sends nothing."""

    def update(self, tick: Tick) -> Estimate:
        """Append the increment."""
        self.state = self.state.predicted(tick)
        return self.state.estimate()

    def message(self) -> Message:
        """Return an empty message."""
        return Message()
