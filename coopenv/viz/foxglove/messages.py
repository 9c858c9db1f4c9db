"""Messages of the topics that Foxglove shows, made from the frames of a recorded drive.

Vehicles are boxes in frames of their own, which the transforms move. A vehicle without any known truth is shown at its
estimate alone.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import Any

import numpy as np
from foxglove import messages as fox
from matplotlib.colors import to_rgba
from PIL import Image
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.format import LogClock, View, codec, ros_definition
from coopenv.base.format import jsonable
from coopenv.estimation.outcomes import Sight
from coopenv.estimation.poses import Array, covariance_in_map
from coopenv.observers import Run
from coopenv.observers.recording import Recording
from coopenv.scenario.bodies import Body
from coopenv.scenario.sensing import Camera
from coopenv.viz.camera_image import pixels
from coopenv.viz.scene import Frame, Stage
from coopenv.viz.scene.record import frames_of
from coopenv.viz.style import DARK_BLUE, INK, vehicle_colour
from coopenv.viz.topview_geometry import road_corners, semi_axes, ways
from coopenv.viz.topview_ground import ASPHALT, ROOF

Messages = Iterator[tuple[int, bytes]]
"""(tick, encoded message)."""

_RATE = 20.0  # Hz, at most, of everything that moves
_MAP = "map"
_ROBOT = Body(size=(0.35, 0.3, 0.15), center=(0.0, 0.0, 0.08))  # of recorded robots, whose size no file has
_LETTERS = 0.02  # of the extent of the scene, height of names
_BALL = 0.012  # of the extent, diameter of a landmark
_LOW = -0.01  # m, roads lie under everything
_LARGEST = 2.0  # of the extent: wider ellipsoids would hide the scene
_UNSEEN = 5.0  # m, length of a line of sight to a target at an unknown place
_CANVAS = (236, 239, 244)  # RGB of a camera image without anything
_RING, _WORDS = 10.0, 11.0  # px
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_ERROR = "coopenv.EstimateError"
_NUMBERS = {
    "position_error_m": "norm of the difference of true and estimated position, m",
    "orientation_error_deg": "angle between true and estimated orientation, deg",
    "three_sigma_m": "three times the largest standard deviation of the position that the observer states, m",
    "nees": "e^T P^-1 e; its mean is the number of states for a consistent observer",
}
_ERROR_SCHEMA = json.dumps(
    {
        "title": _ERROR,
        "type": "object",
        "properties": {name: {"type": ["number", "null"], "description": about} for name, about in _NUMBERS.items()},
    }
).encode()


@dataclass(frozen=True)
class RunView:
    """A recording, a run of an observer on it, and their frames."""

    recording: Recording
    run: Run
    clock: LogClock
    gain: bool
    """Whether the observer's P is a gain matrix, and no covariance."""

    @cached_property
    def frames(self) -> list[Frame]:
        """Frames of the drive, at most 20 a second."""
        stride = max(1, round(1.0 / (_RATE * self.recording.dt)))
        return frames_of(self.recording, self.run, np.arange(0, self.recording.ticks, stride))

    @cached_property
    def names(self) -> list[str]:
        """Names of the vehicles."""
        return [setup.name for setup in self.recording.setups]

    @cached_property
    def bodies(self) -> list[tuple[str, int]]:
        """Frame and index of the true body of each vehicle with a known truth, else of its estimate."""
        known = np.atleast_1d(self.recording.truth.known.any(axis=0))
        return [(name if known[i] else f"{name}/estimate", i) for i, name in enumerate(self.names)]

    @cached_property
    def extent(self) -> float:
        """Size of the scene, m."""
        r = self.recording
        points = np.concatenate([r.landmarks[0], r.truth.position[0], r.start_position])
        points = points[np.isfinite(points).all(axis=1)]
        return max(1.0, float(np.ptp(points, axis=0).max()))

    @cached_property
    def moving_landmarks(self) -> list[int]:
        """Indices of the landmarks that move."""
        landmarks = self.recording.landmarks
        return [int(i) for i in np.flatnonzero((landmarks != landmarks[:1]).any(axis=(0, 2)))]

    @cached_property
    def cameras(self) -> list[Camera | None]:
        """Camera of each vehicle; None where it has no image."""
        scenario = self.recording.scenario
        if scenario is None or scenario.topology.mode != "sensed":
            return [None] * len(self.names)
        return [camera if camera.model == "pinhole" else None for camera in scenario.cameras]

    def stamp(self, tick: Any) -> Any:
        """Return the time of a tick as a `foxglove.Timestamp`."""
        seconds, nanoseconds = divmod(self.clock.nanoseconds(int(tick)), 10**9)
        return fox.Timestamp(sec=seconds, nsec=nanoseconds)


