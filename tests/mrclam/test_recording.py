"""A recorded sub-dataset on ticks, as every observer gets it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.base.errors import DataError
from coopenv.mrclam.dataset import MotionCapture
from coopenv.mrclam.planar import PlanarEkf, PlanarRobust
from coopenv.mrclam.recording import DRIFT_STD, MESSAGE_PERIOD_TICKS, START_STD, TICK_S, load_dataset, recording_of
from coopenv.observers.runner import run
from tests.helpers.env_suite import rest_slow
from tests.helpers.mrclam_files import LANDMARKS, pose, write

ORIGIN_S = 0.1  # of the synthetic files: the first odometry sample


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset("mrclam_6", write(tmp_path_factory.mktemp("data"), seconds=20.0))


@pytest.fixture(scope="module")
def recording(dataset):
    return recording_of(dataset, "landmarks+robots")


def test_names_and_shapes(recording):
    L = len(LANDMARKS)
    setup = recording.setups[2]
    assert [s.name for s in recording.setups] == [f"vehicle_{n}" for n in range(1, 6)]
    assert setup.target_names == (*(f"landmark_{s}" for s in LANDMARKS), *(f"vehicle_{n}" for n in range(1, 6)))
    assert setup.planar and setup.landmarks == L and setup.targets.tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 9]
    assert recording.bearings.shape == (recording.ticks, 5, L + 5, 3)
    np.testing.assert_allclose(recording.landmarks[7, :, :2], list(LANDMARKS.values()))
    assert recording.ticks * TICK_S == pytest.approx(19.4, abs=0.1)


def test_increments_lead_from_one_true_pose_to_the_next(recording):
    R, p = recording.truth.rotation[0].copy(), recording.truth.position[0].copy()
    for k in range(1, recording.ticks):
        p = p + (R @ recording.translation[k][..., None])[..., 0]
        R = R @ recording.rotation[k]
    np.testing.assert_allclose(p, recording.truth.position[-1], atol=1e-3)
    np.testing.assert_allclose(R, recording.truth.rotation[-1], atol=1e-3)


def test_truth_is_planar(recording):
    x, y, heading = pose(2, ORIGIN_S + recording.t).T
    np.testing.assert_allclose(recording.truth.position[:, 1], np.stack([x, y, 0 * x], -1), atol=1e-4)
    np.testing.assert_allclose(
        recording.truth.rotation[:, 1], Rotation.from_euler("z", heading[:, None]).as_matrix(), atol=1e-3
    )


def test_bearings_are_turned_to_the_tick(recording):
    """View of the camera at the tick, but for the short distance driven since the frame."""
    seen = recording.visible[:, :, : recording.setups[0].landmarks]
    assert seen.any(axis=(0, 2)).all()
    worst = 0.0
    for k, i, n in np.argwhere(seen):
        x, y, heading = pose(i + 1, np.array([ORIGIN_S + recording.t[k]]))[0]
        dx, dy = list(LANDMARKS.values())[n] - np.array([x, y])
        expected = math.atan2(dy, dx) - heading
        error = (math.atan2(*recording.bearings[k, i, n, 1::-1]) - expected + math.pi) % (2 * math.pi) - math.pi
        worst = max(worst, abs(error) * math.hypot(dx, dy))
    assert worst < TICK_S * 0.16  # m; without the turn it were 0.005 rad times 4 m more
    assert np.isnan(recording.bearings[~recording.visible]).all()


def test_messages_arrive_one_tick_late(recording):
    inbox = recording.inbox_tick
    assert (inbox[0] == -1).all()
    for k in (1, 2, 3, 10):
        expected = (k - 1) - (k - 1) % MESSAGE_PERIOD_TICKS
        assert (inbox[k][~np.eye(5, dtype=bool)] == expected).all()
        assert (np.diag(inbox[k]) == -1).all()


def with_truth(dataset, n, t, corrupt=()):
    t = np.asarray(t, float)
    x, y, heading = pose(n + 1, ORIGIN_S + t).T
    robots = list(dataset.robots)
    robots[n] = replace(robots[n], truth=MotionCapture(t, np.stack([x, y], -1), np.unwrap(heading), corrupt))
    return replace(dataset, robots=tuple(robots))


def test_truth_has_gaps(dataset):
    sparse = [*np.arange(0, 5, 0.02), *np.arange(7, 9, 0.02), 12.013, 15.0]
    r = recording_of(with_truth(dataset, 1, sparse, ((8.0, 8.5),)), "landmarks")
    known = np.isfinite(r.truth.position[:, 1, 0])
    expected = (r.t < 4.99) | ((r.t > 6.99) & (r.t < 8.99))
    expected[[240, 300]] = True  # rows that stand alone, at the tick next to them
    assert known.tolist() == expected.tolist()
    x, y, _ = pose(2, np.array([ORIGIN_S + r.t[240]]))[0]
    np.testing.assert_allclose(r.truth.position[240, 1, :2], [x, y], atol=1e-4)  # 2 mm from the row
    heading_known = np.isfinite(r.truth.rotation[:, 1, 0, 0])
    assert not heading_known[(r.t > 8.0) & (r.t < 8.5)].any()
    assert heading_known[known & ((r.t < 7.9) | (r.t > 8.55))].all()


def test_a_robot_seen_late_starts_at_its_dead_reckoning(dataset):
    r = recording_of(with_truth(dataset, 3, np.arange(6.0, 18.0, 0.02)), "landmarks")
    whole = recording_of(dataset, "landmarks")
    np.testing.assert_allclose(r.start_position, whole.start_position, atol=2e-3)
    np.testing.assert_allclose(r.start_rotation, whole.start_rotation, atol=2e-3)
    std = np.sqrt(np.diagonal(r.start_covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(std[0], np.repeat(START_STD, 3))
    np.testing.assert_allclose(std[3], np.repeat(np.hypot(START_STD, np.array(DRIFT_STD) * math.sqrt(6.0)), 3))


def test_a_robot_never_seen_is_an_error(dataset):
    with pytest.raises(DataError, match="robot 4: no ground truth"):
        recording_of(with_truth(dataset, 3, [-5.0, -4.9]), "landmarks")


@pytest.mark.parametrize("variant", rest_slow(["landmarks", "landmarks+robots", "blind"], 1, 2))
@pytest.mark.parametrize("observer", [PlanarEkf, PlanarRobust])
def test_observers_follow_robots_without_noise(dataset, observer, variant):
    result = run(observer, recording_of(dataset, variant))
    assert not result.failure
    # bearings lag by up to a tick of driving; PlanarRobust expects a lead and gains that these robots do not have
    assert (result.position_rmse() < (0.02 if observer is PlanarEkf else 0.2)).all()
    assert (result.anees(after=TICK_S) < 2).all()


@pytest.mark.parametrize("observer", ["riccati", "mekf_covariance", "centralised", "dead_reckoning"])
def test_the_zoo_runs(dataset, observer):
    result = run(observer, recording_of(dataset, "landmarks+robots"))
    assert not result.failure
    assert (result.position_rmse() < 0.1).all()
