"""Observers of robots on a plane as plug-ins, and among barriers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Coordinates
from coopenv.mrclam.planar import PlanarEkf, PlanarRobust
from coopenv.mrclam.recording import recording_of
from coopenv.observers.contract import Gains, Message, Received, SensorNoise, Setup, Tick
from coopenv.observers.runner import run
from tests.helpers.env_suite import rest_slow
from tests.helpers.mrclam_files import barrier_robots, carried_off
from tests.helpers.recordings import Tampering, completed

LIMIT_BYTES = 224  # pose and covariance in space
LANDMARKS = np.array([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
START = np.diag([1e-6, 1e-6, 0.02, 0.03, 0.05, 1e-6])


def setup(vehicle: int, planar: bool = True) -> Setup:
    return Setup(
        vehicle=vehicle,
        name=f"vehicle_{vehicle + 1}",
        target_names=("landmark_1", "landmark_2", "vehicle_1", "vehicle_2"),
        landmarks=2,
        targets=np.array([0, 1, 3 - vehicle]),
        lever_arm=np.zeros(3),
        marker=np.zeros(3),
        noise=SensorNoise(0.1, 0.1, 0.05, 0.02),
        gains=Gains(1.0, np.full(4, 10.0), (0.1, 1.0), (0.01, 0.01), 0.1),
        planar=planar,
    )


def tick(own: Setup, index: int, seen: dict[int, float], messages=None, turn: float = 0.0, path: float = 0.0) -> Tick:
    bearings = np.full((3, 3), np.nan)
    for target, beta in seen.items():
        bearings[own.targets.tolist().index(target)] = math.cos(beta), math.sin(beta), 0.0
    chord = path * np.sinc(turn / 2 / math.pi)
    return Tick(
        index=index,
        time=0.05 * index,
        dt=0.05,
        rotation=Rotation.from_euler("z", turn).as_matrix(),
        translation=chord * np.array([math.cos(turn / 2), math.sin(turn / 2), 0.0]),
        velocity=np.array([path / 0.05, 0.0, 0.0]),
        angular_velocity=np.array([0.0, 0.0, turn / 0.05]),
        targets=own.targets,
        bearings=bearings,
        valid=np.isfinite(bearings[:, 0]),
        landmarks=LANDMARKS,
        messages=messages or {},
        lever_arm=np.zeros(3),
        noise=own.noise,
    )


def started(observer, vehicle: int, x: float, y: float, heading: float, covariance=START):
    result = observer(setup(vehicle))
    result.reset((Rotation.from_euler("z", heading).as_matrix(), np.array([x, y, 0.0])), covariance)
    return result


def test_start_comes_back_in_left_coordinates():
    estimate = started(PlanarEkf, 0, 1.0, 2.0, 0.7).update(tick(setup(0), 1, {}))
    np.testing.assert_allclose(estimate.rotation, Rotation.from_euler("z", 0.7).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(estimate.position, [1.0, 2.0, 0.0])
    assert estimate.coordinates is Coordinates.LEFT
    np.testing.assert_allclose(np.diag(estimate.covariance)[2:5], [0.02, 0.03, 0.05], rtol=1e-2)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_covariance_is_that_of_the_left_error():
    """Noise drawn in the filter's own x, y, heading has the stated covariance in LEFT coordinates."""
    observer = started(PlanarEkf, 0, 1.0, 2.0, 0.7, np.diag([1e-6, 1e-6, 2e-4, 3e-4, 9e-4, 1e-6]))
    estimate = observer.update(tick(setup(0), 1, {0: 0.1}))
    x = observer.filter.state[:3] + np.random.default_rng(1).multivariate_normal(
        np.zeros(3), observer.filter.covariance[:3, :3], 40_000
    )
    R = Rotation.from_euler("z", x[:, 2:]).as_matrix()
    p = np.column_stack([x[:, :2], np.zeros(len(x))])
    e = Coordinates.LEFT.error(R, p, np.broadcast_to(estimate.rotation, R.shape), estimate.position)
    np.testing.assert_allclose(np.cov(e[:, 2:5].T), estimate.covariance[2:5, 2:5], atol=2e-5)
    assert np.abs(e[:, [0, 1, 5]]).max() < 1e-9


def test_textbook_filter_moves_along_the_arc():
    observer, own, turn, path = started(PlanarEkf, 0, 0.0, 0.0, 0.0), setup(0), 0.02, 0.03
    for k in range(1, 101):
        estimate = observer.update(tick(own, k, {}, turn=turn, path=path))
    radius = path / turn
    np.testing.assert_allclose(estimate.position[:2], radius * np.array([math.sin(2), 1 - math.cos(2)]), atol=1e-3)
    np.testing.assert_allclose(estimate.rotation, Rotation.from_euler("z", 2.0).as_matrix(), atol=1e-9)


def test_a_robot_that_is_seen_corrects_itself_once():
    confident = np.diag([1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6])
    seer, seen = started(PlanarRobust, 0, 0.0, 0.0, 0.0, confident), started(PlanarRobust, 1, 2.0, 0.3, 1.0)
    heard = {3: Received(seen.message(), 0.05)}
    seer.update(tick(setup(0), 1, {3: 0.0}, heard))  # it is straight ahead, not 0.3 m to the left
    message = seer.message()
    assert message.extra["seen"].tolist() == [3]
    np.testing.assert_allclose(message.extra["from"][:3], 0.0, atol=1e-6)
    assert message.size_bytes <= LIMIT_BYTES
    first = seen.update(tick(setup(1), 2, {}, {2: Received(message, 0.05)}))
    again = seen.update(tick(setup(1), 3, {}, {2: Received(message, 0.10)}))
    assert abs(first.position[1]) < 0.1
    np.testing.assert_allclose(again.position, first.position, atol=1e-9)
    assert not seer.message().extra  # each sighting is broadcast once


