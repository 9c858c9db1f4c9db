"""The planar observer on robots whose odometry lies about turns, that see little, get lost, or lie themselves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.backends.mrclam import recording_of
from coopenv.observers.contract import Message
from coopenv.observers.planar.plugin import PlanarEkf, PlanarRobust
from coopenv.observers.runner import run
from tests.helpers.barrier_robots import barrier_robots, carried_off


@pytest.mark.parametrize("turn_scale", [0.6, pytest.param(1.0, marks=pytest.mark.slow), 1.5])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_odometry_that_lies_about_turns(seed, turn_scale):
    """The covariance stays honest and nobody is lost, whatever the wheels make of a command."""
    record = recording_of(barrier_robots(seed, 45.0, turn_scale), "landmarks+robots")
    result = run(PlanarRobust, record)
    assert not result.failure
    assert result.position_rmse().max() < 0.3 and result.position_rmse().mean() < 0.15
    assert (result.anees(after=record.dt) < 3).all() and result.anees(after=record.dt).mean() > 0.1
    assert result.position_rmse().mean() < 1.1 * run(PlanarEkf, record).position_rmse().mean()


class Watched(PlanarRobust):
    """Remembers when it was lost, and what it sent then."""

    def __init__(self, setup):
        super().__init__(setup)
        self.lost_at, self.sent = [], []
        Watched.all.append(self)

    all: list[Watched]

    def update(self, tick):
        estimate = super().update(tick)
        if self.lost:
            self.lost_at.append(tick.time)
        return estimate

    def message(self):
        message = super().message()
        if self.lost:
            self.sent.append(message)
        return message


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 5))])
def test_a_robot_that_is_carried_off_notices_and_finds_itself(seed):
    Watched.all = []
    record = carried_off(seed, robot=2, at=50.0, seconds=120.0)
    result = run(Watched, record)
    lost = np.array(Watched.all[2].lost_at)
    assert lost.size and 50.0 <= lost[0] < 75.0 and lost[-1] < 105.0
    assert all(message.position is None and message.size_bytes == 0 for message in Watched.all[2].sent)
    at = np.isin(np.round(result.t, 6), np.round(lost, 6))
    std = np.sqrt(np.diagonal(result.covariance[at, 2], axis1=1, axis2=2))
    assert (std[:, 2] > 1.0).all() and (std[:, 3:5] > 3.0).all()  # it says that it does not know
    end = result.t > 112.0
    assert np.sqrt(np.mean(result.position_error[end, 2] ** 2)) < 0.4
    assert not any(Watched.all[n].lost_at for n in (0, 1, 3, 4))


def test_who_starts_without_a_pose_searches():
    Watched.all = []
    record = recording_of(barrier_robots(4, 80.0), "landmarks+robots")
    turn = Rotation.from_euler("z", [[2.5], [-2.0], [1.5], [3.0], [-1.0]]).as_matrix()
    known = np.diag([1e-4, 1e-4, math.pi**2, 9.0, 9.0, 1e-4])
    start = replace(
        record,
        start_rotation=record.start_rotation @ turn,
        start_position=record.start_position + np.array([2.0, -1.5, 0.0]),
        start_covariance=np.tile(known, (5, 1, 1)),
    )
    result = run(Watched, start)
    assert all(one.lost_at and one.lost_at[-1] < 60.0 for one in Watched.all)
    assert (result.position_error[result.t > 75.0] < 0.8).all()
    assert (result.anees(after=record.dt) < 3).all()


@pytest.mark.parametrize(
    ("seed", "seconds"), [(11, 30.0), *(pytest.param(seed, 130.0, marks=pytest.mark.slow) for seed in (11, 12, 13))]
)
def test_a_robot_that_is_unsure_of_its_heading_waits_for_a_bearing(seed, seconds):
    """A robot that turns 0.6 times what it is commanded and sees nothing at first does not converge to a wrong pose.

    Nor is it lost by the first bearings.
    """
    result = run(PlanarRobust, recording_of(barrier_robots(seed, seconds, 0.6), "blind"))
    assert not result.failure and (result.anees(after=0.05) < 3).all()
    assert (result.position_error[result.t > 110.0] < 1.0).all()


class Babbling:
    """The first robot broadcasts one of many things that are no message, or nothing."""

    def __init__(self, silent: bool) -> None:
        self.silent, self.count = silent, 0

    def applies(self, vehicle, time):
        return vehicle == 0

    def broadcast(self, observer, message):
        self.count += 1
        return Message() if self.silent else _hostile(self.count % 9)


def _hostile(kind: int) -> Message:
    p, P, nan = np.zeros(3), np.eye(3), np.nan
    told = np.array([0, 0, 0, 1, 0, 1, 0, 0, 1], np.float32)
    extra = {"seen": np.arange(15, 20, dtype=np.uint8), "bearing": np.zeros(5, np.float32), "from": told}
    return (
        Message(position=p, covariance=-P),
        Message(position=p + 1e7, covariance=P),
        Message(extra={**extra, "from": -told}),
        Message(position=p + nan, covariance=P, extra={**extra, "from": told + np.float32(nan)}),
        Message(position=p, covariance=P + np.array([[0, 9, 0], [0, 0, 0], [0, 0, 0]])),
        Message(position=p + 1e300, covariance=1e300 * P),
        Message(position=p, covariance=nan * P, extra={**extra, "bearing": np.full(5, np.inf, np.float32)}),
        Message(position=p[:2], covariance=P, extra={**extra, "from": told[:4]}),
        Message(position=p, covariance=P[0], extra={**extra, "bearing": np.zeros(2, np.float32)}),
    )[kind]


def test_what_is_no_message_ends_no_run_and_changes_nothing():
    record = recording_of(barrier_robots(1, 12.0), "landmarks+robots")
    babbling, silent = (run(PlanarRobust, record, Babbling(silent)) for silent in (False, True))
    assert not babbling.failure
    np.testing.assert_array_equal(babbling.position, silent.position)
    np.testing.assert_array_equal(babbling.covariance, silent.covariance)
