"""The table `streets` and the key `count` of scenario files."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

import coopenv
from coopenv import ScenarioError
from coopenv.base.installation import scenario_path
from coopenv.base.sections import read_toml
from coopenv.scenario.files import schema_text
from coopenv.scenario.routes import even_points

SMALL = {"streets.blocks": [3, 2], "vehicles.0.count": 10, "vehicles.1.count": 6}


@pytest.fixture(scope="module")
def city() -> coopenv.Scenario:
    return coopenv.load_scenario("city", SMALL)


def test_streets_make_a_city(city: coopenv.Scenario) -> None:
    crossings = 4 * 3
    assert (len(city.roads), len(city.obstacles), len(city.landmark_groups)) == (7, 6, 6)
    assert len(city.landmarks) == 6 * 4
    assert len(city.routes) == crossings * 4 * 2
    assert len(city.vehicles) == 16


def test_routes_go_on_until_the_edge(city: coopenv.Scenario) -> None:
    begins, ends = (np.array([route.waypoints[k] for route in city.routes]) for k in (0, -1))
    follow = (np.linalg.norm(begins[None] - ends[:, None], axis=-1) < 1e-9).sum(axis=1)
    outside = (np.abs(ends) > np.array([120.0, 80.0]) + 3.0).any(axis=1)
    np.testing.assert_array_equal(follow, np.where(outside, 0, 2))
    assert outside.sum() == 14 * 2


def test_routes_keep_clear_of_buildings_and_to_the_right(city: coopenv.Scenario) -> None:
    low, high = (np.array([np.add(o.center, s * np.array(o.size) / 2)[:2] for o in city.obstacles]) for s in (-1, 1))
    for route in city.routes:
        x, y, heading = even_points(route).T
        points = np.stack([x, y], axis=1)[:, None]
        apart = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=-1)
        assert apart.min() > 2.0  # half of a car's width, and a metre
        right = points[0, 0] + 1.75 * np.array([np.sin(-heading[0]), np.cos(heading[0])])
        along = np.array([np.cos(heading[0]), np.sin(heading[0])])
        axis = right[np.abs(along).argmin()]  # the coordinate across the street
        assert np.isclose(axis % 40.0, 0.0, atol=1e-6) or np.isclose(axis % 40.0, 40.0, atol=1e-6)


def test_signs_are_in_front_of_facades(city: coopenv.Scenario) -> None:
    for group, house in zip(city.landmark_groups, city.obstacles, strict=True):
        middles = np.array([np.add(line.start, line.end) / 2 for line in group.lines])
        away = np.abs(middles - np.array(house.center)[:2]).max(axis=1)
        np.testing.assert_allclose(away, house.size[0] / 2 + 0.1)
        assert group.height[1] < house.size[2]


def test_green_times_of_crossing_streets_do_not_meet(city: coopenv.Scenario) -> None:
    lights: dict[str, dict[str, Any]] = {}
    for route in city.routes:
        heading, column, row, _ = route.name.split("_")
        lights.setdefault(f"{column}_{row}", {})[heading] = route.signal
    time = np.arange(0.0, 28.0, 0.1)
    for crossing in lights.values():
        green = {h: ((time - light.start) % light.period) < light.green for h, light in crossing.items()}
        np.testing.assert_array_equal(green["east"], green["west"])
        assert not (green["east"] & green["north"]).any()
        assert (green["east"] | green["north"]).mean() > 0.5


def test_cars_start_within_or_come_in_from_the_edge(city: coopenv.Scenario) -> None:
    begins = {route.name: np.abs(route.waypoints[0]) for route in city.routes}
    for car in city.vehicles:
        outside = [(begins[name] > np.array([123.0, 83.0])).any() for name in car.routes]
        assert outside == [car.entry is not None] * len(car.routes)
    assert len({car.routes for car in city.vehicles}) == 16


def test_the_schema_knows_streets_and_counts() -> None:
    validator = Draft202012Validator(json.loads(schema_text()))
    raw = read_toml(scenario_path("city"), ScenarioError)
    assert not [*validator.iter_errors(raw)]
    for wrong in ({**raw, "streets": {}}, {**raw, "vehicles": [{"count": -1}]}):
        assert [*validator.iter_errors(wrong)]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"streets.blocks": [0, 3]}, r"streets: blocks\.0: .*greater than or equal to 1"),
        ({"streets.block": "far"}, r"streets: block: "),
        ({"streets.blokc": 50.0}, r"streets: blokc: unknown key \(did you mean 'block'\?\)"),
        ({"streets": 3}, r"streets: Input should be an object, got 3$"),
        ({"streets.clearance": 14.0}, r"streets: clearance: 14 s must be below half the period, 14 s$"),
        ({"streets.height": 1.0}, r"streets: sign_height: 5 m is above the `height`, 1 m$"),
        ({"roads": 3}, r"roads: must be a list of tables"),
        ({"vehicles.0.count": 1.5}, r"vehicles\.0\.count: expected a whole number 1 to 4096, got 1\.5"),
        ({"vehicles.1.count": 5000}, r"vehicles\.1\.count: expected a whole number 1 to 4096, got 5000"),
    ],
)
def test_wrong_files(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        coopenv.load_scenario("city", overrides)
