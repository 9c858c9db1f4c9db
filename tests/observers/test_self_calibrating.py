"""The filter with lasting errors as states, and the lasting errors: against differences and a filter on the plane."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.measurements.sensor import Reading, Sensor
from coopenv.mrclam.recording import FLOOR_PERIOD_TICKS, RANGE_STD, RANGE_STD_BY_DISTANCE, recording_of
from coopenv.observers import Message, Recording, Tick, run
from coopenv.observers.contract import SensorNoise, Setup
from coopenv.observers.correction import NO_PLACES, looked
from coopenv.observers.frame import UsableMeasurements, usable_measurements
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.self_calibrating import SelfCalibrating
from coopenv.observers.uncertain_pose import LEFT, UncertainPose
from tests.helpers.mrclam_files import barrier_robots
from tests.helpers.recordings import Tampering, completed, simulated
from tests.observers.test_filters import derivative

EVERY_ERROR = SensorNoise(
    velocity=0.1,
    angular_velocity=0.1,
    odometry_period=0.05,
    bearing=0.01,
    odometry_scale=0.1,
    gyro_bias=(0.1, 0.2, 0.3),
    camera_orientation=0.1,
    turn_scale=0.1,
    curvature=0.1,
    turning_loss=0.1,
    odometry_lead=0.1,
)


def moving_tick() -> Tick:
    """Return a tick of a vehicle in space whose odometry turns it and whose camera is not at its origin."""
    recording = simulated()
    tick = recording.tick(20, 1, {})
    turn = Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix()
    return replace(tick, rotation=turn, translation=np.array([0.1, 0.02, -0.01]), lever_arm=np.array([0.3, -0.2, 0.5]))


def setup_of(noise: SensorNoise) -> Setup:
    """Return the setup of a vehicle with the noise and the camera of `moving_tick`."""
    return replace(simulated().setups[1], noise=noise, lever_arm=moving_tick().lever_arm)


def test_an_increment_changes_with_lasting_errors_as_its_derivative_says() -> None:
    lasting, tick = LastingErrors(setup_of(EVERY_ERROR)), moving_tick()

    def step(values: np.ndarray):
        lasting.reset()
        lasting.before = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]])
        return lasting.step(tick, values)

    at = np.full(len(lasting.states), 0.01)
    middle = step(at)

    def left_error(change: np.ndarray) -> np.ndarray:
        other = step(at + change)
        turn = Rotation.from_matrix(middle.rotation.T @ other.rotation).as_rotvec()
        return np.concatenate([turn, middle.rotation.T @ (other.translation - middle.translation)])

    np.testing.assert_allclose(middle.by_errors, derivative(left_error, len(at)), atol=1e-7)


def test_wheels_that_read_too_much_are_corrected() -> None:
    wheels = replace(EVERY_ERROR, gyro_bias=(0.0, 0.0, 0.0), camera_orientation=0.0)
    lasting, tick = LastingErrors(setup_of(wheels)), moving_tick()
    lasting.reset()
    values = np.array([0.1, 0.2, 0.0, 0.0, 0.0])  # the speed's scale, the turn's, and three more
    step = lasting.step(tick, values)
    np.testing.assert_allclose(step.translation, 0.9 * tick.translation)
    turn = Rotation.from_matrix(tick.rotation).as_rotvec()
    np.testing.assert_allclose(Rotation.from_matrix(step.rotation).as_rotvec(), 0.8 * turn, atol=1e-12)


def test_a_turned_camera_moves_bearings_as_its_derivative_says() -> None:
    """The measured bearings are turned, by as much as the estimate of the camera's error explains."""
    only_camera = SensorNoise(0.1, 0.1, 0.05, 0.01, camera_orientation=0.1)
    lasting, tick = LastingErrors(setup_of(only_camera)), moving_tick()
    lasting.reset()
    recording = simulated()
    pose = UncertainPose(LEFT, recording.truth.rotation[20, 1], recording.truth.position[20, 1], np.eye(6))
    measured = usable_measurements(tick)
    assert measured is not None and len(measured.targets) > 1

    def seen(bearings: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals and derivatives of bearings, given the camera's turn."""
        entries = measured.entries.copy()
        entries["value"][:, :3] = bearings
        frame = measured._replace(entries=entries).frame
        constants = lasting.by_sensor(), values, len(values)
        residual, H, _ = looked(LEFT, pose.R, pose.p, np.eye(6), np.zeros(9), frame, constants, NO_PLACES)
        return residual, H

    def residual(turn: np.ndarray) -> np.ndarray:
        return seen(rays @ Rotation.from_rotvec(turn).as_matrix(), np.zeros(3))[0]

    predicted = UncertainPose(LEFT, pose.R, pose.p, pose.P)
    directions = measured.positions - predicted.p - predicted.R @ tick.lever_arm
    rays = (directions @ predicted.R) / np.linalg.norm(directions, axis=1)[:, None]
    columns = seen(rays, np.zeros(3))[1][:, 6:]  # as predicted, where the tangent planes are
    np.testing.assert_allclose(columns, derivative(residual, 3), atol=1e-6)
    explained, _ = seen(rays, np.array([1e-4, 2e-4, -1e-4]))
    np.testing.assert_allclose(explained, -columns @ [1e-4, 2e-4, -1e-4], atol=1e-9)


def test_without_lasting_errors_and_messages_it_is_the_schmidt_filter() -> None:
    alone = simulated()
    alone = replace(alone, inbox_tick=np.full_like(alone.inbox_tick, -1))
    ours, theirs = run(SelfCalibrating, alone), run("schmidt_kalman", alone)
    np.testing.assert_allclose(ours.position, theirs.position, atol=1e-9)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, atol=1e-11)


