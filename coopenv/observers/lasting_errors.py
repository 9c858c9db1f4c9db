"""Lasting errors of odometry, camera and other sensors as states of a filter, and what they change.

Source of the errors of a differential drive: Borenstein and Feng, Measurement and correction of systematic odometry
errors in mobile robots, IEEE Transactions on Robotics and Automation 12(6), 1996 (unequal wheels: `curvature`, unknown
wheelbase: `turn_scale`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coopenv.estimation.compiled import cross_matrix, exp_so3, right_jacobian
from coopenv.estimation.poses import Array, log_so3
from coopenv.measurements.sensor import Sensor
from coopenv.observers.contract import SensorNoise, Tick
from coopenv.observers.correction import BY_ROW, BY_VALUE
from coopenv.observers.frame import CAMERA

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
    """The lasting errors of one vehicle that its noise and sensors declare: the c with a standard deviation."""

    def __init__(self, noise: SensorNoise, sensors: Sequence[Sensor] = ()) -> None:
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
        self.sensors = len(sensors)
        self.of_sensors = {n: sensor.kind.rows for n, sensor in enumerate(sensors) if any(sensor.bias) or sensor.scale}
        declared = [[*(sensors[n].bias or np.zeros(rows)), sensors[n].scale] for n, rows in self.of_sensors.items()]
        std = np.concatenate([std, *declared])
        self.count = len(std)
        walk = np.pad(walk, (0, self.count - STATES))
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
        J = np.zeros((6, self.count))
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

    def by_sensor(self, lever_arm: Array) -> Array:
        """Return what they change in measurements of the camera and of the other sensors, see `Constants`.

        An error of the camera's orientation moves a bearing as a turn of the vehicle about the camera.
        """
        changed = np.zeros((self.sensors + 1, BY_VALUE + 1, self.count))
        changed[CAMERA, :3, ORIENTATION] = np.eye(3)
        changed[CAMERA, 3:6, ORIENTATION] = cross_matrix(np.asarray(lever_arm, float))
        first = STATES
        for sensor, rows in self.of_sensors.items():
            of = changed[CAMERA + 1 + sensor]
            of[BY_ROW][:rows, first : first + rows] = np.eye(rows)
            of[BY_VALUE, first + rows] = 1.0
            first += rows + 1
        return np.ascontiguousarray(changed[..., self.states])
