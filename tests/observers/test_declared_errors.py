"""Filters with declared errors of camera, odometry and map: against a recursion, differences and drawn worlds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.measurements.sensor import CURVATURE_TIME
from coopenv.observers import Message, Received, Recording, Tick
from coopenv.observers.contract import SensorNoise
from coopenv.observers.correction import NO_PLACES, looked
from coopenv.observers.frame import UsableMeasurements, usable_measurements
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.linearisation import linearised
from coopenv.observers.registry import find
from coopenv.observers.schmidt_kalman import SchmidtCalibrating, SchmidtKalman, complete
from coopenv.observers.uncertain_pose import LEFT, UncertainPose
from tests.helpers.recordings import completed
from tests.observers.test_filters import derivative
from tests.oracles.declared_errors import STD, W, declaring, recursion

MARKS = np.array([[3.0, 6.0, 1.0], [7.0, -5.0, 2.0], [-4.0, 5.0, -1.0], [9.0, 7.0, 0.5]])
SPEED, DT = 4.0, 0.1
HEIGHT = 0.3  # m, above the plane on which a recording of robots would be judged


def straight(ticks: int, noise: SensorNoise, landmarks: np.ndarray = MARKS) -> Recording:
    """Return exact measurements of a vehicle that drives straight, and sees a landmark in three of five frames."""
    position, still = np.zeros((ticks, 1, 3)), np.tile(np.eye(3), (ticks, 1, 1, 1))
    position[:, 0, 0], position[:, 0, 2] = SPEED * DT * np.arange(ticks), HEIGHT
    lines = landmarks - position
    seen = lines / np.linalg.norm(lines, axis=-1, keepdims=True)
    seen[(np.arange(ticks)[:, None] + 2 * np.arange(len(landmarks))) % 5 > 2] = np.nan
    bearings = np.concatenate([seen, np.full((ticks, 1, 3), np.nan)], axis=1)[:, None]
    return Recording.from_arrays(
        dt=DT,
        landmarks=landmarks,
        velocity=np.tile([SPEED, 0.0, 0.0], (ticks, 1, 1)),
        angular_velocity=np.zeros((ticks, 1, 3)),
        bearings=bearings,
        noise=noise,
        start_std=(0.02, 0.1),
        truth_position=position,
        truth_rotation=still,
    )


NOISE = SensorNoise(velocity=0.05, angular_velocity=0.01, odometry_period=DT, bearing=0.003)


@pytest.mark.parametrize("observer", [SchmidtKalman, SchmidtCalibrating])
def test_schmidt_filters_have_the_covariance_of_a_dense_recursion(observer: type[SchmidtKalman]) -> None:
    """Exact measurements change no estimate, so that all is linearised at the truth; the map is always considered."""
    made = declaring(straight(25, NOISE))
    made = replace(made, landmarks=np.broadcast_to(MARKS, made.landmarks.shape))
    first = 6 if observer is SchmidtKalman else W
    expected = recursion(made, [0], range(first, W + 3 * len(MARKS)))
    found = completed(observer, made)
    assert_allclose(found.covariance[1:], expected[1:], rtol=1e-6, atol=1e-10)
    assert found.position_error.max() < 1e-6


def test_what_is_estimated_is_better_known() -> None:
    made = declaring(straight(25, NOISE))
    made = replace(made, landmarks=np.broadcast_to(MARKS, made.landmarks.shape))
    one, every = (np.trace(completed(each, made).covariance[-1, 0]) for each in (SchmidtKalman, SchmidtCalibrating))

    class OfGyro(SchmidtKalman):
        estimated = ("gyro_bias",)

    some = np.trace(completed(OfGyro, made).covariance[-1, 0])
    assert every < some < one


def moving() -> tuple[Tick, UncertainPose]:
    """Return a tick in which a turning vehicle measures two landmarks and a neighbour that moves, and its pose."""
    made = straight(3, replace(NOISE, latency=0.02))
    tick = made.tick(2, 0, {})
    pose = UncertainPose(LEFT, Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.5, 1.0, 0.2]), np.eye(6))
    turn, move = np.array([0.03, -0.02, 0.05]), np.array([0.4, 0.05, -0.03])
    report = Message(np.array([8.0, 1.0, 0.5]), np.eye(3), 0.01 * np.eye(6), {"velocity": np.array([-3.0, 1.0, 0.2])})
    tick = replace(
        tick,
        rotation=Rotation.from_rotvec(turn).as_matrix(),
        translation=move,
        velocity=move / DT,
        angular_velocity=turn / DT,
        lever_arm=np.array([0.3, -0.2, 0.5]),
        targets=np.array([0, 1, 4]),
        bearings=np.zeros((3, 3)),
        valid=np.ones(3, bool),
        messages={4: Received(report, 0.0)},
    )
    return tick, pose


def lines_of_sight(tick: Tick, pose: UncertainPose, late: float) -> np.ndarray:
    """Return the exact bearings (3, 3) of a frame that is late by a time, with constant twist."""
    turn, move = -late * np.asarray(tick.angular_velocity), -late * np.asarray(tick.velocity)
    back = Rotation.from_rotvec(turn).as_matrix()
    S = np.cross(np.eye(3), turn)
    series = np.eye(3) + S / 2 + S @ S / 6 + S @ S @ S / 24
    R, p = pose.R @ back, pose.p + pose.R @ series @ move
    report = tick.messages[4].message
    points = np.array([MARKS[0], MARKS[1], report.position - late * report.extra["velocity"]])
    d = (points - p) @ R - tick.lever_arm
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def residuals(
    measured: UsableMeasurements, pose: UncertainPose, lasting: LastingErrors
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (6,) and derivatives (6, 6 + c)."""
    constants = lasting.by_sensor(), np.zeros(len(lasting.states)), 0
    at = np.zeros(6 + len(lasting.states))
    residual, H, _ = looked(LEFT, pose.R, pose.p, np.eye(6), at, measured.frame, constants, NO_PLACES)
    return residual, H


