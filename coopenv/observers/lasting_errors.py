"""Lasting errors of odometry and camera as states of a filter, and how they change an increment and bearings.

Source of the errors of a differential drive: Borenstein and Feng, Measurement and correction of systematic odometry
errors in mobile robots, IEEE Transactions on Robotics and Automation 12(6), 1996 (unequal wheels: `curvature`, unknown
wheelbase: `turn_scale`).
"""

from typing import NamedTuple

import numpy as np

from coopenv.estimation.compiled import cross_matrix, exp_so3, right_jacobian
from coopenv.estimation.poses import Array, log_so3
from coopenv.observers.contract import SensorNoise, Tick

SCALE, TURN_SCALE, CURVATURE, LOSS, LEAD = 0, 1, 5, 6, 7
GYRO, ORIENTATION = slice(2, 5), slice(8, 11)
STATES = 11
FORWARD, UP = 0, 2


class CalibratedStep(NamedTuple):
    """An odometry increment without its lasting errors, as far as they are known."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,) m
    by_errors: Array  # (6, c) derivative of the left error after it by the lasting errors


class LastingErrors:
    """The lasting errors of one vehicle that its noise declares, c of them: those with a standard deviation."""

    def __init__(self, noise: SensorNoise) -> None:
        std, walk = np.zeros(STATES), np.zeros(STATES)
        std[SCALE], walk[SCALE] = noise.odometry_scale, noise.odometry_scale_walk
        std[GYRO], walk[GYRO] = noise.gyro_bias, noise.gyro_bias_walk
        std[[TURN_SCALE, CURVATURE, LOSS, LEAD]] = (
            noise.turn_scale,
            noise.curvature,
            noise.turning_loss,
            noise.odometry_lead,
        )
        std[ORIENTATION] = noise.camera_orientation
        self.states = np.flatnonzero(std + walk)
        self.variances = np.square(std[self.states])
        self.walk = np.square(walk[self.states])  # per s

    def reset(self) -> None:
        """Forget the last sample."""
        self.before = np.zeros((2, 3))

    def step(self, tick: Tick, values: Array) -> CalibratedStep:
        """Return the increment of a tick, given values (c,) of the lasting errors."""
        turn, move = log_so3(tick.rotation), np.asarray(tick.translation, float)
        now = np.array([tick.angular_velocity, tick.velocity])
        J = np.zeros((6, STATES))
        J[3:, SCALE] = -move
        J[:3, TURN_SCALE] = -turn
        J[:3, GYRO] = -tick.dt * np.eye(3)
        J[UP, CURVATURE] = move[FORWARD]
        J[3:, LOSS] = -move * np.linalg.norm(turn) / tick.dt
        J[:, LEAD] = (self.before - now).ravel()
        self.before, J = now, J[:, self.states]
        correction = J @ values
        turn, move = turn + correction[:3], move + correction[3:]
        rotation = exp_so3(turn)
        by_errors = np.concatenate([right_jacobian(turn) @ J[:3], rotation.T @ J[3:]])
        return CalibratedStep(rotation, move, by_errors)

    def by_pose(self, lever_arm: Array) -> Array:
        """Return the left errors (6, c) of the pose that move bearings of the camera as the lasting errors do.

        An error of the camera's orientation moves a bearing as a turn of the vehicle about the camera.
        """
        by_orientation = np.zeros((6, STATES))
        by_orientation[:3, ORIENTATION] = np.eye(3)
        by_orientation[3:, ORIENTATION] = cross_matrix(np.asarray(lever_arm, float))
        return by_orientation[:, self.states]
