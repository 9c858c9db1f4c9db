"""Planar observers on ticks: coordinates, messages, and who corrects itself with what."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Coordinates
from coopenv.observers.contract import Gains, Message, Received, SensorNoise, Setup, Tick
from coopenv.observers.planar.plugin import PlanarEkf, PlanarRobust

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
    assert not seer.message().extra  # each sighting is told once


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