def test_a_late_frame_moves_bearings_as_its_derivative_says() -> None:
    tick, pose = moving()
    setup = replace(straight(3, replace(NOISE, latency=0.02)).setups[0], lever_arm=tick.lever_arm)
    lasting = LastingErrors(setup)
    lasting.reset()
    lasting.step(tick, np.zeros(len(lasting.states)))

    def residual(late: np.ndarray) -> np.ndarray:
        measured = usable_measurements(replace(tick, bearings=lines_of_sight(tick, pose, float(late[0]))))
        assert measured is not None
        return residuals(measured, pose, lasting)[0]

    measured = usable_measurements(replace(tick, bearings=lines_of_sight(tick, pose, 0.0)))
    assert measured is not None
    columns = residuals(measured, pose, lasting)[1][:, 6:]
    assert_allclose(columns[:, :1], derivative(residual, 1), atol=1e-6)
    assert_allclose(columns[:, 1], 0.0, atol=1e-12)  # the twist is its average


def test_bearings_of_a_frame_with_an_age_fit_the_pose_of_the_tick() -> None:
    tick, pose = moving()
    lasting = LastingErrors(straight(3, NOISE).setups[0])
    lasting.reset()
    old = replace(tick, bearings=lines_of_sight(tick, pose, 0.15), bearing_age=0.15)
    unaware = replace(old, bearing_age=0.0)
    fitting, off = (usable_measurements(each) for each in (old, unaware))
    assert fitting is not None and off is not None
    assert np.abs(residuals(fitting, pose, lasting)[0]).max() < 1e-5
    assert np.abs(residuals(off, pose, lasting)[0]).max() > 0.03


def drawn(rng: np.random.Generator, ticks: int) -> Recording:
    """Return a recording in which all errors are drawn with their declared standard deviations."""
    noise, accuracy = replace(NOISE, **STD), 0.1
    late = rng.normal(0.0, noise.latency) + rng.normal(0.0, noise.latency_jitter, ticks)
    turn = rng.normal(0.0, noise.camera_orientation, 3)
    walk = np.cumsum(rng.normal(0.0, noise.camera_orientation_walk * DT**0.5, (ticks, 3)), axis=0)
    place = rng.normal(0.0, noise.camera_position, 3)
    exact = straight(ticks, noise, MARKS + rng.normal(0.0, accuracy, MARKS.shape))
    lines = exact.landmarks - (exact.truth.position[:, 0] - late[:, None] * [SPEED, 0.0, 0.0] + place)[:, None]
    lines += rng.normal(size=lines.shape) * noise.bearing * np.linalg.norm(lines, axis=-1, keepdims=True)
    seen = np.full(exact.bearings.shape, np.nan)
    for k in range(ticks):
        inverse = Rotation.from_rotvec(-turn - walk[k])
        seen[k, 0, :-1] = inverse.apply(lines[k] / np.linalg.norm(lines[k], axis=-1, keepdims=True))
    scale = rng.normal(0.0, noise.odometry_scale)
    bias = rng.normal(0.0, noise.gyro_bias)
    made = Recording.from_arrays(
        dt=DT,
        landmarks=MARKS,
        velocity=exact.velocity * (1.0 + scale) + rng.normal(0.0, noise.velocity, (ticks, 1, 3)),
        angular_velocity=bias + rng.normal(0.0, noise.angular_velocity, (ticks, 1, 3)),
        bearings=np.where(exact.visible[..., None], seen, np.nan),
        noise=noise,
        start_std=(0.02, 0.1),
        start_position=exact.truth.position[0] + rng.normal(0.0, 0.1, (1, 3)),
        start_rotation=Rotation.from_rotvec(rng.normal(0.0, 0.02, (1, 3))).as_matrix(),
        truth_position=exact.truth.position,
        truth_rotation=exact.truth.rotation,
    )
    setup = replace(made.setups[0], landmark_std=(accuracy,) * len(MARKS))
    return replace(made, setups=(setup,))