def test_bias_and_scale_of_ranges_are_estimated() -> None:
    """A still vehicle with true ranges to four landmarks, made wrong by a known bias and scale."""
    landmarks = np.array([[3.0, 0.0, 1.0], [0.0, 4.0, 0.5], [-6.0, 1.0, 0.0], [1.0, -7.0, 2.0]])
    sensor = Sensor("range", "range", np.array([0.01]), np.arange(4), np.zeros(3), np.eye(3), bias=(0.3,), scale=0.1)
    bearings = landmarks / np.linalg.norm(landmarks, axis=1)[:, None]
    wrong = 1.05 * np.linalg.norm(landmarks, axis=1) + 0.2
    zero, K = np.zeros((40, 1, 3)), 40
    recording = Recording.from_arrays(
        dt=0.1,
        landmarks=landmarks,
        velocity=zero,
        angular_velocity=zero,
        bearings=np.tile([*bearings, np.full(3, np.nan)], (K, 1, 1, 1)),
        truth_position=zero,
        truth_rotation=np.tile(np.eye(3), (K, 1, 1, 1)),
        noise=SensorNoise(velocity=1e-3, angular_velocity=1e-3, odometry_period=0.1, bearing=1e-3),
    )
    observer = SelfCalibrating(replace(recording.setups[0], sensors=(sensor,)))
    observer.reset((np.eye(3), np.zeros(3)), 0.01 * np.eye(6))
    for k in range(1, K):
        observer.update(replace(recording.tick(k, 0, {}), readings=(Reading(sensor, wrong[:, None]),)))
    np.testing.assert_allclose(observer.values, [0.2, 1.0 - 1.0 / 1.05], atol=0.02)
    assert observer.values[0] / 1.05 == pytest.approx(0.2, abs=0.02)


def line_of_two(ticks: int = 60) -> Recording:
    """Return a recording in which a vehicle with landmarks measures another one, which measures nothing and drifts."""
    t = 0.1 * np.arange(ticks)
    p = np.zeros((ticks, 2, 3))
    p[:, 0, 0], p[:, 1, 0], p[:, 1, 1] = t, t, 4.0
    marks = np.array([[-3.0, -4.0, 1.0], [9.0, -3.0, 2.0], [4.0, 9.0, -1.0], [2.0, -6.0, 3.0]])
    to_marks, to_other = marks - p[:, 0, None], p[:, 1] - p[:, 0]
    seen = np.full((ticks, 2, 6, 3), np.nan)
    seen[:, 0, :4] = to_marks / np.linalg.norm(to_marks, axis=-1, keepdims=True)
    seen[:, 0, 5] = to_other / np.linalg.norm(to_other, axis=-1, keepdims=True)
    return Recording.from_arrays(
        dt=0.1,
        landmarks=marks,
        velocity=np.tile([1.0, 0.0, 0.0], (ticks, 2, 1)),
        angular_velocity=np.zeros((ticks, 2, 3)),
        bearings=seen,
        truth_position=p,
        truth_rotation=np.tile(np.eye(3), (ticks, 2, 1, 1)),
        noise=SensorNoise(velocity=0.2, angular_velocity=0.02, odometry_period=0.1, bearing=0.01),
    )


