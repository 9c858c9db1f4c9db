"""Measurements of sensors beside the camera against SciPy's least squares, a Schmidt step, and the filter's twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import eigvalsh
from scipy.optimize import approx_fprime, least_squares

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import about_z
from coopenv.measurements.kinds import Placed
from coopenv.measurements.sensor import MAP, Reading, Sensor, kind_of
from coopenv.measurements.table import KINDS
from coopenv.observers import Tick
from coopenv.observers.bound import cramer_rao_ancestors
from coopenv.observers.robust.observer import ROBUST, WITH_READINGS
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.world.build import build_model
from coopenv.world.model import precision
from tests.helpers.readings import recorded
from tests.helpers.recordings import completed, replayed
from tests.helpers.robust_ticks import (
    LANDMARKS,
    MARKER,
    OpenRobust,
    Pose,
    covariance,
    displaced,
    drawn,
    known,
    left_error,
    pose_of,
    predicted,
    started,
    tick,
)

AT: Pose = displaced((np.eye(3), np.zeros(3)), np.array([0.3, -0.2, 1.1, 0.5, -0.4, 0.2]))
LANDMARK_ROTATION = about_z(np.array([0.3, -1.0, 2.0, 0.0, 3.0]))
MOUNTED = displaced((np.eye(3), np.zeros(3)), np.array([0.2, -0.5, 0.4, 0.4, -0.2, 0.3]))
STD = {"bearing": 0.003, "range": 0.02, "position": 0.03, "attitude": 0.005, "relative_pose": 0.03}
SENDER = len(LANDMARKS) + 1
TWIST = np.array([[3.0, 0.4, -0.2], [0.05, -0.1, 0.3]])
DOPPLER = "tests.helpers.doppler:DopplerInWarp"


def sensor_of(kind: str, targets: Sequence[int]) -> Sensor:
    """Return a sensor that is turned in its body and off its origin, with another noise in each row."""
    made = kind_of(kind)
    std = np.array(STD.get(kind, 0.01) * (1.0 + 0.3 * np.arange(made.rows)), np.float64)
    given = np.array(targets if made.has_target else [MAP], np.int64)
    return Sensor(kind, kind, std, given, MOUNTED[1], MOUNTED[0])


def sensing(*sensors: Sensor, P: np.ndarray, rotation: np.ndarray = LANDMARK_ROTATION) -> OpenRobust:
    """Return an observer that has started at a pose with a covariance, with sensors."""
    setup = replace(known(), sensors=sensors, landmark_rotation=rotation)
    observer = OpenRobust(setup)
    observer.reset(AT, P)
    return observer


def target_of(target: int, sender: Pose | None = None) -> Placed:
    """Return where a landmark is, or the marker of a sender at a pose; the map's origin for `MAP`."""
    if sender is not None:
        return Placed.at(sender[1] + sender[0] @ MARKER, sender[0])
    if target == MAP:
        return Placed.at(np.zeros(3))
    return Placed.at(LANDMARKS[target], LANDMARK_ROTATION[target])


def prediction(sensor: Sensor, pose: Pose, target: Placed) -> np.ndarray:
    return sensor.kind.predict(sensor.placed(*pose, *TWIST), target)


def measured(observer: OpenRobust, sensor: Sensor, values: np.ndarray, **given: Any) -> Tick:
    """Return the first tick of an observer, with measurements of a sensor."""
    readings = (Reading(sensor, values),)
    return replace(tick(observer, 1, **given), velocity=TWIST[0], angular_velocity=TWIST[1], readings=readings)


def drawn_value(rng: np.random.Generator, sensor: Sensor, pose: Pose, target: Placed) -> np.ndarray:
    return sensor.kind.sample(prediction(sensor, pose, target), rng.normal(size=sensor.kind.rows) * sensor.std)


