"""Lasting errors of odometry, camera and other sensors as states of a filter, and what they change.

A frame that is older by a time than stated shows what the vehicle measures at a pose with a left error of minus its
twist times that time, and targets where they were. The jitter of that time is an error that is drawn for every frame.
The twist is averaged: its noise would look like motion by which latency is observable, and the filter would soon know a
latency that it cannot know. How far the twist is from its average counts as noise of each frame.

Source of the errors of a differential drive: Borenstein and Feng, Measurement and correction of systematic odometry
errors in mobile robots, IEEE Transactions on Robotics and Automation 12(6), 1996 (unequal wheels: `curvature`, unknown
wheelbase: `turn_scale`).
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from coopenv.estimation.compiled import cross_matrix, exp_so3, right_jacobian
from coopenv.estimation.poses import Array, log_so3
from coopenv.measurements.sensor import CURVATURE_TIME
from coopenv.observers.contract import Setup, Tick
from coopenv.observers.correction import BY_POSE, BY_ROW, BY_TIME, BY_VALUE
from coopenv.observers.frame import CAMERA, UsableMeasurements
from coopenv.observers.linearisation import LinearMeasurements, linearised
from coopenv.observers.uncertain_pose import LEFT, UncertainPose

PLACES = {
    "odometry_scale": slice(0, 1),
    "turn_scale": slice(1, 2),
    "gyro_bias": slice(2, 5),
    "curvature": slice(5, 6),
    "turning_loss": slice(6, 7),
    "odometry_lead": slice(7, 8),
    "camera_orientation": slice(8, 11),
    "camera_position": slice(11, 14),
    "latency": slice(14, 15),
    "latency_jitter": slice(15, 16),
}
"""Places among the states of the errors that `SensorNoise` declares; biases and scales of other sensors follow."""
MANOEUVRE, STATES = 16, 17
TWIST_TIME = 10.0
"""Time, s, over which the twist is averaged. Two platoons with frames 30 ms late, a constant that is declared (scene
`road` of `benchmarks.evidence`): with 0, 0.5, 2 and 10 s the largest ANEES is 23, 2.7, 1.5 and 1.4."""
SENSORS = "sensors"
"""Name of the biases and scales of other sensors than the camera."""
EVERY = (*PLACES, SENSORS)
SCALE, TURN_SCALE, GYRO, CURVATURE, LOSS, LEAD, ORIENTATION, POSITION, LATENCY, JITTER = PLACES.values()
FORWARD, UP = 0, 2


class CalibratedStep(NamedTuple):
    """An odometry increment without its lasting errors, as far as they are known."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,) m
    by_errors: Array  # (6, c) derivative of the left error after it by the lasting errors


