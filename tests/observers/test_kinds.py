"""The zoo's filters, the joint filters and the bound with every kind of measurement, against dense formulas."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coopenv.estimation.poses import Array, Coordinates, exp_so3
from coopenv.measurements.kinds import Placed
from coopenv.measurements.sensor import MAP, Reading, kind_of
from coopenv.measurements.table import KINDS
from coopenv.observers import run
from coopenv.observers.bound import cramer_rao, cramer_rao_ancestors
from coopenv.observers.contract import Tick
from coopenv.observers.correction import curvature
from coopenv.observers.recording import Recording
from coopenv.observers.registry import find
from tests.helpers.readings import recorded, with_readings

KEYS: dict[str, Any] = {"rates.camera": 10.0, "rates.odometry": 10.0, "horizon": 2.0}
MOUNTED = {"position": [0.4, -0.2, 0.7], "orientation": [0.5, 0.5, -0.1, 0.7], "towards": ["landmarks", "vehicles"]}
SINGLE = ("mekf", "mekf_covariance", "left_invariant", "right_invariant", "iterated_ekf", "ukf", "schmidt_kalman")
STEP = 1e-5


def sections(kind: str) -> list[dict[str, Any]]:
    """Return a mounted sensor of a kind."""
    mounted = {key: value for key, value in MOUNTED.items() if key != "towards"}
    return [{"kind": kind, **(mounted if kind in ("position", "attitude") else MOUNTED)}]


@pytest.fixture(scope="module")
def base() -> Recording:
    """A recording with bearings alone."""
    return recorded("busy_intersection_tracking", [], seed=3, **KEYS)


def moved(R: Array, p: Array, e: Array) -> tuple[Array, Array]:
    """Return a pose with a left error (6,)."""
    return R @ exp_so3(e[:3]), p + R @ e[3:]


def prediction_of(recording: Recording, k: int, i: int, n: int, poses: list[tuple[Array, Array]]) -> Array:
    """Return what a vehicle's only sensor measures of its target number n, without noise, at the poses of all."""
    setup, L = recording.setups[i], recording.landmarks.shape[1]
    [sensor] = setup.sensors
    R, p = poses[i]
    own = sensor.placed(R, p, recording.velocity[k, i], recording.angular_velocity[k, i])
    target = int(sensor.targets[n])
    place = Placed.at(np.zeros(3))
    if target >= L:
        Rj, pj = poses[target - L]
        place = Placed.at(pj + Rj @ recording.setups[target - L].marker, Rj)
    elif target != MAP:
        place = Placed.at(recording.landmarks[k, target])
    return sensor.kind.predict(own, place)


def derivative(recording: Recording, k: int, i: int, n: int, poses: list[tuple[Array, Array]]) -> Array:
    """Return (r, 6N) the derivative of a measurement by the left errors of all vehicles, by differences."""
    [sensor], at = recording.setups[i].sensors, prediction_of(recording, k, i, n, poses)
    H = np.zeros((sensor.kind.rows, 6 * len(poses)))
    for j in {i, int(sensor.targets[n]) - recording.landmarks.shape[1]} & {*range(len(poses))}:  # of no others
        for column, axis in enumerate(np.eye(6), 6 * j):
            ends = []
            for step in (STEP, -STEP):
                there = [*poses]
                there[j] = moved(*poses[j], step * axis)
                ends.append(sensor.kind.residual(prediction_of(recording, k, i, n, there), at))
            H[:, column] = (ends[0] - ends[1]) / (2.0 * STEP)
    return H


def first_tick(recording: Recording, vehicle: int) -> Tick:
    """Return the first tick of a vehicle without odometry noise, with readings of landmarks or the map alone."""
    tick = recording.tick(1, vehicle, {})
    quiet = replace(tick.noise, velocity=0.0, angular_velocity=0.0)
    return replace(tick, valid=np.zeros_like(tick.valid), noise=quiet)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SINGLE)
def test_a_correction_by_a_kind_is_the_dense_one(base: Recording, kind: str, name: str) -> None:
    recording = with_readings(base, sections(kind), seed=1)
    setup, tick = recording.setups[0], first_tick(recording, 0)
    std = 1e-4  # so small that all linearisations agree
    start = (np.array([recording.truth.rotation[0, 0]])[0], recording.truth.position[0, 0])
    observer = find(name)(setup)
    observer.reset(start, std**2 * np.eye(6))
    estimate = observer.update(tick)

    R, p = start[0] @ tick.rotation, start[1] + start[0] @ tick.translation
    E = tick.rotation.T
    a, b, c = tick.translation
    F = np.zeros((6, 6))
    F[:3, :3] = F[3:, 3:] = E
    F[3:, :3] = -E @ np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    information = np.linalg.inv(std**2 * F @ F.T)
    poses = [(R, p)]
    [sensor] = setup.sensors
    L = recording.landmarks.shape[1]
    for n, target in enumerate(sensor.targets.tolist()):
        if target < L:
            H = derivative(recording, 1, 0, n, poses)
            information = information + H.T @ np.diag(sensor.std**-2.0) @ H
    P, coordinates = estimate.covariance, estimate.coordinates
    assert P is not None
    if coordinates is Coordinates.RIGHT:
        shift = np.eye(6)
        x, y, z = estimate.position
        shift[3:, :3] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        to_left = np.linalg.inv(shift @ np.kron(np.eye(2), estimate.rotation))
        P = to_left @ P @ to_left.T
    expected = np.linalg.inv(information)
    scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    assert np.abs((P - expected) / scale).max() < 2e-3
    assert np.abs(information - np.linalg.inv(std**2 * F @ F.T)).max() > 0.0