@pytest.mark.parametrize("kind", [*KINDS, pytest.param(DOPPLER, marks=pytest.mark.slow)])
def test_a_frame_of_one_sensor_is_a_least_squares(kind: str) -> None:
    """The pose and the covariance are those of the most probable pose, by the kinds in NumPy."""
    rng = np.random.default_rng(1)
    P = covariance(rng, 0.005, 0.02)
    truth, sensor = drawn(rng, AT, P), sensor_of(kind, [0, 1, 3])
    targets = [target_of(target) for target in sensor.targets]
    values = np.array([drawn_value(rng, sensor, truth, target) for target in targets])
    observer = sensing(sensor, P=P)
    observer.update(measured(observer, sensor, values))
    whiten = np.linalg.inv(np.linalg.cholesky(predicted(P)))

    def residuals(e: np.ndarray) -> np.ndarray:
        pose = displaced(AT, e[:6])
        pairs = zip(values, targets, strict=True)
        rows = [sensor.kind.residual(v, prediction(sensor, pose, target)) / sensor.std for v, target in pairs]
        return np.concatenate([whiten @ e, *rows])

    best = least_squares(residuals, np.zeros(12), x_scale="jac")
    expected = np.linalg.inv(best.jac.T @ best.jac)
    off = left_error(displaced(AT, best.x[:6]), pose_of(observer))
    assert np.sqrt(off @ np.linalg.solve(expected[:6, :6], off)) < 0.05
    ratio = eigvalsh(observer.P[:6, :6], expected[:6, :6])
    assert ratio[0] > 0.93 and ratio[-1] < 1.07, ratio
    assert eigvalsh(observer.P[:6, :6], predicted(P)[:6, :6])[0] < 0.9  # it was measured


@pytest.mark.parametrize("kind", [name for name in KINDS if kind_of(name).has_target])
def test_a_sender_s_error_is_considered(kind: str) -> None:
    """Gain, covariance and correlation are those of a Schmidt step with numerical derivatives."""
    rng = np.random.default_rng(2)
    there = displaced((np.eye(3), np.array([5.0, -3.0, 1.0])), rng.normal(size=6) * 0.3)
    P, Q = covariance(rng, 0.004, 0.02), covariance(rng, 0.004, 0.02)
    sensor = sensor_of(kind, [SENDER])
    observer, sender = sensing(sensor, P=P), started(there, Q, 1)
    sender.update(tick(sender, 1))
    message = sender.message()
    assert message.position is not None and message.rotation is not None
    reported = message.rotation, message.position - message.rotation @ MARKER
    true_sender = drawn(rng, there, Q)
    value = drawn_value(rng, sensor, drawn(rng, AT, P), target_of(SENDER, true_sender))
    observer.update(measured(observer, sensor, value[None], messages={1: (message, 0.0)}))

    def expected_value(e: np.ndarray) -> np.ndarray:
        value = prediction(sensor, displaced(AT, e[:6]), target_of(SENDER, displaced(reported, e[6:])))
        return sensor.kind.residual(value, prediction(sensor, AT, target_of(SENDER, reported)))

    H = np.atleast_2d(approx_fprime(np.zeros(12), expected_value, 1e-7))
    P, Q = predicted(P)[:6, :6], sender.P[:6, :6]
    A, B = H[:, :6], H[:, 6:]
    S = A @ P @ A.T + B @ Q @ B.T + np.diag(sensor.std**2)
    K = P @ A.T @ np.linalg.inv(S)
    pose = displaced(AT, K @ sensor.kind.residual(value, prediction(sensor, AT, target_of(SENDER, reported))))
    scale = np.sqrt(P.diagonal())
    assert_allclose(observer.members["pose"]["p"][-1], message.position, atol=1e-6)
    assert np.abs(left_error(pose, pose_of(observer)) / scale).max() < 0.05
    assert_allclose(observer.P[:6, :6] / np.outer(scale, scale), (P - K @ S @ K.T) / np.outer(scale, scale), atol=0.03)
    to_marker = np.eye(6)
    to_marker[3:, :3] = -np.cross(np.eye(3), MARKER)
    cross = -K @ B @ Q @ to_marker.T
    other = np.sqrt((to_marker @ Q @ to_marker.T).diagonal())
    assert np.abs(cross / np.outer(scale, other)).max() > 0.1
    assert_allclose(observer.P[:6, 12:] / np.outer(scale, other), cross / np.outer(scale, other), atol=0.03)


def test_an_outlier_is_rejected_and_counts_in_no_degree_of_freedom() -> None:
    P = covariance(np.random.default_rng(0), 0.01, 0.04)
    sensor = sensor_of("range", [0, 1])
    values = np.array([prediction(sensor, AT, target_of(target)) for target in (0, 1)])
    observer, other = sensing(sensor, P=P), sensing(sensor, P=P)
    values[1] += 5.0
    estimate = observer.update(measured(observer, sensor, values))
    values[1] = np.nan
    alone = other.update(measured(other, sensor, values))
    assert estimate.nis_dof == alone.nis_dof == 1
    assert_allclose(observer.P[:6, :6], other.P[:6, :6], atol=1e-12)


