"""Scenarios that are large or far, each of which has to load and start at once."""

from __future__ import annotations

import warnings
from typing import Any

import coopenv
from coopenv.scenario import Scenario, parse_scenario
from coopenv.world.world import World
from tests.helpers.four_way import FOUR_WAY


def base() -> dict[str, Any]:
    return coopenv.load_scenario(FOUR_WAY).model_dump(mode="json")


def vehicles(count: int, edge: float) -> list[dict[str, Any]]:
    one = base()["vehicles"][0]
    places = [[1000.0 + 6.0 * (i % 30), 1000.0 + 6.0 * (i // 30), 0.0] for i in range(count)]
    body = {"size": [edge, edge, edge]}
    return [{**one, "body": body, "initial_pose": {"position": place}} for place in places]


def landmarks(count: int) -> list[dict[str, Any]]:
    return [{"name": f"L{i}", "position": [float(i % 100), float(i // 100), 1.0]} for i in range(count)]


def obstacles(count: int) -> list[dict[str, Any]]:
    return [{"name": f"o{i}", "center": [5.0 * i, -500.0, 0.0], "size": [1.0, 1.0, 1.0]} for i in range(count)]


def moving(motion: dict[str, Any]) -> dict[str, Any]:
    pose = {} if motion["kind"] == "waypoints" else {"initial_pose": {"position": [0.0, 0.0, 0.0]}}
    return {"vehicles": [{"motion": motion, **pose}]}


def waypoints(count: int, gap: float) -> dict[str, Any]:
    points = [{"time": gap * i, "position": [float(i % 7), float(i % 3), 0.0]} for i in range(count)]
    return moving({"kind": "waypoints", "waypoints": points})


CASES: tuple[Any, ...] = (
    lambda: {"vehicles": vehicles(600, 1.0)},
    lambda: {"vehicles": vehicles(600, 1e4), "obstacles": []},
    lambda: {"vehicles": vehicles(600, 1.0), "obstacles": obstacles(1000)},
    lambda: {"landmarks": landmarks(20_000)},
    lambda: waypoints(2, 1e4),
    lambda: waypoints(2, 1e9),
    lambda: waypoints(5000, 1.0),
    lambda: waypoints(5000, 1e4),
    lambda: moving({"kind": "segments", "segments": [{"duration": 1e9, "angular": [0.0, 0.0, 1e9]}] * 500}),
)


def prepare() -> None:
    """Load what the cases need."""
    case(-1)


def case(number: int) -> str:
    """Load one and build its world."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scenario: Scenario = parse_scenario({**base(), **(CASES[number]() if number >= 0 else {})}, "large")
        World(scenario)
    return "accepted"
