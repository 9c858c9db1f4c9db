"""Turn what a scenario draws at a reset into the arrays and numbers of a `Model`."""

from typing import Any

import numpy as np

from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Landmark, Vehicle
from coopenv.scenario.learning import PARAMETERS
from coopenv.scenario.routes import even_points, followers, point_count
from coopenv.world.model import CONTINUE, LEAVE, PARK

AFTER_ARRIVAL = {"park": PARK, "leave": LEAVE, "continue": CONTINUE}


def routes_of(scenario: Scenario) -> dict[str, Any]:
    """Return the fields of `Routes` by name."""
    origin, routes = np.array(scenario.map.origin), scenario.routes
    number = {route.name: i for i, route in enumerate(routes)}
    choices = [[number[name] for name in vehicle.routes] for vehicle in scenario.vehicles]
    places = [vehicle.goal and vehicle.goal.position for vehicle in scenario.vehicles]
    counts = [point_count(route) for route in routes]
    points = np.zeros((len(routes), max(counts, default=0), 3))
    for route, row in zip(routes, points, strict=True):
        row[: point_count(route)] = even_points(route) - [*origin[:2], 0.0]
    return {
        "first": np.cumsum([0, *(len(own) for own in choices)]),
        "choice": [i for own in choices for i in own],
        "goal": [np.array(place) - origin if place else np.zeros(3) for place in places],
        "points": max([*counts, 2]),
        "count": counts,
        "point": points,
        **{name: [getattr(route, name) for route in routes] for name in ("lateral_spread", "wander", "start_spread")},
        "height": -origin[2],
    }


def drawn_of(scenario: Scenario) -> dict[str, Any]:
    """Return the fields of `Drawn` by name."""
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    motions = [vehicle.motion for vehicle in scenario.vehicles]
    drawn, hard = scenario.randomisation, scenario.difficulty
    routes = scenario.routes
    following = [[followers(vehicle, route, routes) for route in routes] for vehicle in scenario.vehicles]
    counts = [len(next_ones) for of_vehicle in following for next_ones in of_vehicle]
    ends = np.cumsum([0, *counts])
    rows = np.arange(len(scenario.vehicles))[:, None] * len(routes) + np.arange(len(routes) + 1)
    return {
        "presence": [agent.presence for agent in agents],
        "any_driven": int(scenario.driven),
        "pace_spread": [agent.pace_spread for agent in agents],
        "speed_spread": [motion.initial_speed_spread if motion.kind == "driven" else 0.0 for motion in motions],
        **_groups(scenario),
        **{name: [part.factors(key)[0] for key in PARAMETERS] for name, part in (("low", drawn), ("easy", hard))},
        **{name: [part.factors(key)[1] for key in PARAMETERS] for name, part in (("high", drawn), ("hard", hard))},
        "level": scenario.difficulty.number,
        "after_arrival": int(AFTER_ARRIVAL[scenario.termination.after_arrival]),
        "next_first": ends[rows],
        "next_choice": [i for of_vehicle in following for next_ones in of_vehicle for i in next_ones],
    }


def _groups(scenario: Scenario) -> dict[str, Any]:
    origin, groups = np.array(scenario.map.origin), scenario.landmark_groups
    number = {group.name: i for i, group in enumerate(groups)}
    areas = [(group, *area) for group in groups for area in group.parallelograms]
    shares = [np.cumsum(group.weights) / np.sum(group.weights) for group in groups]
    return {
        "group": [-1 if mark.group is None else number[mark.group] for mark in scenario.landmarks],
        "first_area": np.cumsum([0, *(len(group.parallelograms) for group in groups)]),
        "area_share": np.concatenate([[], *shares]),
        "area_corner": [np.array([*corner, group.height[0]]) - origin for group, corner, _, _ in areas],
        "area_first_edge": [[*edge, 0.0] for _, _, edge, _ in areas],
        "area_second_edge": [[*edge, 0.0] for _, _, _, edge in areas],
        "height": [group.height[1] - group.height[0] for group in groups],
    }
