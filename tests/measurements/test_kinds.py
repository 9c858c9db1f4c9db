"""Shipped kinds of measurements against formulas written another way, at random places and mountings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.measurements.kinds import Kind, Placed
from coopenv.measurements.sensor import MAP, Sensor, averaged_std, kind_of
from coopenv.measurements.table import KINDS

Array = Any
STEP = 1e-5  # rad and m, of central differences: their error is near 1e-10


def bearing(R: Rotation, p: Array, target_R: Rotation, z: Array) -> Array:
    x, y, w = R.inv().apply(z - p)
    azimuth, elevation = math.atan2(y, x), math.atan2(w, math.hypot(x, y))
    return np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )


def relative_pose(R: Rotation, p: Array, target_R: Rotation, z: Array) -> Array:
    return np.concatenate([R.inv().apply(z - p), (R.inv() * target_R).as_rotvec()])


EXPECTED: dict[str, Callable[[Rotation, Array, Rotation, Array], Array]] = {
    "bearing": bearing,
    "range": lambda R, p, target_R, z: np.array([math.dist(p, z)]),
    "range_bearing": lambda R, p, target_R, z: np.array([*bearing(R, p, target_R, z), math.dist(p, z)]),
    "position": lambda R, p, target_R, z: p,
    "attitude": lambda R, p, target_R, z: R.as_rotvec(),
    "relative_pose": relative_pose,
}
"""Values by axes and place of the sensor, and of the target."""
DIRECTIONS = {"bearing": 3, "range_bearing": 3}
"""Numbers of a value, from its first on, that are a unit vector."""
TURNS = {"attitude": 0, "relative_pose": 3}
"""Where in a value the rotation vector begins."""


def change(name: str, before: Array, after: Array) -> Array:
    """Return the difference of two values in coordinates of the value; of rotation vectors the turn between them."""
    found = after - before
    if name in TURNS:
        at = slice(TURNS[name], TURNS[name] + 3)
        found[at] = (Rotation.from_rotvec(after[at]) * Rotation.from_rotvec(before[at]).inv()).as_rotvec()
    return found


def test_every_shipped_kind_has_formulas_of_its_own() -> None:
    assert EXPECTED.keys() == KINDS.keys()


numbers = st.floats(-8.0, 8.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = vectors.map(lambda v: Rotation.from_rotvec(v / max(1.0, np.linalg.norm(v) / 3.0)))


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Rotation, Array, Rotation, Array, Rotation, Array]:
    """Return a body (R, p), a mounting (R, p) and a target (R, p) at least 1 m from the sensor."""
    R, mounted, target_R = draw(turns), draw(turns), draw(turns)
    p, arm, away = draw(vectors), draw(vectors) / 8.0, draw(vectors)
    away = away + np.array([9.5, 0.0, 0.0])  # at least 1.5 m
    return R, p, mounted, arm, target_R, p + R.apply(arm) + away


def sensor_of(name: str, mounted: Rotation, arm: Array) -> Sensor:
    rows = kind_of(name).rows
    return Sensor(name, name, np.linspace(0.1, 0.2, rows), np.array([MAP]), arm, mounted.as_matrix())


@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=40, deadline=None)
@given(scene=scenes())
def test_predictions_and_derivatives_are_those_of_the_formulas(
    name: str, scene: tuple[Rotation, Array, Rotation, Array, Rotation, Array]
) -> None:
    R, p, mounted, arm, target_R, z = scene
    sensor, formula = sensor_of(name, mounted, arm), EXPECTED[name]
    kind = sensor.kind

    def value(body: Array, target: Array) -> Array:
        """Return the value with a left error of the body, and a target turned about its axes and shifted on the map."""
        turned, place = R * Rotation.from_rotvec(body[:3]), p + R.apply(body[3:])
        to_target = target_R * Rotation.from_rotvec(target[:3]), z + target[3:]
        return formula(turned * mounted, place + turned.apply(arm), *to_target)

    zero, matrix = np.zeros(6), R.as_matrix()
    own = sensor.placed(matrix, p, np.zeros(3), np.zeros(3))
    target = Placed.at(z, target_R.as_matrix())
    exact = value(zero, zero)
    assert_allclose(change(name, exact, kind.predict(own, target)), 0.0, atol=1e-9)
    linear = sensor.linearised(matrix, own.repeated(1), target.repeated(1), exact[None])
    assert_allclose(linear.residual, 0.0, atol=1e-9)
    assert linear.used.all()
    assert_allclose(linear.noise[0], np.linspace(0.1, 0.2, kind.rows) ** 2)
    to_rows = np.stack([kind.residual(exact + STEP * axis, exact) for axis in np.eye(kind.size)], axis=-1) / STEP
    for found, moves in ((linear.by_own[0], (1, 0)), (linear.by_target[0], (0, 1))):
        columns = []
        for axis in np.eye(6):
            ahead, behind = (value(moves[0] * h * axis, moves[1] * h * axis) for h in (STEP, -STEP))
            columns.append(change(name, behind, ahead) / (2.0 * STEP))
        expected = np.stack(columns, axis=-1)
        if name in TURNS:
            assert_allclose(found, expected, atol=1e-7)
        else:
            assert_allclose(found, to_rows @ expected, atol=1e-7)


@pytest.mark.parametrize("name", KINDS)
def test_a_derivative_by_differences_equals_the_given_one(name: str) -> None:
    rng = np.random.default_rng(5)
    own, target = (Placed.at(rng.normal(size=(20, 3)), Rotation.random(20, rng).as_matrix()) for _ in range(2))
    target = replace(target, position=target.position + 5.0)
    kind = kind_of(name)
    for found, expected in zip(kind.jacobian(own, target), Kind.differences(kind, own, target), strict=True):
        assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize("name", KINDS)
def test_residuals_of_samples_have_the_drawn_mean_and_covariance(name: str) -> None:
    kind, count = kind_of(name), 20_000
    own, target = (
        Placed.at(np.zeros(3)),
        Placed.at(np.array([3.0, 4.0, 1.0]), Rotation.from_rotvec([2, 1, 0]).as_matrix()),
    )
    if name == "attitude":
        own = replace(own, rotation=Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix())
    predicted = np.tile(kind.predict(own, target), (count, 1))
    std = np.linspace(0.01, 0.02, kind.rows)
    noise = np.random.default_rng(6).normal(size=(count, kind.rows)) * std
    values = kind.sample(predicted, noise)
    residual = kind.residual(values, predicted)
    assert_allclose(residual.mean(axis=0), 0.0, atol=4.0 * std.max() / math.sqrt(count))
    assert_allclose(np.cov(residual.T).reshape(kind.rows, -1), np.diag(std**2), atol=0.05 * std.max() ** 2)
    for size in [DIRECTIONS[name]] if name in DIRECTIONS else []:
        assert_allclose(np.linalg.norm(values[:, :size], axis=-1), 1.0)


def test_two_orientations_near_half_a_turn_differ_by_a_small_turn() -> None:
    kind = kind_of("attitude")
    one, other = np.array([0.0, 0.0, np.pi - 0.01]), np.array([0.0, 0.0, -np.pi + 0.01])
    assert_allclose(kind.residual(other, one), [0.0, 0.0, 0.02], atol=1e-12)


@pytest.mark.parametrize("time", [0.5, 5.0])
def test_the_averaged_deviation_is_that_of_a_long_mean(time: float) -> None:
    white, correlated, period, count = 0.3, 0.5, 0.1, 4_000
    times = period * np.arange(count)
    covariance = correlated**2 * np.exp(-np.abs(times[:, None] - times) / time)
    of_mean = (covariance.sum() + count * white**2) / count**2
    expected = averaged_std(np.array([white]), correlated, time, period)
    assert_allclose(expected**2 / count, of_mean, rtol=0.02)