def topics(view: RunView) -> list[View]:
    """Return all topics that are shown of a recording and a run."""

    def published(topic: str, kind: Any, messages: Messages) -> View:
        schema = kind.get_schema()
        return View(topic, schema.name, schema.encoding, schema.data, "protobuf", messages)

    def scene(topic: str, update: Callable[[RunView, Frame], Any], frames: list[Frame] | None = None) -> View:
        shown = view.frames if frames is None else frames
        return published(topic, fox.SceneUpdate, ((int(f.tick), update(view, f).encode()) for f in shown))

    found = [
        scene("/scene/world", _world, view.frames[:1]),
        scene("/scene/vehicles", _vehicles, view.frames[:1]),
        published("/tf", fox.FrameTransforms, _transforms(view)),
        scene("/scene/sight", _sight),
    ]
    if view.moving_landmarks:
        found.append(scene("/scene/landmarks", _moving))
    if not view.gain:
        found.append(scene("/scene/uncertainty", _uncertainty))
    for i, name in enumerate(view.names):
        found += [
            View(f"/{name}/estimate", _POSE, "ros2msg", ros_definition(_POSE), "cdr", _poses(view, i)),
            View(f"/{name}/error", _ERROR, "jsonschema", _ERROR_SCHEMA, "json", _errors(view, i)),
        ]
        camera = view.cameras[i]
        if camera is not None:
            found += [
                published(f"/{name}/camera/calibration", fox.CameraCalibration, _calibration(view, i, camera)),
                published(f"/{name}/camera/image", fox.CompressedImage, _image(view, i, camera)),
                published(f"/{name}/camera/annotations", fox.ImageAnnotations, _annotations(view, i, camera)),
            ]
    return found


def _world(view: RunView, frame: Frame) -> Any:
    """Return what never moves."""
    stamp, scenario = view.stamp(frame.tick), view.recording.scenario
    entities = []
    if scenario is not None:
        stage = Stage(scenario)
        roads = [road_corners(road.start, road.end, road.width) - stage.origin[:2] for road in scenario.roads]
        points = [_point([*c, _LOW]) for corners in roads for c in corners[[0, 1, 2, 0, 2, 3]]]
        if points:
            ground = fox.TriangleListPrimitive(pose=_pose(), points=points, color=_colour(ASPHALT))
            entities.append(_entity("roads", stamp, triangles=[ground]))
        for building in stage.buildings:
            place = _pose(building.center, building.rotation)
            box = fox.CubePrimitive(pose=place, size=_vector(building.size), color=_colour(ROOF, 0.6))
            entities.append(_entity(f"building {building.name}", stamp, cubes=[box]))
    still = set(range(frame.landmarks)) - set(view.moving_landmarks)
    return fox.SceneUpdate(entities=entities + [_landmark(view, frame, i) for i in sorted(still)])


def _moving(view: RunView, frame: Frame) -> Any:
    """Return the landmarks that move."""
    return fox.SceneUpdate(entities=[_landmark(view, frame, i) for i in view.moving_landmarks])


def _landmark(view: RunView, frame: Frame, i: int) -> Any:
    place, name = frame.position[i], view.recording.setups[0].target_names[i]
    ball = fox.SpherePrimitive(pose=_pose(place), size=_vector([_BALL * view.extent] * 3), color=_colour(DARK_BLUE))
    above = _text(name, np.add(place, (0.0, 0.0, 0.8 * _LETTERS * view.extent)), view.extent)
    return _entity(f"landmark {name}", view.stamp(frame.tick), spheres=[ball], texts=[above])


def _vehicles(view: RunView, frame: Frame) -> Any:
    """Return the vehicles: the true ones opaque and with names, the estimated ones translucent."""
    stamp, scenario = view.stamp(frame.tick), view.recording.scenario
    angles = np.zeros(len(view.names)) if scenario is None else ways(scenario)
    entities = []
    for shown, i in view.bodies:
        name = view.names[i]
        body = (scenario.vehicles[i].body if scenario is not None else None) or _ROBOT
        turned = Rotation.from_euler("z", angles[i]).as_matrix()
        front = np.array(body.center) + turned @ [0.32 * body.size[0], 0.0, 0.5 * body.size[2]]
        nose = fox.CubePrimitive(
            pose=_pose(front, turned), size=_vector(np.array(body.size) * [0.25, 0.6, 0.3]), color=_colour("white", 0.9)
        )
        above = _text(name, [0.0, 0.0, body.size[2] + _LETTERS * view.extent], view.extent)
        looks = {name: ("", 1.0)} if shown == name else {}
        for parent, (kind, alpha) in {**looks, f"{name}/estimate": (" estimate", 0.35)}.items():
            box = fox.CubePrimitive(pose=_pose(body.center, turned), size=_vector(body.size), color=_of(i, alpha))
            named = [above] if parent == shown else []
            parts = {"cubes": [box, nose], "texts": named, "frame_locked": True}
            entities.append(_entity(f"{name}{kind}", stamp, parent, **parts))
    return fox.SceneUpdate(entities=entities)