class LastingErrors:
    """The lasting errors of one vehicle that its noise and sensors declare: the c with a standard deviation.

    The first of them are those that a filter estimates; it considers the others, whose values stay zero.
    """

    def __init__(self, setup: Setup, estimated: Collection[str] = EVERY) -> None:
        noise, sensors = setup.noise, setup.sensors
        self.lever_arm = np.asarray(setup.lever_arm, float)
        std, walk = np.zeros((2, STATES))
        for name, at in PLACES.items():
            std[at], walk[at] = getattr(noise, name), getattr(noise, f"{name}_walk", 0.0)
        std[MANOEUVRE] = noise.latency
        self.sensors = len(sensors)
        self.of_sensors = {n: sensor.kind.rows for n, sensor in enumerate(sensors) if any(sensor.bias) or sensor.scale}
        declared = [[*(sensors[n].bias or np.zeros(rows)), sensors[n].scale] for n, rows in self.of_sensors.items()]
        std = np.concatenate([std, *declared])
        self.size = len(std)
        walk = np.pad(walk, (0, self.size - STATES))
        considered = np.full(self.size, SENSORS not in estimated)
        for name, at in PLACES.items():
            considered[at] = name not in estimated
        considered[MANOEUVRE] = considered[LATENCY][0]
        found = np.flatnonzero(std + walk)
        self.states = found[np.argsort(considered[found], kind="stable")]
        self.estimated = int((~considered[found]).sum())
        self.variances = np.square(std[self.states])
        self.walk = np.square(walk[self.states])  # per s
        self.lasts = 1.0 - np.isin(self.states, (JITTER.start, MANOEUVRE))
        """(c,) 1 if an error lasts, 0 if it is drawn for every frame."""
        self.late = bool(noise.latency or noise.latency_jitter)
        self.counts = self.late or noise.camera_orientation_walk > 0.0 or bool(setup.landmark_std)
        """Whether `counted` finds any."""

    def reset(self) -> None:
        """Forget the last sample and the twist."""
        self.before, self.time = np.zeros((2, 3)), -np.inf  # s, of the tick for which errors were last counted
        self.twist, self.averaged, self.passed = np.zeros(6), np.zeros(6), 0.0

    def noise(self, dt: float) -> Array:
        """Return the variances (c,) by which the errors grow over a time, s."""
        return self.walk * dt + (1.0 - self.lasts) * self.variances

    def step(self, tick: Tick, values: Array) -> CalibratedStep:
        """Return the increment of a tick, given values (c,) of the lasting errors."""
        turn, move = log_so3(tick.rotation), np.asarray(tick.translation, float)
        now = np.array([tick.angular_velocity, tick.velocity])
        J = np.zeros((6, self.size))
        J[3:, SCALE] = -move[:, None]
        J[:3, TURN_SCALE] = -turn[:, None]
        J[:3, GYRO] = -tick.dt * np.eye(3)
        J[UP, CURVATURE] = move[FORWARD]
        J[3:, LOSS] = -move[:, None] * np.linalg.norm(turn) / tick.dt
        J[:, LEAD] = (self.before - now).reshape(-1, 1)
        self.before, J = now, J[:, self.states]
        correction = J @ values
        turn, move = turn + correction[:3], move + correction[3:]
        self.twist, self.passed = np.concatenate([turn, move]) / tick.dt, self.passed + tick.dt
        self.averaged = self.averaged + (self.twist - self.averaged) * tick.dt / min(self.passed, TWIST_TIME)
        rotation = exp_so3(turn)
        by_errors = np.concatenate([right_jacobian(turn) @ J[:3], rotation.T @ J[3:]])
        return CalibratedStep(rotation, move, by_errors)

    def by_sensor(self) -> Array:
        """Return what they change in measurements of the camera and of the other sensors, see `Constants`.

        An error of the camera's orientation moves a bearing as a turn of the vehicle about the camera.
        """
        changed = np.zeros((self.sensors + 1, BY_TIME + 1, self.size))
        changed[CAMERA, :3, ORIENTATION] = changed[CAMERA, 3:6, POSITION] = np.eye(3)
        changed[CAMERA, 3:6, ORIENTATION] = cross_matrix(self.lever_arm)
        changed[CAMERA, BY_POSE, LATENCY.start] = -self.averaged
        changed[CAMERA, BY_POSE, MANOEUVRE] = self.averaged - self.twist
        changed[CAMERA, BY_POSE, JITTER.start] = -self.twist
        changed[CAMERA, BY_TIME, [LATENCY.start, JITTER.start]] = -1.0
        first = STATES
        for sensor, rows in self.of_sensors.items():
            of = changed[CAMERA + 1 + sensor]
            of[BY_ROW][:rows, first : first + rows] = np.eye(rows)
            of[BY_VALUE, first + rows] = 1.0
            first += rows + 1
        return np.ascontiguousarray(changed[..., self.states])

    def count(self, tick: Tick, measured: UsableMeasurements, R: Array, p: Array) -> None:
        """Add what `counted` finds to the noise of measurements, linearised at a pose, map, m."""
        pose = UncertainPose(LEFT, R, p, np.zeros((6, 6)))
        variances = self.counted(tick, linearised(pose, measured))
        measured.entries["curvature"][:, : variances.shape[1]] += variances

    def counted(self, tick: Tick, linear: LinearMeasurements) -> Array:
        """Return variances (m, r) of rows, linearised by a left error, for a filter without states of these errors.

        Errors of late frames, of a mounting that walks and of the map count as noise of so many times their variance as
        frames have the same error.
        """
        if tick.time > self.time:
            self.step(tick, np.zeros(len(self.states)))
            self.time = tick.time
        frames, measured = max(CURVATURE_TIME / tick.dt, 1.0), linear.measured
        changed = self.by_sensor()[measured.entries["sensor"]]
        columns = linear.H @ changed[:, BY_POSE]
        by_place = linear.by_target[..., 3:] @ measured.axes.swapaxes(1, 2)  # map axes
        velocity = np.nan_to_num(measured.entries["velocity"])
        columns += (by_place @ velocity[..., None]) * changed[:, None, BY_TIME]
        late = np.where(np.isin(self.states, (LATENCY.start, JITTER.start, MANOEUVRE)), self.variances, 0.0)
        variances = late * np.where(self.lasts > 0.0, frames, 1.0) + self.walk * CURVATURE_TIME * frames
        found = np.square(columns) @ variances
        if tick.landmark_std:
            of_landmark = (measured.targets >= 0) & (measured.targets < len(tick.landmark_std))
            std = np.where(of_landmark, np.array(tick.landmark_std)[measured.targets * of_landmark], 0.0)
            found += frames * std[:, None] ** 2 * np.sum(by_place**2, axis=-1)
        return np.asarray(found)