def test_a_robot_corrects_itself_with_its_sighting():
    observer = started(PlanarEkf, 0, 0.0, 0.0, 0.1, np.diag([1e-6, 1e-6, 0.02, 1e-4, 1e-4, 1e-6]))
    message = Message(position=np.array([2.0, 0.0, 0.0]), covariance=1e-6 * np.eye(3))
    estimate = observer.update(tick(setup(0), 1, {3: 0.0}, {3: Received(message, 0.05)}))
    assert abs(math.atan2(estimate.rotation[1, 0], estimate.rotation[0, 0])) < 0.02
    assert not observer.message().extra  # the textbook filter tells nobody


def test_neighbours_that_send_nothing_are_left_out():
    observer = started(PlanarRobust, 0, 0.0, 0.0, 0.1)
    before = observer.update(tick(setup(0), 1, {}))
    for k, message in enumerate((Message(), Message(position=np.array([2.0, 0.0, 0.0])))):
        after = observer.update(tick(setup(0), 2 + k, {3: 0.0}, {3: Received(message, 0.05)}))
        np.testing.assert_allclose(after.position, before.position, atol=1e-9)


def test_most_sightings_still_fit():
    observer = started(PlanarRobust, 0, 0.0, 0.0, 0.0)
    observer._sightings = [(2 + k % 4, 0.1) for k in range(20)]
    assert observer.message().size_bytes <= LIMIT_BYTES


def test_robots_in_space_are_refused():
    with pytest.raises(CoopenvError, match="vehicle_1"):
        PlanarRobust(replace(setup(0), planar=False))


@pytest.mark.parametrize("turn_scale", rest_slow([0.6, 1.0, 1.5], 0))
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_odometry_that_lies_about_turns(seed, turn_scale):
    """The covariance stays honest and nobody is lost, whatever the wheels make of a command."""
    record = recording_of(barrier_robots(seed, 45.0, turn_scale), "landmarks+robots")
    result = completed(PlanarRobust, record)
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


@pytest.mark.parametrize(("seed", "at"), rest_slow([(3, 15.0), (1, 50.0), (5, 50.0)], 0))
def test_a_robot_that_is_carried_off_notices_and_finds_itself(seed, at):
    Watched.all = []
    record = carried_off(seed, robot=2, at=at, seconds=at + 70.0)
    result = run(Watched, record)
    lost = np.array(Watched.all[2].lost_at)
    assert lost.size and at <= lost[0] < at + 25.0 and lost[-1] < at + 55.0
    assert all(message.position is None and message.size_bytes == 0 for message in Watched.all[2].sent)
    there = np.isin(np.round(result.t, 6), np.round(lost, 6))
    std = np.sqrt(np.diagonal(result.covariance[there, 2], axis1=1, axis2=2))
    assert (std[:, 2] > 1.0).all() and (std[:, 3:5] > 3.0).all()  # it says that it does not know
    end = result.t > at + 62.0
    assert np.sqrt(np.mean(result.position_error[end, 2] ** 2)) < 0.4
    assert not any(Watched.all[n].lost_at for n in (0, 1, 3, 4))


def test_robots_without_an_initial_pose_search():
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
    result = completed(PlanarRobust, recording_of(barrier_robots(seed, seconds, 0.6), "blind"))
    assert (result.anees(after=0.05) < 3).all()
    assert (result.position_error[result.t > 110.0] < 1.0).all()


def hostile() -> tuple[Message, ...]:
    """Return things that are no message."""
    p, P, nan = np.zeros(3), np.eye(3), np.nan
    origin = np.array([0, 0, 0, 1, 0, 1, 0, 0, 1], np.float32)
    extra = {"seen": np.arange(15, 20, dtype=np.uint8), "bearing": np.zeros(5, np.float32), "from": origin}
    return (
        Message(position=p, covariance=-P),
        Message(position=p + 1e7, covariance=P),
        Message(extra={**extra, "from": -origin}),
        Message(position=p + nan, covariance=P, extra={**extra, "from": origin + np.float32(nan)}),
        Message(position=p, covariance=P + np.array([[0, 9, 0], [0, 0, 0], [0, 0, 0]])),
        Message(position=p + 1e300, covariance=1e300 * P),
        Message(position=p, covariance=nan * P, extra={**extra, "bearing": np.full(5, np.inf, np.float32)}),
        Message(position=p[:2], covariance=P, extra={**extra, "from": origin[:4]}),
        Message(position=p, covariance=P[0], extra={**extra, "bearing": np.zeros(2, np.float32)}),
    )


def test_malformed_messages_change_nothing():
    record = recording_of(barrier_robots(1, 8.0), "landmarks+robots")
    babbling, silent = (
        completed(PlanarRobust, record, Tampering(*[lambda _, m=m: m for m in sent], vehicle=0))
        for sent in (hostile(), [Message()])
    )
    np.testing.assert_array_equal(babbling.position, silent.position)
    np.testing.assert_array_equal(babbling.covariance, silent.covariance)
