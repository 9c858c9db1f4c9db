"""Messages of the topics that Foxglove shows, made from the frames of a recorded drive.

Vehicles are boxes in frames of their own, which the transforms move. A vehicle without any known truth is shown at its
estimate alone.
"""

import json
from collections.abc import Callable, Iterator
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np
from foxglove import messages as fox
from matplotlib.colors import to_rgba
from PIL import Image
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.format import LogClock, View, codec, ros_definition
from coopenv.base.format import jsonable
from coopenv.estimation.poses import Array, covariance_in_map
from coopenv.observers import Run
from coopenv.observers.recording import Recording
from coopenv.scenario.bodies import Body
from coopenv.scenario.sensing import Camera
from coopenv.viz.camera_image import pixels
from coopenv.viz.scene import semi_axes
from coopenv.viz.stage import Stage, road_corners, ways
from coopenv.viz.style import DARK_BLUE, INK, vehicle_colour
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


class RunView:
    """A recording and a run of an observer on it, at the K ticks that are shown, at most 20 a second.

    A vehicle whose truth is never known has the pose of its estimate.
    """

    def __init__(self, recording: Recording, run: Run, clock: LogClock, gain: bool) -> None:
        """Take what is shown; with `gain` the observer's P is a gain matrix, and no covariance."""
        r, self.recording, self.run, self.clock, self.gain = recording, recording, run, clock, gain
        self.ticks = ticks = np.arange(0, r.ticks, max(1, round(1.0 / (_RATE * r.dt))))
        self.names = [setup.name for setup in r.setups]
        known = np.atleast_1d(r.truth.known.any(axis=0))
        self.bodies = [(name if known[i] else f"{name}/estimate", i) for i, name in enumerate(self.names)]
        """Frame and index of the true body of each vehicle with a known truth, else of its estimate."""
        self.estimate_rotation, self.estimate_position = run.rotation[ticks], run.position[ticks]
        self.rotation = np.where(known[:, None, None], r.truth.rotation[ticks], self.estimate_rotation)
        self.position = np.where(known[:, None], r.truth.position[ticks], self.estimate_position)
        pose = run.coordinates, self.estimate_rotation, self.estimate_position
        self.covariance = covariance_in_map(*pose, run.covariance[ticks])
        """(K, N, 6, 6) of position and rotation in the map."""
        self.semi, self.axes = (
            part.reshape(*self.covariance.shape[:2], *part.shape[1:])
            for part in semi_axes(self.covariance[..., :3, :3].reshape(-1, 3, 3))
        )
        """(K, N, 3) and (K, N, 3, 3) of ellipsoids of 3 sigma."""
        self.landmarks, self.visible = r.landmarks[ticks], r.visible[ticks]
        self.bearings = r.bearings[ticks]
        self.pan = np.zeros(self.position.shape[:2]) if r.pan is None else r.pan[ticks]
        self.moving_landmarks = np.flatnonzero((r.landmarks != r.landmarks[:1]).any(axis=(0, 2))).tolist()
        points = np.concatenate([r.landmarks[0], r.truth.position[0], r.start_position])
        points = points[np.isfinite(points).all(axis=1)]
        self.extent = max(1.0, float(np.ptp(points, axis=0).max()))
        """Size of the scene, m."""
        s, none = r.scenario, [None] * len(self.names)
        found = none if s is None or s.topology.mode != "sensed" else s.cameras
        self.cameras = [camera if camera is not None and camera.model == "pinhole" else None for camera in found]
        """None where a vehicle has no image."""
        self.stamps = [self.stamp(tick) for tick in ticks]

    def each(self, message: Callable[[Any, int], Any], count: int | None = None) -> Messages:
        """Yield a message, or bytes, of each tick, or of the first ones."""
        for n, tick in enumerate(self.ticks[:count].tolist()):
            found = message(self, n)
            yield tick, found if isinstance(found, bytes) else found.encode()

    def stamp(self, tick: Any) -> Any:
        """Return the time of a tick as a `foxglove.Timestamp`."""
        seconds, nanoseconds = divmod(self.clock.nanoseconds(int(tick)), 10**9)
        return fox.Timestamp(sec=seconds, nsec=nanoseconds)


