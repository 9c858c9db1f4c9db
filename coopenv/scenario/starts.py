"""Where everybody starts, and whether there is room."""

from __future__ import annotations

import warnings
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.errors import ScenarioWarning
from coopenv.scenario.bodies import Body, Landmark, Vehicle
from coopenv.scenario.fields import ScenarioFields
from coopenv.scenario.motion import path_heading

Box = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Centre (3,) m, rotation (3, 3), half size (3,) m."""


def rotation_of(yaw: float | None, quaternion_wxyz: Any) -> np.ndarray:
    """Return the rotation (3, 3) that a file gives as a quaternion or a yaw."""
    if quaternion_wxyz is not None:
        rotation = Rotation.from_quat(quaternion_wxyz, scalar_first=True)
    else:
        rotation = Rotation.from_euler("z", yaw or 0.0)
    return np.asarray(rotation.as_matrix())


def start_of(agent: Landmark | Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal start of an agent: position (3,) in the file's coordinates, rotation (3, 3)."""
    if agent.motion.kind == "waypoints":
        heading = Rotation.from_euler("z", path_heading(agent.motion)).as_matrix()
        return np.array(agent.motion.waypoints[0].position), heading
    if isinstance(agent, Landmark):
        return np.array(agent.position), rotation_of(agent.yaw, None)
    assert agent.initial_pose is not None
    pose = agent.initial_pose
    return np.array(pose.position), rotation_of(pose.yaw, pose.quaternion_wxyz)


def agent_starts(scenario: ScenarioFields) -> tuple[np.ndarray, np.ndarray]:
    """Return nominal start positions (A, 3) in the map frame and rotations (A, 3, 3), landmarks first."""
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    starts = [start_of(agent) for agent in agents]
    return np.array([p for p, _ in starts]) - np.array(scenario.map.origin), np.array([R for _, R in starts])


def box_at(body: Body | None, position: np.ndarray, rotation: np.ndarray) -> Box:
    """Return the box of a body at a pose; without a body it is a point."""
    center = np.array(body.center) if body else np.zeros(3)
    return position + rotation @ center, rotation, np.array(body.size if body else (0.0, 0.0, 0.0)) / 2


def boxes_overlap(a: Box, b: Box) -> bool:
    """Return whether two oriented boxes overlap (separating axis theorem)."""
    (ca, Ra, ha), (cb, Rb, hb) = a, b
    edges = [np.cross(Ra[:, i], Rb[:, j]) for i, j in product(range(3), range(3))]
    axes = np.array([*Ra.T, *Rb.T, *(e for e in edges if np.linalg.norm(e) > 1e-9)])
    reach = np.abs(axes @ Ra) @ ha + np.abs(axes @ Rb) @ hb
    return bool((np.abs(axes @ (cb - ca)) < reach).all())


def possible_boxes(vehicle: Vehicle) -> list[Box]:
    """Return the boxes of a vehicle at its nominal start and at the corners of its spread."""
    position, rotation = start_of(vehicle)
    pose = vehicle.initial_pose
    spread = np.array(pose.position_spread if pose else (0.0, 0.0, 0.0))
    turn = pose.yaw_spread if pose else 0.0
    boxes = [box_at(vehicle.body, position, rotation)]
    for *signs, side in product((-1, 1), repeat=4) if spread.any() or turn else ():
        turned = rotation @ Rotation.from_euler("z", side * turn).as_matrix()
        boxes.append(box_at(vehicle.body, position + rotation @ (spread * signs), turned))
    return boxes


def check_room(scenario: ScenarioFields) -> None:
    """Refuse vehicles that may start inside a building or in one another's place; warn of boxes that overlap.

    Raises:
        ValueError: names the vehicle and what it would be inside.
    """
    buildings = {
        o.name: (np.array(o.center), rotation_of(o.yaw, None), np.array(o.size) / 2) for o in scenario.obstacles
    }
    nominal: list[Box] = []
    for i, vehicle in enumerate(scenario.vehicles):
        boxes = possible_boxes(vehicle)
        for name, building in buildings.items():
            if any(boxes_overlap(box, building) for box in boxes):
                raise ValueError(f"vehicles.{i}.initial_pose: vehicle_{i + 1} starts inside obstacle '{name}'")
        for j, other in enumerate(nominal):
            where = f"vehicles.{i}.initial_pose: vehicle_{i + 1} starts in the place of vehicle_{j + 1}"
            if np.linalg.norm(start_of(vehicle)[0] - start_of(scenario.vehicles[j])[0]) < 1e-6:
                raise ValueError(where)
            if boxes_overlap(boxes[0], other):
                warnings.warn(f"{where}: their boxes overlap", ScenarioWarning, stacklevel=2)
        nominal.append(boxes[0])
