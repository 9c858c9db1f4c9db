"""An open crossing whose landmarks lie beside the straight-ahead view but within reach: looking around pays."""

from __future__ import annotations

import math
from typing import Any

from coopenv.scenario import Scenario, parse_scenario

CORNERS = ((3.8, 3.9), (5.5, 3.9), (7.5, 3.9), (3.9, 5.5), (3.9, 7.5))
CARS = ((-5.5, -0.5, 0.0), (0.5, -5.0, 90.0), (4.5, 0.5, 180.0), (-0.5, 4.0, -90.0))
CAR = {
    "body": {"size": [0.586, 0.25, 0.25], "center": [0.16, 0.0, 0.125]},
    "marker": [0.16, 0.0, 0.25],
    "motion": {"kind": "driven", "initial_speed": 0.4},
    "initial_estimate": {"position_radius": 0.3, "orientation_angle": 0.15},
}
GROUPS = ("estimate", "odometry", "messages", "goal", "quality", "uncertainty", "map", "route", "self")


def square(**sections: Any) -> Scenario:
    """Return the crossing; `sections` replace whole sections of its data."""
    places = [(sx * x, sy * y) for sx in (1, -1) for sy in (1, -1) for x, y in CORNERS]
    cars = []
    for x, y, angle in CARS:
        yaw = math.radians(angle)
        goal = [x + 10.5 * round(math.cos(yaw)), y + 10.0 * round(math.sin(yaw)), 0.0]
        start = {"position": [x, y, 0.0], "yaw": yaw, "position_spread": [0.6, 0.1, 0.0], "yaw_spread": 0.05}
        cars.append({**CAR, "initial_pose": start, "goal": {"position": goal, "radius": 0.5}})
    data: dict[str, Any] = {
        "title": "Square",
        "horizon": 30.0,
        "rates": {"camera": 60.0, "odometry": 100.0, "decision": 10.0},
        "camera": {
            "model": "pinhole",
            "image_size": [316, 208],
            "focal_length": [213.16, 213.52],
            "principal_point": [154.84, 114.98],
            "position": [0.3218, 0.0, 0.2233],
            "orientation": "forward",
            "range": 6.0,
        },
        "noise": {
            "velocity": 0.05,
            "angular_velocity": 0.02,
            "odometry_rate": 100.0,
            "bearing": {"model": "isotropic", "scale": 0.003, "rate": "sample"},
        },
        "topology": {"mode": "sensed"},
        "v2x": {"delay": 1, "staleness": 0.5},
        "observer": {"name": "robust"},
        "dynamics": {"max_speed": 1.0},
        "action": {"longitudinal": "speed", "steering": 0.5236},
        "observation": {"include": GROUPS, "position_scale": 8.0},
        "landmarks": [
            {"name": f"L{k + 1}", "position": [x, y, 0.4 + 0.1 * (k % 4)]} for k, (x, y) in enumerate(places)
        ],
        "vehicles": cars,
    }
    return parse_scenario({**data, **sections}, "square")
