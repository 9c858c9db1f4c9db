"""Messages between robots on a plane: their checks, and fault detection and exclusion of senders."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.planar.changes import blindfolded
from benchmarks.planar.lies import Drifting
from coopenv.mrclam.planar import PlanarRobust
from coopenv.mrclam.planar_fusion import ENOUGH, LEAST_STD, MOST_SEEN, RobotMonitor, sightings_of
from coopenv.mrclam.planar_model import PlanarPose, misfit
from coopenv.mrclam.recording import recording_of
from coopenv.observers.contract import Setup
from coopenv.observers.runner import run
from tests.helpers.env_suite import rest_slow
from tests.helpers.mrclam_files import barrier_robots
from tests.helpers.recordings import completed

EXTRA = {
    "seen": np.array([15, 17], np.uint8),
    "bearing": np.array([0.25, -0.5], np.float32),
    "from": np.array([1, 2, 0.5, 0.04, 0, 0.09, 0, 0, 0.01], np.float32),
    "sure": np.array([1], np.uint8),
}


def test_sightings_are_read():
    found = sightings_of(EXTRA)
    assert found is not None and found.localised and found.seen == [(15, 0.25), (17, -0.5)]
    np.testing.assert_allclose(found.by.pose, [1, 2, 0.5])
    added = np.square([LEAST_STD[0], *LEAST_STD])
    np.testing.assert_allclose(found.by.covariance, np.diag(np.add(added, (0.04, 0.09, 0.01))), rtol=1e-6)


@pytest.mark.parametrize("sure", [None, np.array([0], np.uint8), np.ones(2, np.uint8), np.array(1, np.uint8)])
def test_without_a_valid_flag_the_sender_is_not_localised(sure):
    found = sightings_of({name: value for name, value in {**EXTRA, "sure": sure}.items() if value is not None})
    assert found is not None and not found.localised and len(found.seen) == 2


@pytest.mark.parametrize(
    "field",
    [
        {"seen": np.array([[15, 17]], np.uint8)},
        {"seen": np.array([[15], None], dtype=object)},
        {"seen": np.full(MOST_SEEN + 1, 15, np.uint8), "bearing": np.zeros(MOST_SEEN + 1, np.float32)},
        {"bearing": np.array([0.25, np.inf], np.float32)},
        {"bearing": np.array(["a", "b"])},
        {"bearing": np.array([1j, 0])},
        {"from": EXTRA["from"][:4]},
        {"from": -EXTRA["from"]},
        {"from": np.full(9, "x")},
        {"sure": np.array([None], dtype=object)},
    ],
)
def test_malformed_sightings_are_ignored(field):
    assert sightings_of({**EXTRA, **field}) is None


def at(x: float, std: float = 0.05) -> PlanarPose:
    return PlanarPose(np.array([x, 0.0, 0.0]), np.diag([std**2, std**2, 0.0]))


def test_a_reported_position_may_move_but_not_jump():
    monitor = RobotMonitor()
    for k in range(100):
        monitor.test_report(0.1 * k, at(0.03 * k))
    assert not monitor.excluded
    monitor.test_report(10.0, at(8.0))
    assert monitor.excluded


def test_a_jump_after_silence_or_with_a_large_covariance_is_no_fault():
    monitor = RobotMonitor()
    monitor.test_report(0.0, at(0.0))
    monitor.test_report(0.1, at(0.9, std=1.0))
    monitor.test_report(3.0, at(7.0))
    assert not monitor.excluded


def test_large_innovations_exclude_and_small_ones_readmit():
    rng = np.random.default_rng(1)
    honest, drifting = RobotMonitor(), RobotMonitor()
    for _ in range(3000):
        honest.test_innovation(float(rng.chisquare(1)), 1e-3, localised=True)
    for _ in range(30):
        drifting.test_innovation(5.0, 1e-3, localised=True)
    assert not honest.excluded and drifting.excluded
    for _ in range(ENOUGH):
        drifting.test_innovation(0.5, 1e-3, localised=False)
    assert drifting.excluded
    for _ in range(ENOUGH):
        drifting.test_innovation(0.5, 1e-3, localised=True)
    assert not drifting.excluded


def contradict(monitors: dict[int, RobotMonitor], target: int, by: int, times: int = 5) -> None:
    for _ in range(times):
        monitors[target].test_sighting(by, 20.0, 1e-3)


def test_two_senders_must_contradict_a_localised_one_and_one_any_other():
    monitors = {n: RobotMonitor() for n in range(4)}
    contradict(monitors, 0, by=1)
    assert monitors[0].is_contradicted(10.0, monitors)
    monitors[0].note_localised(10.0, True)
    assert not monitors[0].is_contradicted(12.0, monitors) and monitors[0].is_contradicted(30.0, monitors)
    contradict(monitors, 0, by=2)
    assert monitors[0].is_contradicted(12.0, monitors)


def test_two_against_two_is_not_decided_and_one_faulty_sender_excludes_none():
    monitors = {n: RobotMonitor() for n in range(4)}
    for monitor in monitors.values():
        monitor.note_localised(10.0, True)
    for faulty, honest in ((0, 2), (0, 3)):
        contradict(monitors, honest, by=faulty)
        contradict(monitors, faulty, by=honest)
    assert [monitors[n].is_contradicted(12.0, monitors) for n in range(4)] == [True, False, False, False]
    for faulty, honest in ((1, 2), (1, 3)):
        contradict(monitors, honest, by=faulty)
        contradict(monitors, faulty, by=honest)
    assert not any(monitor.is_contradicted(12.0, monitors) for monitor in monitors.values())


def test_agreeing_sightings_readmit():
    monitors = {0: RobotMonitor(), 1: RobotMonitor()}
    contradict(monitors, 0, by=1)
    monitors[0].exclude()
    for _ in range(ENOUGH - 1):
        monitors[0].test_sighting(1, 0.5, 1e-3)
    assert monitors[0].excluded
    monitors[0].test_sighting(1, 0.5, 1e-3)
    assert not monitors[0].excluded and not monitors[0].contradicting()


def test_normalised_innovations_have_a_mean_of_one():
    rng = np.random.default_rng(3)
    P, Q = np.diag([0.02, 0.01, 0.02]) ** 2 + 1e-5, np.diag([0.05, 0.03, 0.0]) ** 2
    by, to, std = np.array([1.0, -1.0, 2.0]), np.array([3.0, 2.0, 0.0]), 0.02
    direction = np.arctan2(3.0, 2.0) - by[2] + std * rng.standard_normal(4000)
    drawn = zip(rng.multivariate_normal(by, P, 4000), rng.multivariate_normal(to, Q, 4000), direction, strict=True)
    squares = [misfit(b, PlanarPose(one, P), PlanarPose(other, Q), std)[0] for one, other, b in drawn]
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


@pytest.fixture(scope="module")
def nominal():
    record = recording_of(barrier_robots(31, 30.0, 0.8), "landmarks+robots")
    return record, run(PlanarRobust, record)


@pytest.mark.parametrize(("jump", "drift"), rest_slow([(5.0, 0.0), (0.0, 0.05)], 0))
def test_a_faulty_sender_at_most_doubles_the_error_of_the_others(nominal, jump, drift):
    record, honest = nominal
    result = completed(PlanarRobust, record, Drifting([0], jump, drift))
    assert result.position_rmse()[1:].mean() < 1.5 * honest.position_rmse()[1:].mean()
    assert (result.position_rmse()[1:] < 2.0 * honest.position_rmse()[1:]).all()
    assert (result.anees(after=record.dt)[1:] < 3.0).all()


def test_robots_without_landmarks_exclude_a_sender_that_two_others_contradict():
    """Robots 4 and 5 see none; of the others the first drifts away by 15 cm/s."""
    built: list[PlanarRobust] = []
    record = recording_of(blindfolded(barrier_robots(32, 30.0, 0.8), 4, 5), "landmarks+robots")

    def kept(setup: Setup) -> PlanarRobust:
        built.append(PlanarRobust(setup))
        return built[-1]

    completed(kept, record, Drifting([0], 0.0, 0.15, since=5.0))
    excluded = np.array([[one._monitors.of(target).excluded for target in range(15, 20)] for one in built])
    np.testing.assert_array_equal(excluded[1:], np.tile([True, False, False, False, False], (4, 1)))
