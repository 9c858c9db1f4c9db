"""What stands in the scene once and for all: ground, buildings, landmarks that do not move, and the vehicles.

Vehicles are boxes in frames of their own, which the transforms move.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from foxglove import messages as fox
from matplotlib.colors import to_rgba
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.format import Clock
from coopenv.estimation.poses import Array, covariance_in_map
from coopenv.observers import Run
from coopenv.observers.recording import Recording
from coopenv.scenario.bodies import Body
from coopenv.scenario.sensing import Camera
from coopenv.viz.style import DARK_BLUE, INK, vehicle_colour
from coopenv.viz.topview_geometry import SIGMAS, road_corners, ways
from coopenv.viz.topview_ground import ASPHALT, ROOF

RATE = 20.0
"""Hz, at most, of everything that moves."""
MAP = "map"
_ROBOT = Body(size=(0.35, 0.3, 0.15), center=(0.0, 0.0, 0.08))  # of recorded robots, whose size no file tells


@dataclass(frozen=True)
class Shown:
    """A recording, an observer's run on it, and when it was."""

    recording: Recording
    run: Run
    clock: Clock
    gain: bool
    """Whether the observer's P is a gain matrix, and no covariance."""

    @cached_property
    def ticks(self) -> list[int]:
        """The ticks that are shown."""
        stride = max(1, round(1.0 / (RATE * self.recording.dt)))
        return list(range(0, self.recording.ticks, stride))

    @cached_property
    def names(self) -> list[str]:
        """Of the vehicles."""
        return [setup.name for setup in self.recording.setups]

    def stamp(self, tick: int) -> Any:
        """Return the time of a tick."""
        seconds, nanoseconds = divmod(self.clock.nanoseconds(tick), 10**9)
        return fox.Timestamp(sec=seconds, nsec=nanoseconds)

    def frame(self, vehicle: int) -> str:
        """Return the frame of a vehicle's true body, or of its estimate where no truth is known."""
        return self.names[vehicle] if self._true[vehicle] else self.estimate_frame(vehicle)

    @cached_property
    def _true(self) -> list[bool]:
        """Whether the truth of each vehicle is known at some tick."""
        return [bool(known) for known in np.atleast_1d(self.recording.truth.known.any(axis=0))]

    def estimate_frame(self, vehicle: int) -> str:
        """Return the frame of a vehicle's estimated body."""
        return f"{self.names[vehicle]}/estimate"

    def pose(self, k: int, vehicle: int) -> tuple[Array, Array] | None:
        """Return rotation and position of a vehicle: the truth, or the estimate where there is no truth at all."""
        truth, run = self.recording.truth, self.run
        true = self.frame(vehicle) == self.names[vehicle]
        source = (truth.rotation, truth.position) if true else (run.rotation, run.position)
        R, p = source[0][k, vehicle], source[1][k, vehicle]
        return (R, p) if np.isfinite(R).all() and np.isfinite(p).all() else None

    def body(self, vehicle: int) -> Body:
        """Return the box that stands for a vehicle."""
        scenario = self.recording.scenario
        return (scenario.vehicles[vehicle].body if scenario is not None else None) or _ROBOT

    def camera(self, vehicle: int) -> Camera | None:
        """Return a vehicle's camera, None where it has no image."""
        return self._cameras[vehicle]

    @cached_property
    def _cameras(self) -> list[Camera | None]:
        scenario = self.recording.scenario
        if scenario is None or scenario.topology.mode != "sensed":
            return [None] * len(self.names)
        return [camera if camera.model == "pinhole" else None for camera in scenario.cameras]

    def optical(self, k: int, vehicle: int) -> Array:
        """Return the rotation (3, 3) of a vehicle's optical frame to its body at a tick."""
        camera = self.camera(vehicle)
        assert camera is not None
        return camera.to_body(0.0 if self.recording.pan is None else float(self.recording.pan[k, vehicle]))


def short(values: Any) -> list[float]:
    """Return numbers in single precision: enough to look at, and files stay small."""
    return list(np.asarray(values, np.float32).astype(float).tolist())


def vector(values: Any) -> Any:
    """Return a `foxglove.Vector3`."""
    x, y, z = short(values)
    return fox.Vector3(x=x, y=y, z=z)


def point(values: Any) -> Any:
    """Return a `foxglove.Point3`."""
    x, y, z = short(values)
    return fox.Point3(x=x, y=y, z=z)


def quaternion(rotation: Array) -> Any:
    """Return the `foxglove.Quaternion` of a rotation matrix."""
    x, y, z, w = short(Rotation.from_matrix(rotation).as_quat())
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Any = (0.0, 0.0, 0.0), rotation: Array | None = None) -> Any:
    """Return a `foxglove.Pose`."""
    return fox.Pose(position=vector(position), orientation=quaternion(np.eye(3) if rotation is None else rotation))


def colour(name: str, alpha: float = 1.0) -> Any:
    """Return a `foxglove.Color`."""
    r, g, b, _ = to_rgba(name)
    return fox.Color(r=r, g=g, b=b, a=alpha)