def topics(view: RunView) -> list[View]:
    """Return all topics that are shown of a recording and a run."""

    def published(topic: str, kind: Any, messages: Messages) -> View:
        schema = kind.get_schema()
        return View(topic, schema.name, schema.encoding, schema.data, "protobuf", messages)

    def scene(topic: str, update: Callable[[RunView, int], Any], count: int | None = None) -> View:
        return published(topic, fox.SceneUpdate, view.each(update, count))

    found = [
        scene("/scene/world", _world, 1),
        scene("/scene/vehicles", _vehicles, 1),
        published("/tf", fox.FrameTransforms, view.each(_transforms)),
        scene("/scene/sight", _sight),
    ]
    if view.moving_landmarks:
        found.append(scene("/scene/landmarks", _moving))
    if not view.gain:
        found.append(scene("/scene/uncertainty", _uncertainty))
    for i, name in enumerate(view.names):
        found += [
            View(f"/{name}/estimate", _POSE, "ros2msg", ros_definition(_POSE), "cdr", _poses(view, i)),
            View(f"/{name}/error", _ERROR, "jsonschema", _ERROR_SCHEMA, "json", view.each(partial(_errors, vehicle=i))),
        ]
        camera = view.cameras[i]
        if camera is not None:
            found += [
                published(f"/{name}/camera/{topic}", kind, view.each(partial(message, vehicle=i, camera=camera), count))
                for topic, kind, message, count in (
                    ("calibration", fox.CameraCalibration, _calibration, 1),
                    ("image", fox.CompressedImage, _image, 1),
                    ("annotations", fox.ImageAnnotations, _annotations, None),
                )
            ]
    return found


def _world(view: RunView, n: int) -> Any:
    """Return what never moves."""
    stamp, scenario = view.stamps[n], view.recording.scenario
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
    still = set(range(view.landmarks.shape[1])) - set(view.moving_landmarks)
    return fox.SceneUpdate(entities=entities + [_landmark(view, n, i) for i in sorted(still)])


def _moving(view: RunView, n: int) -> Any:
    """Return the landmarks that move."""
    return fox.SceneUpdate(entities=[_landmark(view, n, i) for i in view.moving_landmarks])


def _landmark(view: RunView, n: int, i: int) -> Any:
    place, name = view.landmarks[n, i], view.recording.setups[0].target_names[i]
    ball = fox.SpherePrimitive(pose=_pose(place), size=_vector([_BALL * view.extent] * 3), color=_colour(DARK_BLUE))
    above = _text(name, np.add(place, (0.0, 0.0, 0.8 * _LETTERS * view.extent)), view.extent)
    return _entity(f"landmark {name}", view.stamps[n], spheres=[ball], texts=[above])


def _vehicles(view: RunView, n: int) -> Any:
    """Return the vehicles: the true ones opaque and with names, the estimated ones translucent."""
    stamp, scenario = view.stamps[n], view.recording.scenario
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


def _transforms(view: RunView, n: int) -> Any:
    """Return the frames of bodies, true and estimated, and of cameras."""
    found = []
    for parent, i in view.bodies:
        name, camera = view.names[i], view.cameras[i]
        poses = {f"{name}/estimate": (_MAP, view.estimate_rotation[n, i], view.estimate_position[n, i])}
        if parent == name:
            poses = {name: (_MAP, view.rotation[n, i], view.position[n, i]), **poses}
        if camera is not None and (n == 0 or view.recording.pan is not None):
            mounted = camera.to_body(float(view.pan[n, i]))
            poses[f"{name}/camera"] = parent, mounted, np.array(camera.position)
        for child, (frame, R, p) in poses.items():
            if np.isfinite(R).all() and np.isfinite(p).all():
                place: dict[str, Any] = {"translation": _vector(p), "rotation": _quaternion(R)}
                place |= {"parent_frame_id": frame, "child_frame_id": child}
                found.append(fox.FrameTransform(timestamp=view.stamps[n], **place))
    return fox.FrameTransforms(transforms=found)


def _sight(view: RunView, n: int) -> Any:
    """Return lines from every camera to the targets that it measures, in the colour of the vehicle."""
    stamp, R, p = view.stamps[n], view.rotation[n], view.position[n]
    lever, marker = (np.array([getattr(s, part) for s in view.recording.setups]) for part in ("lever_arm", "marker"))
    eye = p + (R @ lever[..., None])[..., 0]
    target = np.concatenate([view.landmarks[n], p + (R @ marker[..., None])[..., 0]])
    entities = []
    for i, name in enumerate(view.names):
        seen = np.flatnonzero(view.visible[n, i] & np.isfinite(eye[i]).all())
        along = eye[i] + _UNSEEN * (view.bearings[n, i] @ R[i].T)
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