def test_a_measured_vehicle_is_corrected_as_by_one_filter_of_all() -> None:
    recording = line_of_two()
    joint, ours = completed("centralised", recording), completed(SelfCalibrating, recording)
    alone = completed("schmidt_kalman", recording)
    seen = [3, 5]  # forward and up, across the line of sight
    expected, made, without = (of.covariance[-1, 1][seen, seen] for of in (joint, ours, alone))
    two_ticks = 2 * (0.2 * recording.dt) ** 2  # of odometry since the measurement, which a message brings
    assert (made > 0.99 * expected).all() and (made < expected + two_ticks).all()
    assert (without > 4.0 * expected).all()
    np.testing.assert_allclose(ours.covariance[-1, 0], joint.covariance[-1, 0], rtol=0.1, atol=1e-5)


def test_corrections_that_are_lost_or_damaged_change_no_other_estimate() -> None:
    recording = line_of_two()
    damaged = (
        np.zeros(44),
        np.array([[5.0, *[np.nan] * 43]]),
        np.array([["a"] * 44]),
        np.array([[5.0, -1.0, *[1e9] * 42]]),
    )
    for wrong in damaged:

        def spoilt(message: Message, wrong: np.ndarray = wrong) -> Message:
            return replace(message, extra={**message.extra, "corrections": wrong})

        result = completed(SelfCalibrating, recording, Tampering(spoilt, vehicle=0))
        without = completed("schmidt_kalman", recording)
        np.testing.assert_allclose(result.position[:, 1], without.position[:, 1], atol=1e-6)
        assert (np.linalg.eigvalsh(result.covariance[-1]) > 0.0).all()


class Ungated(SelfCalibrating):
    gated = False

    def add_curvature(self, tick: Tick, measured: UsableMeasurements) -> None:
        """Leave out the second order, as the oracle does."""


class PlanarOracle:
    """A dense filter of x, y, heading and six lasting errors on the plane, with formulas of its own.

    The error is (heading, forward, left) and those of scale, turn scale, curvature, loss, lead, camera, and of ranges
    the bias and the scale. Measurements are linearised half way to the corrected pose.
    """

    TURNED = np.array([[0.0, -1.0], [1.0, 0.0]])

    def __init__(self, recording: Recording, i: int) -> None:
        R = recording.start_rotation[i]
        self.heading, self.p = math.atan2(R[1, 0], R[0, 0]), recording.start_position[i, :2].copy()
        self.noise, self.values = recording.setups[i].noise, np.zeros(8)
        n, distance = self.noise, recording.setups[i].sensors[0]
        of_wheels = [n.odometry_scale, n.turn_scale, n.curvature, n.turning_loss, n.odometry_lead]
        of_errors = [*of_wheels, n.camera_orientation, *distance.bias, distance.scale]
        start = np.sqrt(np.diag(recording.start_covariance[i])[[2, 3, 4]])
        self.P = np.diag(np.square([*start, *of_errors]))
        self.before = np.zeros(3)  # rad/s, m/s, m/s

    @staticmethod
    def axes(angle: float) -> np.ndarray:
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    def predict(self, tick: Tick) -> None:
        w = math.atan2(tick.rotation[1, 0], tick.rotation[0, 0])
        d, now = tick.translation[:2], np.array([tick.angular_velocity[2], *tick.velocity[:2]])
        change = now - self.before
        by_turn = np.array([0.0, -w, d[0], 0.0, -change[0], 0.0, 0.0, 0.0])
        by_move = np.column_stack([-d, 0 * d, 0 * d, -d * abs(w) / tick.dt, -change[1:], 0 * d, 0 * d, 0 * d])
        turn, move = w + by_turn @ self.values, d + by_move @ self.values
        self.p, self.heading = self.p + self.axes(self.heading) @ move, self.heading + turn
        E, F = self.axes(-turn), np.eye(11)
        F[0, 3:] = by_turn
        F[1:3, 0], F[1:3, 1:3], F[1:3, 3:] = E @ self.TURNED @ move, E, E @ by_move
        turn_noise, _, _, step_noise, _, _ = tick.noise.odometry(tick.dt)
        self.P = F @ self.P @ F.T + np.diag([turn_noise, step_noise, step_noise] + [0.0] * 8)
        self.before = now

    def rows(self, tick: Tick, at: np.ndarray):
        """Return residuals, derivatives and variances at a pose and lasting errors moved by an error (11,)."""
        p, heading = self.p + self.axes(self.heading) @ at[1:3], self.heading + at[0]
        residual, H, N = [], [], []
        ranges = tick.readings[0].values[:, 0]
        for n in np.flatnonzero(tick.valid):
            target, b = tick.targets[n], tick.bearings[n]
            if target >= len(tick.landmarks):
                continue
            a = self.axes(-heading) @ (tick.landmarks[target, :2] - p)
            r = float(np.hypot(*a))
            u = a / r
            across = self.TURNED @ u
            camera = self.values[5] + at[8]
            bias, scale = self.values[6:] + at[9:]
            off = ranges[n] * (1.0 - scale) - bias - r
            residual += [math.sin(math.atan2(b[1], b[0]) - math.atan2(a[1], a[0])) + camera, off]
            H.append([-1.0, *(-across / r), 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0])
            H.append([0.0, *-u, *[0.0] * 6, 1.0, ranges[n]])
            N += [self.noise.bearing**2, RANGE_STD**2 + (RANGE_STD_BY_DISTANCE * r) ** 2]
        return np.array(residual), np.array(H).reshape(-1, 11), np.diag(N)

    def recentred(self, at: np.ndarray) -> np.ndarray:
        G = np.eye(11)
        G[1:3, 1:3] = self.axes(-at[0])
        return G

    def correct(self, tick: Tick) -> None:
        at = np.zeros(11)
        for last in (False, True):
            r, H, N = self.rows(tick, at)
            if not len(r):
                return
            H = H @ self.recentred(at)
            K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + N)
            dx = K @ (r + H @ at)
            if last:
                A = np.eye(11) - K @ H
                G = self.recentred(dx)
                self.P = G @ (A @ self.P @ A.T + K @ N @ K.T) @ G.T
                self.p = self.p + self.axes(self.heading) @ dx[1:3]
                self.heading += dx[0]
                self.values = self.values + dx[3:]
            at = 0.5 * dx