@pytest.mark.parametrize("name", ["bearing", "range"])
def test_curvature_is_the_variance_of_what_linearisation_leaves(name: str) -> None:
    kind, line, rng = kind_of(name), np.array([6.0, -3.0, 2.0]), np.random.default_rng(0)
    u, t = line / 7.0, np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)  # along the line, and across it
    errors = rng.normal(size=(20_000, 2)) * np.array([0.2, 0.3]) @ np.stack([u, t])
    own, target = Placed.at(np.zeros(3)), Placed.at(line)
    G = kind.jacobian(own, target)[1][:, 3:]
    moved = kind.predict(own.repeated(len(errors)), Placed.at(line + errors))
    left = kind.residual(moved, np.broadcast_to(kind.predict(own, target), moved.shape)) - errors @ G.T
    angle = np.full((1, kind.rows), name == "bearing")
    V = 0.04 * np.outer(u, u) + 0.09 * np.outer(t, t)
    [found] = curvature(G[None], angle, line[None], V[None], np.array([5.0]))
    if name == "range":
        assert found == pytest.approx(5.0 * left.var(axis=0), rel=0.05)
    else:  # each row counts the error across the line in any direction
        assert found == pytest.approx(np.full(2, 5.0 * left.var(axis=0).sum()), rel=0.1)


@pytest.mark.parametrize("name", ["mekf", "schmidt_kalman"])
def test_ranges_in_a_plane_leave_the_height_uncertain(base: Recording, name: str) -> None:
    """The start is one standard deviation too high; ranges without noise hardly depend on the height."""
    recording = with_readings(base, [{"kind": "range", "noise": 0.02, "towards": ["landmarks"]}])
    setup, tick, place = recording.setups[0], first_tick(recording, 0), recording.truth.position[0, 0]
    [sensor], still = setup.sensors, {"rotation": np.eye(3), "translation": np.zeros(3)}
    landmarks = tick.landmarks * [1.0, 1.0, 0.0] + place * [0.0, 0.0, 1.0]
    distances = np.linalg.norm(landmarks[sensor.targets] - place, axis=1)
    observer = find(name)(setup)
    observer.reset((np.eye(3), place + np.array([0.0, 0.0, 0.5])), np.diag([1e-6] * 3 + [0.25] * 3))
    for k in range(1, 61):
        changed = {"index": k, "time": k * tick.dt, "landmarks": landmarks}
        estimate = observer.update(replace(tick, **still, **changed, readings=(Reading(sensor, distances[:, None]),)))
    error, P = estimate.position - place, estimate.covariance
    assert P is not None
    assert error @ np.linalg.solve(P[3:, 3:], error) / 3.0 < 1.0
    assert np.abs(error[:2]).max() < 0.02


@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_the_bound_with_a_kind_is_an_information_filter_at_the_truth(base: Recording, kind: str, joint: bool) -> None:
    recording = with_readings(base, sections(kind), seed=2, blind=True)
    N = len(recording.setups)
    P = np.zeros((6 * N, 6 * N))
    for i in range(N):
        P[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = recording.start_covariance[i]
    bound = cramer_rao(recording, joint=joint).covariance
    for k in range(1, 5):
        truth = [*zip(recording.truth.rotation[k], recording.truth.position[k], strict=True)]
        before = [*zip(recording.truth.rotation[k - 1], recording.truth.position[k - 1], strict=True)]
        F, Q = np.zeros_like(P), np.zeros_like(P)
        for i, ((R, p), (R0, p0)) in enumerate(zip(truth, before, strict=True)):
            E, way = R.T @ R0, R0.T @ (p - p0)
            of = slice(6 * i, 6 * i + 6)
            a, b, c = way
            F[of, of] = np.block(
                [[E, np.zeros((3, 3))], [-E @ np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]), E]]
            )
            Q[of, of] = np.diag(recording.setups[i].noise.odometry(recording.dt))
        P = F @ P @ F.T + Q
        information = np.linalg.inv(P)
        for i, setup in enumerate(recording.setups):
            [sensor] = setup.sensors
            for n in range(len(sensor.targets)):
                H = derivative(recording, k, i, n, truth)
                if not joint:
                    H[:, [c for c in range(6 * N) if c // 6 != i]] = 0.0
                information = information + H.T @ np.diag(sensor.std**-2.0) @ H
        P = np.linalg.inv(information)
        expected = np.array([P[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(N)])
        assert np.abs(bound[k] - expected).max() < 1e-7 * np.abs(expected).max()


ALL = [{"kind": kind, "noise": noise} for kind, noise in (("range", 0.1), ("position", 1.0), ("attitude", 0.05))]


@pytest.mark.parametrize("name", ["schmidt_kalman", "pairwise", "centralised"])
def test_filters_gain_by_sensors_and_stay_consistent(name: str) -> None:
    keys = {**KEYS, "horizon": 6.0}
    alone = recorded("busy_intersection_tracking", [], seed=5, **keys)
    both = with_readings(alone, ALL, seed=5)
    errors = [run(name, recording) for recording in (alone, both)]
    assert all(not result.failure for result in errors)
    before, after = (float(np.mean(result.position_rmse(3.0))) for result in errors)
    bound = float(np.mean(cramer_rao_ancestors(both).position[30:]))
    assert after < before
    assert after < 1.8 * bound
    assert np.median(errors[1].anees(3.0)) < 3.0