def _uncertainty(view: RunView, n: int) -> Any:
    """Return ellipsoids of 3 sigma about the estimated places."""
    entities, gone, stamp, place = [], [], view.stamps[n], view.estimate_position[n]
    largest = np.where(np.isfinite(place).all(axis=-1), view.semi[n, :, -1], np.nan)
    for i, name in enumerate(view.names):
        if largest[i] < _LARGEST * view.extent:
            size = _vector(2.0 * view.semi[n, i])
            ball = fox.SpherePrimitive(pose=_pose(place[i], view.axes[n, i]), size=size, color=_of(i, 0.25))
            entities.append(_entity(f"3 sigma of {name}", stamp, spheres=[ball]))
        else:
            gone.append(fox.SceneEntityDeletion(timestamp=stamp, id=f"3 sigma of {name}"))
    return fox.SceneUpdate(entities=entities, deletions=gone)


def _poses(view: RunView, vehicle: int) -> Messages:
    """Yield a vehicle's estimate; a covariance of zeros, as ROS has it, where the observer states none."""
    store = codec()
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if "geometry_msgs" in name}
    time, header = (store.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    for n, k in enumerate(view.ticks.tolist()):
        R, p = view.estimate_rotation[n, vehicle], view.estimate_position[n, vehicle]
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            continue
        covariance = view.covariance[n, vehicle]
        stated = not view.gain and bool(np.isfinite(covariance).all())
        P = np.array(_short(covariance)).ravel() if stated else np.zeros(36)
        q = _short(Rotation.from_matrix(R).as_quat())
        place = types["Pose"](types["Point"](*_short(p)), types["Quaternion"](*q))
        stamp = time(*divmod(view.clock.nanoseconds(k), 10**9))
        message = types["PoseWithCovarianceStamped"](header(stamp, _MAP), types["PoseWithCovariance"](place, P))
        yield k, bytes(store.serialize_cdr(message, _POSE))


def _errors(view: RunView, n: int, vehicle: int) -> bytes:
    """Return a vehicle's errors as JSON; null where they are not known."""
    run, here = view.run, (view.ticks[n], vehicle)
    sigma = np.nan if view.gain else view.semi[n, vehicle, -1]
    nees = run.nees[here] if np.isfinite(sigma) else np.nan
    values = run.position_error[here], run.orientation_error[here], sigma, nees
    row = {name: float(f"{value:.6g}") for name, value in zip(_NUMBERS, values, strict=True)}
    return json.dumps(jsonable(row), separators=(",", ":")).encode()


def _calibration(view: RunView, n: int, vehicle: int, camera: Camera) -> Any:
    """Return a camera's calibration."""
    (fx, fy), (cx, cy) = camera.focal_length, camera.principal_point
    width, height = camera.image_size
    return fox.CameraCalibration(
        timestamp=view.stamps[n],
        frame_id=f"{view.names[vehicle]}/camera",
        width=int(width),
        height=int(height),
        distortion_model="plumb_bob",
        D=list(camera.distortion),
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _image(view: RunView, n: int, vehicle: int, camera: Camera) -> Any:
    """Return an empty image: a canvas for the annotations, as simulated cameras have no pixels."""
    file = BytesIO()
    Image.new("RGB", (int(camera.image_size[0]), int(camera.image_size[1])), _CANVAS).save(file, "png")
    frame = f"{view.names[vehicle]}/camera"
    return fox.CompressedImage(timestamp=view.stamps[n], frame_id=frame, data=file.getvalue(), format="png")


def _annotations(view: RunView, n: int, vehicle: int, camera: Camera) -> Any:
    """Return circles where the measured bearings hit the image, with the names of the targets."""
    names, L, stamp = view.recording.setups[vehicle].target_names, view.landmarks.shape[1], view.stamps[n]
    targets = np.flatnonzero(view.visible[n, vehicle])
    places = pixels(view.bearings[n, vehicle, targets] @ camera.to_body(float(view.pan[n, vehicle])), camera)
    circles, words = [], []
    ahead = np.isfinite(places).all(axis=1)
    for target, (x, y) in zip(targets[ahead].tolist(), places[ahead].tolist(), strict=True):
        look = _colour(DARK_BLUE) if target < L else _of(target - L)
        ring = {"diameter": _RING, "thickness": 2.0, "outline_color": look}
        circles.append(fox.CircleAnnotation(timestamp=stamp, position=fox.Point2(x=x, y=y), **ring))
        text = {"text": names[target], "font_size": _WORDS, "text_color": look}
        words.append(fox.TextAnnotation(timestamp=stamp, position=fox.Point2(x=x + _RING, y=y), **text))
    return fox.ImageAnnotations(circles=circles, texts=words)


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