@pytest.mark.parametrize("observer", [SchmidtKalman, SchmidtCalibrating])
def test_errors_are_as_large_as_stated(observer: type[SchmidtKalman]) -> None:
    """The mean of the normalised squared errors of 60 worlds has a standard error of 7 %; undeclared it is above 3."""
    rng = np.random.default_rng(5)
    worlds = [drawn(rng, 30) for _ in range(60)]
    anees = np.mean([completed(observer, made).nees[-1, 0] / 6.0 for made in worlds])
    assert 0.8 < anees < 1.25
    ignorant = [replace(made, setups=(replace(made.setups[0], noise=NOISE, landmark_std=()),)) for made in worlds[:20]]
    assert np.mean([completed(observer, made).nees[-1, 0] / 6.0 for made in ignorant]) > 3.0


def test_neighbours_that_correlate_through_another_one_get_the_covariance_of_a_chain() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 6, 6))
    a = root[0] @ root[0].T + np.eye(6)
    to_b, to_c = rng.normal(size=(2, 6, 6)) / 3.0
    b = to_b @ a @ to_b.T + root[1] @ root[1].T + np.eye(6)
    c = to_c @ b @ to_c.T + root[2] @ root[2].T + np.eye(6)
    whole = np.block([[a, a @ to_b.T, a @ to_b.T @ to_c.T], [to_b @ a, b, b @ to_c.T], [to_c @ to_b @ a, to_c @ b, c]])
    joint = np.eye(24)
    joint[6:, 6:] = whole
    joint[6:12, 18:] = joint[18:, 6:12] = 0.0
    complete(joint, 6, [False, False, False])
    assert_allclose(joint[6:, 6:], whole, atol=1e-9)
    still = np.eye(24)
    still[6:18, 12:], still[12:, 6:18] = whole[:12, 6:], whole[6:, :12]
    kept = still.copy()
    kept[6:12, 18:] = kept[18:, 6:12] = 0.0
    expected = kept.copy()
    complete(kept, 6, [True, False, True])
    assert_allclose(kept, expected)


def test_other_filters_count_map_errors_as_noise_of_many_frames() -> None:
    made = straight(3, NOISE)
    setup = replace(made.setups[0], landmark_std=(0.2,) * len(MARKS))
    tick = replace(made, setups=(setup,)).tick(1, 0, {})
    measured = usable_measurements(tick)
    assert measured is not None
    pose = UncertainPose(LEFT, np.eye(3), made.truth.position[1, 0], np.eye(6))
    lasting = LastingErrors(setup)
    lasting.reset()
    distance = np.linalg.norm(measured.positions - pose.p, axis=1)
    expected = CURVATURE_TIME / DT * (0.2 / distance) ** 2
    assert_allclose(lasting.counted(tick, linearised(pose, measured)), np.tile(expected[:, None], 2))


@pytest.mark.parametrize("name", ["mekf_covariance", "centralised", "belief_propagation", "smoother"])
@pytest.mark.parametrize("declared", [{"landmark_std": (0.2,) * len(MARKS)}, {"noise": replace(NOISE, latency=0.05)}])
def test_other_filters_are_less_sure_with_declared_errors(name: str, declared: dict[str, Any]) -> None:
    exact = straight(6, NOISE)
    uncertain = replace(exact, setups=(replace(exact.setups[0], **declared),))
    wide, known = (completed(find(name), each) for each in (uncertain, exact))
    assert np.trace(wide.covariance[-1, 0, 3:, 3:]) > 2.0 * np.trace(known.covariance[-1, 0, 3:, 3:])
    assert wide.position_error.max() < 1e-6


def test_vehicles_with_late_frames_broadcast_their_velocity() -> None:
    late, punctual = straight(3, replace(NOISE, latency_jitter=0.01)), straight(3, NOISE)
    for made, sent in ((late, True), (punctual, False)):
        observer = SchmidtKalman(made.setups[0])
        observer.reset((np.eye(3), np.zeros(3)), 0.01 * np.eye(6))
        observer.update(made.tick(1, 0, {}))
        assert ("velocity" in observer.message().extra) is sent