def test_on_a_plane_it_is_the_filter_of_x_y_and_heading() -> None:
    """A level floor and a known height leave the filter of the plane, with every lasting error that it estimates."""
    recording = recording_of(barrier_robots(2, 16.0, 0.8), "landmarks")
    oracle, observer = PlanarOracle(recording, 0), Ungated(recording.setups[0])
    observer.reset((recording.start_rotation[0], recording.start_position[0]), recording.start_covariance[0])
    assert recording.visible[:, 0].any(axis=1).sum() > 10 and recording.ticks > 2 * FLOOR_PERIOD_TICKS
    for k in range(1, recording.ticks):
        tick = recording.tick(k, 0, {})
        oracle.predict(tick)
        oracle.correct(tick)
        estimate = observer.update(tick)
    np.testing.assert_allclose(estimate.position, [*oracle.p, 0.0], atol=1e-6)
    heading = math.atan2(estimate.rotation[1, 0], estimate.rotation[0, 0])
    assert heading == pytest.approx(math.remainder(oracle.heading, 2 * math.pi), abs=1e-6)
    np.testing.assert_allclose(estimate.covariance[2:5, 2:5], oracle.P[:3, :3], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(observer.values[[0, 1, 2, 3, 4, 7, 8, 9]], oracle.values, atol=1e-6)
    assert np.abs(oracle.values).max() > 0.01


@pytest.mark.parametrize("turn_scale", [0.6, pytest.param(1.4, marks=pytest.mark.slow)])
def test_robots_that_turn_less_than_commanded_are_estimated_consistently(turn_scale: float) -> None:
    recording = recording_of(barrier_robots(1, 40.0, turn_scale), "landmarks+robots")
    result = completed("self_calibrating", recording)
    without = completed("schmidt_kalman", recording)
    assert result.position_rmse().mean() < min(0.15, without.position_rmse().mean())
    assert 0.1 < result.anees(1.0).mean() < 3.0


def test_a_floor_does_not_open_the_gate() -> None:
    """The heading of a level floor is unknown; the innovation of a row that is not measured is no doubt."""
    recording = recording_of(barrier_robots(1, 8.0), "landmarks")
    observer = SelfCalibrating(recording.setups[0])
    observer.reset((recording.start_rotation[0], recording.start_position[0]), recording.start_covariance[0])
    for k in range(1, recording.ticks):
        observer.update(recording.tick(k, 0, {}))
        assert not observer.gate.is_open
