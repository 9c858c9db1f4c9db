"""The Schmidt filter with lasting errors of odometry and camera as states: one filter for vehicles in space and robots.

The own error is that of the pose and, behind it, those of the lasting errors that the vehicle's noise declares. A
message has the same form as that of the Schmidt filter: neighbours consider the pose alone. Correlations of a neighbour
with the lasting errors of this vehicle are neglected.
"""

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.observers.contract import Setup, Tick
from coopenv.observers.correction import Constants
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.schmidt_kalman import SchmidtKalman
from coopenv.observers.uncertain_pose import LEFT, UncertainPose, predicted, transition


class SelfCalibrating(SchmidtKalman):
    """Schmidt filter that also estimates lasting errors of odometry and camera.

    It sends what `schmidt_kalman` sends.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.lasting = LastingErrors(setup.noise)
        self.by_pose = self.lasting.by_pose(setup.lever_arm)

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose, with lasting errors of zero."""
        count = len(self.lasting.states)
        self.values = np.zeros(count)
        self.P = np.zeros((6 + count, 6 + count))
        self.P[:6, :6], self.P[6:, 6:] = initial_covariance, np.diag(self.lasting.variances)
        self.lasting.reset()
        super().reset(initial_pose, initial_covariance)

    @property
    def covariance(self) -> Array:
        """(6 + c, 6 + c) covariance of the errors of the pose and of the lasting errors."""
        return self.P

    def predict(self, tick: Tick) -> None:
        """Append the increment without its lasting errors."""
        self.twist = tick.velocity, tick.angular_velocity
        step, noise = self.lasting.step(tick, self.values), tick.noise.odometry(tick.dt)
        A = np.eye(len(self.P))
        A[:6, :6], A[:6, 6:] = transition(step.rotation, step.translation), step.by_errors
        self.propagate_cross_covariances(A)
        self.P = A @ self.P @ A.T + np.diag([*noise, *self.lasting.walk * tick.dt])
        R, p, _ = predicted(LEFT, self.state.R, self.state.p, self.state.P, step.rotation, step.translation, noise)
        self.state = UncertainPose(LEFT, R, p, self.P[:6, :6])

    @property
    def constants(self) -> Constants:
        """The lasting errors, of which those of the camera's orientation move bearings."""
        return self.by_pose, self.values

    def set_corrected(self, R: Array, p: Array, P: Array, change: Array) -> None:
        """Set the corrected pose and lasting errors."""
        self.state, self.P, self.values = UncertainPose(LEFT, R, p, P[:6, :6]), P, self.values + change