def colour_of(vehicle: int, alpha: float = 1.0) -> Any:
    """Return the colour of a vehicle, the same as in figures."""
    return colour(vehicle_colour(vehicle), alpha)


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


_LARGEST = 2.0  # of the scene's extent: wider ellipsoids would hide it
_UNSEEN = 5.0  # m, length of a line to a target whose place is not known


def transforms(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield the frames of bodies, true and estimated, and of cameras."""
    r, run = shown.recording, shown.run
    for k in shown.ticks:
        found = []
        for i, name in enumerate(shown.names):
            found += _frame(shown, k, MAP, name, r.truth.rotation[k, i], r.truth.position[k, i])
            found += _frame(shown, k, MAP, shown.estimate_frame(i), run.rotation[k, i], run.position[k, i])
            camera = shown.camera(i)
            if camera is not None and (k == 0 or r.pan is not None):
                place = np.array(camera.position)
                found += _frame(shown, k, shown.frame(i), f"{name}/camera", shown.optical(k, i), place)
        yield k, fox.FrameTransforms(transforms=found).encode()


def _frame(shown: Shown, k: int, parent: str, child: str, rotation: Array, place: Array) -> list[Any]:
    if not (np.isfinite(rotation).all() and np.isfinite(place).all()):
        return []
    turned, moved = quaternion(rotation), vector(place)
    names = {"parent_frame_id": parent, "child_frame_id": child}
    return [fox.FrameTransform(timestamp=shown.stamp(k), translation=moved, rotation=turned, **names)]


def sight(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield lines from every camera to the targets that it sees, in the colour of the vehicle."""
    for k in shown.ticks:
        entities = []
        for i, name in enumerate(shown.names):
            ends = _lines(shown, k, i)
            lines = fox.LinePrimitive(
                type=fox.LinePrimitiveLineType.LineList,
                pose=pose(),
                thickness=1.5,
                scale_invariant=True,
                points=[point(end) for end in ends],
                color=colour_of(i, 0.8),
            )
            named = {"timestamp": shown.stamp(k), "frame_id": MAP, "id": f"sight of {name}"}
            entities.append(fox.SceneEntity(lines=[lines] if len(ends) else [], **named))
        yield k, fox.SceneUpdate(entities=entities).encode()


def _lines(shown: Shown, k: int, i: int) -> Array:
    """Return the ends (2m, 3) of the lines of sight of one vehicle, m."""
    here, r = shown.pose(k, i), shown.recording
    if here is None:
        return np.empty((0, 3))
    R, p = here
    origin = p + R @ r.setups[i].lever_arm
    ends = []
    for target in np.flatnonzero(r.visible[k, i]):
        place = _place(shown, k, int(target))
        if place is None:
            place = origin + _UNSEEN * (R @ r.bearings[k, i, target])
        ends += [origin, place]
    return np.array(ends).reshape(-1, 3)


def _place(shown: Shown, k: int, target: int) -> Array | None:
    """Return where a target's marker is, m, None where nobody knows."""
    r, L = shown.recording, shown.recording.landmarks.shape[1]
    if target < L:
        return np.asarray(r.landmarks[k, target])
    there = shown.pose(k, target - L)
    return None if there is None else there[1] + there[0] @ r.setups[target - L].marker


def landmarks(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield the landmarks that move."""
    moving = moving_landmarks(shown).tolist()
    for k in shown.ticks if moving else ():
        yield k, fox.SceneUpdate(entities=[landmark(shown, k, i) for i in moving]).encode()


def uncertainty(shown: Shown, size: float) -> Iterator[tuple[int, bytes]]:
    """Yield ellipsoids of 3 sigma about the estimated places; `size` is the scene's extent, m."""
    run = shown.run
    P = covariance_in_map(run.coordinates, run.rotation, run.position, run.covariance)[..., :3, :3]
    for k in shown.ticks:
        entities, gone = [], []
        for i, name in enumerate(shown.names):
            half, axes = ellipsoid(P[k, i])
            if not (np.isfinite(run.position[k, i]).all() and np.isfinite(half).all() and half.max() < _LARGEST * size):
                gone.append(fox.SceneEntityDeletion(timestamp=shown.stamp(k), id=f"3 sigma of {name}"))
                continue
            place = pose(run.position[k, i], axes)
            ball = fox.SpherePrimitive(pose=place, size=vector(2.0 * half), color=colour_of(i, 0.25))
            named = {"timestamp": shown.stamp(k), "frame_id": MAP, "id": f"3 sigma of {name}"}
            entities.append(fox.SceneEntity(spheres=[ball], **named))
        yield k, fox.SceneUpdate(entities=entities, deletions=gone).encode()


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Return half lengths (3,) of 3 sigma, m, and axes (3, 3), a rotation, of a covariance (3, 3); NaN: it is none."""
    if not np.isfinite(covariance).all():
        return np.full(3, np.nan), np.eye(3)
    variance, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return np.where(variance >= 0, SIGMAS * np.sqrt(np.maximum(variance, 0.0)), np.nan), axes
