"""The Schmidt filter with lasting errors of odometry and camera as states: one filter for vehicles in space and robots.

The own error is that of the pose and, behind it, those of the lasting errors that the vehicle's noise declares. A
message has the same form as that of the Schmidt filter: neighbours consider the pose alone. Correlations of a neighbour
with the lasting errors of this vehicle are neglected.
"""

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array
from coopenv.observers.contract import Setup, Tick
from coopenv.observers.correction import halfway
from coopenv.observers.frame import LinearMeasurements, UsableMeasurements
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.schmidt_kalman import Considered, SchmidtKalman, considered_from, look_with_neighbours
from coopenv.observers.uncertain_pose import LEFT, UncertainPose, predicted, transition


class SelfCalibrating(SchmidtKalman):
    """Schmidt filter that also estimates lasting errors of odometry and camera.

    It sends what `schmidt_kalman` sends.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.lasting = LastingErrors(setup.noise)

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
        self.twist = np.array([tick.velocity, tick.angular_velocity])
        step, noise = self.lasting.step(tick, self.values), tick.noise.odometry(tick.dt)
        A = np.eye(len(self.P))
        A[:6, :6], A[:6, 6:] = transition(step.rotation, step.translation), step.by_errors
        self.propagate_cross_covariances(A)
        self.P = A @ self.P @ A.T + np.diag([*noise, *self.lasting.walk * tick.dt])
        R, p, _ = predicted(LEFT, self.state.R, self.state.p, self.state.P, step.rotation, step.translation, noise)
        self.state = UncertainPose(LEFT, R, p, self.P[:6, :6])

    def linearised(self, tick: Tick, measured: UsableMeasurements) -> LinearMeasurements:
        """Return the measurements linearised at the estimate, also by the lasting errors."""
        return self.lasting.on_bearings(super().linearised(tick, measured), tick, measured, self.values)

    def considered(
        self, tick: Tick, measured: UsableMeasurements, joint: Array, turns: Array, places: NDArray[np.int64]
    ) -> Considered:
        """Return the correction of the pose, and correct the lasting errors."""

        def by_constants(linear: LinearMeasurements, at: Array) -> LinearMeasurements:
            return self.lasting.on_bearings(linear, tick, measured, self.values + at[6 : len(self.P)])

        look = look_with_neighbours(self.state, tick, measured, turns, places, by_constants)
        K, whole, N, dx, nis = halfway(joint, look, len(self.P))
        size = len(self.P)
        made = considered_from(self.state.R, self.state.p, size, joint, K, whole, N, dx, nis)
        R, p, self.P, carried, crosses, nis = made
        self.values = self.values + dx[6:size]
        return R, p, self.P[:6, :6], carried, crosses, nis