def _transforms(view: RunView) -> Messages:
    """Yield the frames of bodies, true and estimated, and of cameras."""
    for frame in view.frames:
        found = []
        stamp, true = view.stamp(frame.tick), (frame.vehicle_rotation, frame.vehicle_position)
        for parent, i in view.bodies:
            name, camera = view.names[i], view.cameras[i]
            if parent == name:
                found += _transform(stamp, _MAP, name, true[0][i], true[1][i])
            found += _transform(stamp, _MAP, f"{name}/estimate", frame.estimate_rotation[i], frame.estimate_position[i])
            if camera is not None and (frame.tick == 0 or view.recording.pan is not None):
                mounted = camera.to_body(float(frame.pan[i]))
                found += _transform(stamp, parent, f"{name}/camera", mounted, np.array(camera.position))
        yield int(frame.tick), fox.FrameTransforms(transforms=found).encode()


def _transform(stamp: Any, parent: str, child: str, rotation: Array, place: Array) -> list[Any]:
    if not (np.isfinite(rotation).all() and np.isfinite(place).all()):
        return []
    turned, moved = _quaternion(rotation), _vector(place)
    names = {"parent_frame_id": parent, "child_frame_id": child}
    return [fox.FrameTransform(timestamp=stamp, translation=moved, rotation=turned, **names)]


def _sight(view: RunView, frame: Frame) -> Any:
    """Return lines from every camera to the targets that it measures, in the colour of the vehicle."""
    r, stamp = view.recording, view.stamp(frame.tick)
    R, p = frame.vehicle_rotation, frame.vehicle_position
    lever, marker = (np.array([getattr(s, part) for s in r.setups]) for part in ("lever_arm", "marker"))
    eye = p + (R @ lever[..., None])[..., 0]
    target = np.concatenate([frame.position[: frame.landmarks], p + (R @ marker[..., None])[..., 0]])
    entities = []
    for i, name in enumerate(view.names):
        seen = np.flatnonzero((frame.sight[i] == Sight.VISIBLE) & np.isfinite(eye[i]).all())
        along = eye[i] + _UNSEEN * (r.bearings[int(frame.tick), i] @ R[i].T)
        ends = [p for j in seen for p in (eye[i], target[j] if np.isfinite(target[j]).all() else along[j])]
        lines = fox.LinePrimitive(
            type=fox.LinePrimitiveLineType.LineList,
            pose=_pose(),
            thickness=1.5,
            scale_invariant=True,
            points=[_point(end) for end in ends],
            color=_of(i, 0.8),
        )
        entities.append(_entity(f"sight of {name}", stamp, lines=[lines] if ends else []))
    return fox.SceneUpdate(entities=entities)


def _uncertainty(view: RunView, frame: Frame) -> Any:
    """Return ellipsoids of 3 sigma about the estimated places."""
    entities, gone, stamp = [], [], view.stamp(frame.tick)
    half, axes = semi_axes(frame.position_covariance)
    largest = np.where(np.isfinite(frame.estimate_position).all(axis=-1), half[:, -1], np.nan)
    for i, name in enumerate(view.names):
        if largest[i] < _LARGEST * view.extent:
            place = _pose(frame.estimate_position[i], axes[i])
            ball = fox.SpherePrimitive(pose=place, size=_vector(2.0 * half[i]), color=_of(i, 0.25))
            entities.append(_entity(f"3 sigma of {name}", stamp, spheres=[ball]))
        else:
            gone.append(fox.SceneEntityDeletion(timestamp=stamp, id=f"3 sigma of {name}"))
    return fox.SceneUpdate(entities=entities, deletions=gone)


