"""Places on a route against closed forms: lines, circles, and lines through random points."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.route_calls import places, points
from tests.helpers.warp_calls import DTYPES, EPSILON


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_straight_line_and_its_prolongations(dtype: str) -> None:
    rng = np.random.default_rng(0)
    angle, begin = 0.7, np.array([3.0, -2.0])
    ahead, left = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    s, aside = rng.uniform(-5.0, 15.0, 200), rng.uniform(-4.0, 4.0, 200)
    xy = begin + s[:, None] * ahead + aside[:, None] * left
    for count in (2, 7):
        line = begin + np.linspace(0.0, 10.0, count)[:, None] * ahead
        assert_allclose(places(dtype, line, xy), np.column_stack([s, aside, np.full(200, angle)]), atol=1e-4)
        found = points(dtype, line, s)
        assert_allclose(found[:, :2], begin + s[:, None] * ahead, atol=1e-4)
        assert_allclose(found[:, 2], angle, atol=1e-5)


def test_an_arc() -> None:
    """A chord of 1/20 of a radius is within 1/3200 of it from the arc; s is then right to within half of a chord."""
    radius, turn = 2.0, 3.0
    angles = np.linspace(0.0, turn, 61)
    line = radius * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])
    rng = np.random.default_rng(1)
    at, aside = rng.uniform(0.05, turn - 0.05, 300), rng.uniform(-1.0, 1.0, 300)
    xy = (radius - aside)[:, None] * np.column_stack([np.sin(at), -np.cos(at)]) + [0.0, radius]
    s, lateral, heading = places("float64", line, xy).T
    assert_allclose(s, radius * at, atol=0.05)
    assert_allclose(lateral, aside, atol=1e-3)
    assert_allclose(heading, at, atol=0.025)
    x, y, heading = points("float64", line, radius * at).T
    assert_allclose(x, radius * np.sin(at), atol=1.5e-3)
    assert_allclose(y, radius * (1 - np.cos(at)), atol=1.5e-3)
    assert_allclose(heading, at, atol=2.5e-3)


def test_the_place_is_the_nearest_one_of_a_crooked_line() -> None:
    """Against 20,000 points of the line; the place and the offset say where the point is nearest."""
    rng = np.random.default_rng(2)
    line = np.cumsum(rng.normal([1.0, 0.0], 0.5, (15, 2)), axis=0)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    xy = rng.uniform(line.min(0) + 0.5, line.max(0) - 0.5, (200, 2))
    fine = np.linspace(0.0, lengths[-1], 20001)
    dense = np.column_stack([np.interp(fine, lengths, line[:, k]) for k in (0, 1)])
    distance = np.linalg.norm(xy[:, None] - dense, axis=-1).min(axis=1)
    s, lateral, _ = places("float64", line, xy).T
    inside = (s > 0) & (s < lengths[-1])
    assert inside.sum() > 150
    assert_allclose(np.abs(lateral[inside]), distance[inside], atol=2e-3)
    there = points("float64", line, s)[inside, :2]
    assert_allclose(np.linalg.norm(there - xy[inside], axis=1), distance[inside], atol=2e-3)


def test_points_and_places_are_inverse() -> None:
    angles = np.linspace(0.0, 2.0, 40)
    line = 5.0 * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])
    s = np.linspace(-2.0, 12.0, 57)
    on = points("float64", line, s)
    again = places("float64", line, on[:, :2])
    assert_allclose(again[:, 0], s, atol=1e3 * EPSILON["float64"])
    assert_allclose(again[:, 1], 0.0, atol=1e2 * EPSILON["float64"] ** 0.5)
    assert_allclose(again[:, 2], on[:, 2], atol=1e3 * EPSILON["float64"])


def test_no_route() -> None:
    nothing = np.zeros((0, 2))
    assert_allclose(places("float64", nothing, np.array([[3.0, 4.0]])), 0.0)
    assert_allclose(points("float64", nothing, np.array([3.0])), 0.0)


def test_a_vehicle_that_leaves_its_route_ends_there() -> None:
    overrides = {"termination.off_route": 1.5, "obstacles": []}
    env = coopenv.parallel_env(FOUR_WAY, overrides=overrides)
    _, infos = env.reset(seed=0)
    goal, left = np.array(env.scenario.vehicles[0].goal.position[:2]), 0
    begin = infos["vehicle_1"]["truth"]["position"][:2]
    along = (goal - begin) / np.linalg.norm(goal - begin)
    while "vehicle_1" in env.agents:  # a circle to the left
        _, _, terminated, _, infos = env.step({agent: np.array([1.0, 0.5]) for agent in env.agents})
        x, y = infos["vehicle_1"]["truth"]["position"][:2] - begin
        left = max(abs(along[0] * y - along[1] * x), -(along[0] * x + along[1] * y))
        assert terminated["vehicle_1"] == (left > 1.5)
    assert infos["vehicle_1"]["outcome"] == "off route"
    assert infos["vehicle_1"]["reward_terms"]["collision"] == 0.0