def test_a_landmark_without_a_known_orientation_gives_its_place_alone() -> None:
    P, sensor = covariance(np.random.default_rng(0), 0.01, 0.04), sensor_of("relative_pose", [0])
    rotation = LANDMARK_ROTATION.copy()
    rotation[0] = np.nan
    observer = sensing(sensor, P=P, rotation=rotation)
    values = prediction(sensor, AT, target_of(0))[None]
    assert observer.update(measured(observer, sensor, values)).nis_dof == 3


RANGES = [{"kind": "range", "towards": ["vehicles"]}]
ALL: list[dict[str, Any]] = [{"kind": kind, "rate": 20.0} for kind in KINDS]
MIXED = [*RANGES, {"kind": "position", "rate": 4.0}, {"kind": "relative_pose", "rate": 10.0}]


def test_host_and_world_estimate_the_same() -> None:
    recording = record(load_scenario("busy_intersection_tracking", {"horizon": 3.0, "sensors": MIXED}), 0)
    result, played = completed("robust", recording), replayed(recording)
    assert_allclose(played.position[1:], result.position[1:], rtol=0, atol=1e-9)
    assert_allclose(played.rotation[1:], result.rotation[1:], rtol=0, atol=1e-9)


def test_sensors_without_measurements_change_no_bit() -> None:
    """The kernels for sensors compute what those without compute, and worlds without sensors get the latter."""
    measured = recorded("busy_intersection_tracking", RANGES, horizon=3.0)
    nothing = {name: np.full_like(values, np.nan) for name, values in measured.readings.items()}
    silent = replace(measured, readings=nothing)
    plain = replace(silent, readings={}, setups=tuple(replace(setup, sensors=()) for setup in silent.setups))
    one, other = completed("robust", silent), completed("robust", plain)
    for name in ("rotation", "position", "covariance", "protection_level"):
        assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(("sensors", "variant"), [([], ROBUST), (RANGES, WITH_READINGS)])
def test_worlds_get_the_kernels_that_they_need(sensors: Any, variant: Any) -> None:
    scenario = load_scenario("busy_intersection_tracking", {"sensors": sensors})
    assert ROBUST.fit is not None
    assert ROBUST.fit(build_model(scenario, precision("float32"), "cpu")) is variant


@pytest.mark.parametrize(("name", "missing"), [("Doppler", "in_warp"), ("DopplerOfWorlds", "jacobian")])
def test_a_class_without_functions_in_warp_is_refused_in_one_line(name: str, missing: str) -> None:
    own = Sensor("own", f"tests.helpers.doppler:{name}", np.ones(1), np.array([0]), np.zeros(3), np.eye(3))
    with pytest.raises(CoopenvError, match=f"observer 'robust'.*{missing}"):
        OpenRobust(replace(known(), sensors=(own,)))


def test_with_ranges_the_end_of_the_chain_is_near_its_bound() -> None:
    """f5, who sees no landmark: .04 m were seen, and .13 to .5 m without ranges."""
    recording = recorded("busy_intersection_tracking", RANGES, 1, horizon=20.0)
    result, bound = completed("robust", recording), cramer_rao_ancestors(recording)
    late = recording.t >= 10.0
    assert result.position_rmse(10.0)[4] < 0.11
    assert result.position_rmse(10.0).mean() < 1.3 * np.sqrt(np.mean(bound.position[late] ** 2, axis=0)).mean()
    assert (result.anees(10.0) > 0.4).all() and (result.anees(10.0) < 1.6).all()


BLIND = {
    "position and attitude": [{"kind": "position"}, {"kind": "attitude"}],
    "relative pose": [{"kind": "relative_pose"}],
}


@pytest.mark.parametrize("name", BLIND)
def test_without_a_camera_errors_match_their_covariances(name: str) -> None:
    recording = recorded("busy_intersection_tracking", BLIND[name], 4, blind=True, horizon=14.0)
    result, bound = completed("robust", recording), cramer_rao_ancestors(recording)
    late = recording.t >= 4.0
    assert (result.anees(4.0) > 0.3).all() and (result.anees(4.0) < 2.5).all()
    stated = np.sqrt(np.trace(result.covariance[late][..., 3:, 3:], axis1=-2, axis2=-1)).mean(axis=0)
    assert (stated < 1.5 * bound.position[late].mean(axis=0)).all()