def _poses(view: RunView, vehicle: int) -> Messages:
    """Yield a vehicle's estimate; a covariance of zeros, as ROS has it, where the observer states none."""
    store, run = codec(), view.run
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if "geometry_msgs" in name}
    time, header = (store.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    for frame in view.frames:
        k, R, p = int(frame.tick), frame.estimate_rotation[vehicle], frame.estimate_position[vehicle]
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            continue
        covariance = covariance_in_map(run.coordinates, R, p, run.covariance[k, vehicle])
        stated = not view.gain and bool(np.isfinite(covariance).all())
        P = np.array(_short(covariance)).ravel() if stated else np.zeros(36)
        q = _short(Rotation.from_matrix(R).as_quat())
        place = types["Pose"](types["Point"](*_short(p)), types["Quaternion"](*q))
        stamp = time(*divmod(view.clock.nanoseconds(k), 10**9))
        message = types["PoseWithCovarianceStamped"](header(stamp, _MAP), types["PoseWithCovariance"](place, P))
        yield k, bytes(store.serialize_cdr(message, _POSE))


def _errors(view: RunView, vehicle: int) -> Messages:
    """Yield a vehicle's errors as JSON; null where they are not known."""
    for frame in view.frames:
        sigma = np.nan if view.gain else semi_axes(frame.position_covariance[[vehicle]])[0][0, -1]
        nees = frame.nees[vehicle] if np.isfinite(sigma) else np.nan
        values = frame.position_error[vehicle], frame.orientation_error[vehicle], sigma, nees
        row = {name: float(f"{value:.6g}") for name, value in zip(_NUMBERS, values, strict=True)}
        yield int(frame.tick), json.dumps(jsonable(row), separators=(",", ":")).encode()


def _calibration(view: RunView, vehicle: int, camera: Camera) -> Messages:
    """Yield a camera's calibration, once."""
    (fx, fy), (cx, cy) = camera.focal_length, camera.principal_point
    width, height = camera.image_size
    yield (
        0,
        fox.CameraCalibration(
            timestamp=view.stamp(0),
            frame_id=f"{view.names[vehicle]}/camera",
            width=int(width),
            height=int(height),
            distortion_model="plumb_bob",
            D=list(camera.distortion),
            K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ).encode(),
    )


def _image(view: RunView, vehicle: int, camera: Camera) -> Messages:
    """Yield an empty image, once: a canvas for the annotations, as simulated cameras have no pixels."""
    file = BytesIO()
    Image.new("RGB", (int(camera.image_size[0]), int(camera.image_size[1])), _CANVAS).save(file, "png")
    frame = f"{view.names[vehicle]}/camera"
    yield 0, fox.CompressedImage(timestamp=view.stamp(0), frame_id=frame, data=file.getvalue(), format="png").encode()


def _annotations(view: RunView, vehicle: int, camera: Camera) -> Messages:
    """Yield circles where the measured bearings hit the image, with the names of the targets."""
    r = view.recording
    names, L = r.setups[vehicle].target_names, r.landmarks.shape[1]
    for frame in view.frames:
        stamp, targets = view.stamp(frame.tick), np.flatnonzero(frame.sight[vehicle] == Sight.VISIBLE)
        rays = r.bearings[int(frame.tick), vehicle, targets] @ camera.to_body(float(frame.pan[vehicle]))
        places = pixels(rays, camera)
        circles, words = [], []
        ahead = np.isfinite(places).all(axis=1)
        for target, (x, y) in zip(targets[ahead].tolist(), places[ahead].tolist(), strict=True):
            look = _colour(DARK_BLUE) if target < L else _of(target - L)
            ring = {"diameter": _RING, "thickness": 2.0, "outline_color": look}
            circles.append(fox.CircleAnnotation(timestamp=stamp, position=fox.Point2(x=x, y=y), **ring))
            text = {"text": names[target], "font_size": _WORDS, "text_color": look}
            words.append(fox.TextAnnotation(timestamp=stamp, position=fox.Point2(x=x + _RING, y=y), **text))
        yield int(frame.tick), fox.ImageAnnotations(circles=circles, texts=words).encode()


def _entity(name: str, stamp: Any, frame: str = _MAP, **parts: Any) -> Any:
    return fox.SceneEntity(timestamp=stamp, frame_id=frame, id=name, **parts)


def _text(words: str, place: Any, size: float) -> Any:
    """Return words that face the viewer."""
    look = {"font_size": _LETTERS * size, "color": _colour(INK), "text": words}
    return fox.TextPrimitive(pose=_pose(place), billboard=True, **look)


def _short(values: Any) -> list[float]:
    """Return numbers in single precision, which keeps files small."""
    return list(np.asarray(values, np.float32).astype(float).tolist())


def _vector(values: Any) -> Any:
    x, y, z = _short(values)
    return fox.Vector3(x=x, y=y, z=z)


def _point(values: Any) -> Any:
    x, y, z = _short(values)
    return fox.Point3(x=x, y=y, z=z)


def _quaternion(rotation: Array) -> Any:
    x, y, z, w = _short(Rotation.from_matrix(rotation).as_quat())
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def _pose(position: Any = (0.0, 0.0, 0.0), rotation: Array | None = None) -> Any:
    return fox.Pose(position=_vector(position), orientation=_quaternion(np.eye(3) if rotation is None else rotation))


def _colour(name: str, alpha: float = 1.0) -> Any:
    r, g, b, _ = to_rgba(name)
    return fox.Color(r=r, g=g, b=b, a=alpha)


def _of(vehicle: int, alpha: float = 1.0) -> Any:
    """Return the colour of a vehicle, the same as in figures."""
    return _colour(vehicle_colour(vehicle), alpha)
