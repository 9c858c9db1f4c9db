"""What stands in the scene once and for all: ground, buildings, landmarks that do not move, and the vehicles.

Vehicles are boxes in frames of their own, which the transforms move.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove import messages as fox
from scipy.spatial.transform import Rotation

from coopenv.viz.foxglove.shown import MAP, Shown, colour, colour_of, point, pose, vector
from coopenv.viz.style import DARK_BLUE, INK
from coopenv.viz.topview_geometry import road_corners, ways
from coopenv.viz.topview_ground import ASPHALT, ROOF

_LETTERS = 0.02  # of the extent of the scene, height of names
_BALL = 0.012  # of the extent, diameter of a landmark
_LOW = -0.01  # m, roads lie under everything


def extent(shown: Shown) -> float:
    """Return the size of the scene, m."""
    r = shown.recording
    points = np.concatenate([r.landmarks[0], r.truth.position[0], r.start_position])
    points = points[np.isfinite(points).all(axis=1)]
    return max(1.0, float(np.ptp(points, axis=0).max()))


def moving_landmarks(shown: Shown) -> np.ndarray:
    """Return which landmarks move, as indices."""
    landmarks = shown.recording.landmarks
    return np.flatnonzero((landmarks != landmarks[:1]).any(axis=(0, 2)))


def world(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield what never moves, once."""
    stamp, scenario = shown.stamp(0), shown.recording.scenario
    entities = []
    if scenario is not None:
        origin = np.array(scenario.map.origin)
        roads = [np.append(c, _LOW) for road in scenario.roads for c in _strip(road, origin)]
        if roads:
            ground = fox.TriangleListPrimitive(pose=pose(), points=[point(p) for p in roads], color=colour(ASPHALT))
            entities.append(_entity("roads", stamp, triangles=[ground]))
        for building in scenario.obstacles:
            turned = Rotation.from_euler("z", building.yaw).as_matrix()
            place = pose(np.array(building.center) - origin, turned)
            box = fox.CubePrimitive(pose=place, size=vector(building.size), color=colour(ROOF, 0.6))
            entities.append(_entity(f"building {building.name}", stamp, cubes=[box]))
    still = np.setdiff1d(np.arange(shown.recording.landmarks.shape[1]), moving_landmarks(shown))
    entities += [landmark(shown, 0, int(i)) for i in still]
    yield 0, fox.SceneUpdate(entities=entities).encode()


def landmark(shown: Shown, k: int, i: int) -> Any:
    """Return a landmark at a tick, with its name."""
    place, size = shown.recording.landmarks[k, i], extent(shown)
    name = shown.recording.setups[0].target_names[i]
    ball = fox.SpherePrimitive(pose=pose(place), size=vector([_BALL * size] * 3), color=colour(DARK_BLUE))
    above = text(name, np.add(place, (0.0, 0.0, 0.8 * _LETTERS * size)), size)
    return _entity(f"landmark {name}", shown.stamp(k), spheres=[ball], texts=[above])


def text(words: str, place: Any, size: float) -> Any:
    """Return words that face whoever looks."""
    return fox.TextPrimitive(pose=pose(place), billboard=True, font_size=_LETTERS * size, color=colour(INK), text=words)


def vehicles(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield the vehicles, once: the true ones opaque and with names, the estimated ones translucent."""
    stamp, size, scenario = shown.stamp(0), extent(shown), shown.recording.scenario
    way = np.zeros(len(shown.names)) if scenario is None else ways(scenario)
    entities = []
    for i, name in enumerate(shown.names):
        body = shown.body(i)
        turned = Rotation.from_euler("z", way[i]).as_matrix()
        front = np.array(body.center) + turned @ [0.32 * body.size[0], 0.0, 0.5 * body.size[2]]
        nose = fox.CubePrimitive(
            pose=pose(front, turned), size=vector(np.array(body.size) * [0.25, 0.6, 0.3]), color=colour("white", 0.9)
        )
        above = text(name, [0.0, 0.0, body.size[2] + _LETTERS * size], size)
        for kind, frame, alpha in (("", shown.names[i], 1.0), (" estimate", shown.estimate_frame(i), 0.35)):
            if kind == "" and shown.frame(i) != frame:
                continue  # no truth is known
            box = fox.CubePrimitive(pose=pose(body.center, turned), size=vector(body.size), color=colour_of(i, alpha))
            words = [above] if frame == shown.frame(i) else []
            entities.append(_entity(f"{name}{kind}", stamp, frame, cubes=[box, nose], texts=words, frame_locked=True))
    yield 0, fox.SceneUpdate(entities=entities).encode()


def _entity(name: str, stamp: Any, frame: str = MAP, **parts: Any) -> Any:
    return fox.SceneEntity(timestamp=stamp, frame_id=frame, id=name, **parts)


def _strip(road: Any, origin: np.ndarray) -> np.ndarray:
    """Return the corners (6, 2) of the two triangles of a road."""
    corners = road_corners(road.start, road.end, road.width) - origin[:2]
    return np.asarray(corners[[0, 1, 2, 0, 2, 3]])
