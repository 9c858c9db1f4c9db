"""Messages of the topics that Foxglove shows, made of an episode with its recording.

Vehicles are boxes in frames of their own, which the transforms move. A vehicle without any known truth is shown at its
estimate alone.
"""

import json
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any

import numpy as np
from foxglove import messages as fox
from matplotlib.colors import to_rgba
from PIL import Image
from scipy.spatial.transform import Rotation

from coopenv.base.format import jsonable
from coopenv.episode import Episode, semi_axes
from coopenv.estimation.poses import Array, Coordinates, covariance_in_map
from coopenv.scenario.bodies import Body
from coopenv.sources.mcap_format import LogClock, View, codec, ros_definition
from coopenv.viz.perspective import pixels
from coopenv.viz.stage import Stage, roads, ways
from coopenv.viz.style import DARK_BLUE, INK, vehicle_colour
from coopenv.viz.topview_ground import ASPHALT, ROOF

Messages = Iterator[tuple[int, bytes]]
"""(tick, encoded message)."""

_RATE = 20.0  # Hz, at most, of everything that moves
_MAP, _UPRIGHT = "map", np.eye(3)
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
    "protection_level_m": "bound of the horizontal error that the observer states, m",
    "protection_level_deg": "bound of the angle that the observer states, deg",
    "nees": "e^T P^-1 e; its mean is the number of states for a consistent observer",
}
_ERROR_SCHEMA = json.dumps(
    {
        "title": _ERROR,
        "type": "object",
        "properties": {name: {"type": ["number", "null"], "description": about} for name, about in _NUMBERS.items()},
    }
).encode()


class LogView:
    """An episode with its recording, as a log shows it.

    A vehicle whose truth is never known has the pose of its estimate.
    """

    def __init__(self, episode: Episode, clock: LogClock) -> None:
        """Set the source. Raises CoopenvError: the episode has no recording."""
        r = self.recording = episode.measured
        self.clock, self.gain = clock, not episode.source.honest
        e = self.estimates = episode.trajectory
        self.ticks = range(0, r.ticks, max(1, round(1.0 / (_RATE * r.dt))))
        """Ticks to show, at most 20 a second."""
        self.names = [setup.name for setup in r.setups]
        known = np.atleast_1d(r.truth.known.any(axis=0))
        self.bodies = [(name if known[i] else f"{name}/estimate", i) for i, name in enumerate(self.names)]
        """Frame and index of the true body of each vehicle with a known truth, else of its estimate."""
        self.rotation = np.where(known[:, None, None], r.truth.rotation, e.rotation_estimate)
        self.position = np.where(known[:, None], r.truth.position, e.position_estimate)
        pose = e.rotation_estimate, e.position_estimate
        self.covariance = covariance_in_map(Coordinates.RICCATI, *pose, e.covariance)
        """(K, N, 6, 6) of position and rotation in the map."""
        self.semi, self.axes = semi_axes(self.covariance[..., :3, :3])
        """(K, N, 3) and (K, N, 3, 3) of ellipsoids of 3 sigma."""
        self.pan = r.filled("pan")
        self.moving_landmarks = np.flatnonzero((r.landmarks != r.landmarks[:1]).any(axis=(0, 2))).tolist()
        points = np.concatenate([r.landmarks[0], r.truth.position[0], r.start_position])
        points = points[np.isfinite(points).all(axis=1)]
        self.extent = max(1.0, float(np.ptp(points, axis=0).max()))
        """Size of the scene, m."""
        s = r.scenario
        sensed = s is not None and s.topology.mode == "sensed"
        self.cameras = {i: c for i, c in enumerate(s.cameras) if c.model == "pinhole"} if s and sensed else {}
        """Cameras with an image, by index of the vehicle."""

    def stamp(self, tick: int) -> Any:
        """Return the time of a tick as a `foxglove.Timestamp`."""
        seconds, nanoseconds = divmod(self.clock.nanoseconds(tick), 10**9)
        return fox.Timestamp(sec=seconds, nsec=nanoseconds)


def topics(view: LogView) -> list[View]:
    """Return all topics that are shown of an episode."""
    found = []

    def add(topic: str, kind: Any, message: Callable[..., Any], *given: Any, once: bool = False) -> None:
        """Add a topic of one of Foxglove's types; a function makes its messages of the view and a tick."""
        ticks, schema = view.ticks[:1] if once else view.ticks, kind.get_schema()
        messages = ((k, message(view, k, *given).encode()) for k in ticks)
        found.append(View(topic, schema.name, schema.encoding, schema.data, "protobuf", messages))

    add("/scene/world", fox.SceneUpdate, _world, once=True)
    add("/scene/vehicles", fox.SceneUpdate, _vehicles, once=True)
    add("/tf", fox.FrameTransforms, _transforms)
    add("/scene/sight", fox.SceneUpdate, _sight)
    if view.recording.readings:
        add("/scene/readings", fox.SceneUpdate, _readings)
    if view.moving_landmarks:
        add("/scene/landmarks", fox.SceneUpdate, _moving)
    if not view.gain:
        add("/scene/uncertainty", fox.SceneUpdate, _uncertainty)
    for i, name in enumerate(view.names):
        found += [
            View(f"/{name}/estimate", _POSE, "ros2msg", ros_definition(_POSE), "cdr", _poses(view, i)),
            View(f"/{name}/error", _ERROR, "jsonschema", _ERROR_SCHEMA, "json", _errors(view, i)),
        ]
        if i in view.cameras:
            add(f"/{name}/camera/calibration", fox.CameraCalibration, _calibration, i, once=True)
            add(f"/{name}/camera/image", fox.CompressedImage, _image, i, once=True)
            add(f"/{name}/camera/annotations", fox.ImageAnnotations, _annotations, i)
    return found


def _world(view: LogView, k: int) -> Any:
    """Return the static scene."""
    scenario, entities = view.recording.scenario, []
    if scenario is not None:
        stage = Stage(scenario)
        points = [_xyz(fox.Point3, [*c, _LOW]) for corners in roads(scenario) for c in corners[[0, 1, 2, 0, 2, 3]]]
        if points:
            ground = fox.TriangleListPrimitive(pose=_pose(), points=points, color=_colour(ASPHALT))
            entities.append(_entity(view, k, "roads", triangles=[ground]))
        for building in stage.buildings:
            box = _cube(building.center, building.rotation, building.size, _colour(ROOF, 0.6))
            entities.append(_entity(view, k, f"building {building.name}", cubes=[box]))
    still = sorted(set(range(view.recording.landmarks.shape[1])) - set(view.moving_landmarks))
    return fox.SceneUpdate(entities=entities + [_landmark(view, k, i) for i in still])


def _moving(view: LogView, k: int) -> Any:
    """Return the landmarks that move."""
    return fox.SceneUpdate(entities=[_landmark(view, k, i) for i in view.moving_landmarks])


def _landmark(view: LogView, k: int, i: int) -> Any:
    place, name = view.recording.landmarks[k, i], view.recording.setups[0].target_names[i]
    ball = _ball(place, _UPRIGHT, [_BALL * view.extent] * 3, _colour(DARK_BLUE))
    above = _text(view, name, np.add(place, (0.0, 0.0, 0.8 * _LETTERS * view.extent)))
    return _entity(view, k, f"landmark {name}", spheres=[ball], texts=[above])


def _vehicles(view: LogView, k: int) -> Any:
    """Return the vehicles: the true ones opaque and with names, the estimated ones translucent."""
    scenario = view.recording.scenario
    angles = np.zeros(len(view.names)) if scenario is None else ways(scenario)
    entities = []
    for shown, i in view.bodies:
        name = view.names[i]
        body = (scenario.vehicles[i].body if scenario is not None else None) or _ROBOT
        turned, size = Rotation.from_euler("z", angles[i]).as_matrix(), np.array(body.size)
        front = body.center + turned @ (size * [0.32, 0.0, 0.5])
        nose = _cube(front, turned, size * [0.25, 0.6, 0.3], _colour("white", 0.9))
        above = _text(view, name, [0.0, 0.0, size[2] + _LETTERS * view.extent])
        for frame, alpha in {shown: 1.0, f"{name}/estimate": 0.35}.items():
            box = _cube(body.center, turned, size, _of(i, alpha))
            parts = {"cubes": [box, nose], "texts": [above] if frame == shown else [], "frame_locked": True}
            entities.append(_entity(view, k, frame.replace("/", " "), frame, **parts))
    return fox.SceneUpdate(entities=entities)


def _transforms(view: LogView, k: int) -> Any:
    """Return the frames of bodies, true and estimated, and of cameras."""
    found = []
    for shown, i in view.bodies:
        name, camera = view.names[i], view.cameras.get(i)
        poses = {shown: (_MAP, view.rotation[k, i], view.position[k, i])}
        poses[f"{name}/estimate"] = _MAP, view.estimates.rotation_estimate[k, i], view.estimates.position_estimate[k, i]
        if camera is not None and (k == 0 or view.recording.pan is not None):
            poses[f"{name}/camera"] = shown, camera.to_body(float(view.pan[k, i])), np.array(camera.position)
        for child, (parent, R, p) in poses.items():
            if np.isfinite(R).all() and np.isfinite(p).all():
                place = {"translation": _xyz(fox.Vector3, p), "rotation": _quaternion(R)}
                frames: dict[str, Any] = {"parent_frame_id": parent, "child_frame_id": child}
                found.append(fox.FrameTransform(timestamp=view.stamp(k), **frames, **place))
    return fox.FrameTransforms(transforms=found)


def _sight(view: LogView, k: int) -> Any:
    """Return lines from every camera to the targets that it measures, in the colour of the vehicle."""
    r, R, p = view.recording, view.rotation[k], view.position[k]
    lever, marker = (np.array([getattr(s, part) for s in r.setups]) for part in ("lever_arm", "marker"))
    eye = p + (R @ lever[..., None])[..., 0]
    target = np.concatenate([r.landmarks[k], p + (R @ marker[..., None])[..., 0]])
    entities = []
    for i, name in enumerate(view.names):
        seen = np.flatnonzero(r.visible[k, i] & np.isfinite(eye[i]).all())
        along = eye[i] + _UNSEEN * (r.bearings[k, i] @ R[i].T)
        ends = [p for j in seen for p in (eye[i], target[j] if np.isfinite(target[j]).all() else along[j])]
        entities.append(_lines(view, k, f"sight of {name}", ends, i))
    return fox.SceneUpdate(entities=entities)


def _lines(view: LogView, k: int, name: str, ends: list[Any], vehicle: int) -> Any:
    """Return lines between pairs of points in the colour of a vehicle."""
    lines = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineList,
        pose=_pose(),
        thickness=1.5,
        scale_invariant=True,
        points=[_xyz(fox.Point3, end) for end in ends],
        color=_of(vehicle, 0.8),
    )
    return _entity(view, k, name, lines=[lines] if ends else [])


def _readings(view: LogView, k: int) -> Any:
    """Return lines from sensors beside cameras to the targets measured since the tick shown before."""
    r, R, p = view.recording, view.rotation[k], view.position[k]
    markers = np.array([setup.marker for setup in r.setups])
    target = np.concatenate([r.landmarks[k], p + (R @ markers[..., None])[..., 0]])
    since, entities = max(0, k + 1 - view.ticks.step), []
    for i, setup in enumerate(r.setups):
        ends: list[Any] = []
        for sensor in [sensor for sensor in setup.sensors if sensor.kind.drawn == "line" and sensor.kind.has_target]:
            measured = np.isfinite(r.readings[sensor.name][since : k + 1, i]).all(axis=-1).any(axis=0)
            place = p[i] + R[i] @ sensor.position
            known = measured & np.isfinite(target).all(axis=-1) & np.isfinite(place).all()
            ends += [end for j in np.flatnonzero(known) for end in (place, target[j])]
        entities.append(_lines(view, k, f"readings of {setup.name}", ends, i))
    return fox.SceneUpdate(entities=entities)


def _uncertainty(view: LogView, k: int) -> Any:
    """Return ellipsoids of 3 sigma about the estimated places."""
    entities, gone, place = [], [], view.estimates.position_estimate[k]
    largest = np.where(np.isfinite(place).all(axis=-1), view.semi[k, :, -1], np.nan)
    for i, name in enumerate(view.names):
        if largest[i] < _LARGEST * view.extent:
            ball = _ball(place[i], view.axes[k, i], 2.0 * view.semi[k, i], _of(i, 0.25))
            entities.append(_entity(view, k, f"3 sigma of {name}", spheres=[ball]))
        else:
            gone.append(fox.SceneEntityDeletion(timestamp=view.stamp(k), id=f"3 sigma of {name}"))
    return fox.SceneUpdate(entities=entities, deletions=gone)


def _poses(view: LogView, vehicle: int) -> Messages:
    """Yield a vehicle's estimate; a covariance of zeros, as ROS has it, where the observer states none."""
    store = codec()
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if "geometry_msgs" in name}
    time, header = (store.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    for k in view.ticks:
        R, p = view.estimates.rotation_estimate[k, vehicle], view.estimates.position_estimate[k, vehicle]
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            continue
        covariance = view.covariance[k, vehicle]
        stated = not view.gain and np.isfinite(covariance).all()
        P = covariance.astype(np.float32).astype(float).ravel() if stated else np.zeros(36)
        place = types["Pose"](_xyz(types["Point"], p), _quaternion(R, types["Quaternion"]))
        stamp = time(*divmod(view.clock.nanoseconds(k), 10**9))
        message = types["PoseWithCovarianceStamped"](header(stamp, _MAP), types["PoseWithCovariance"](place, P))
        yield k, bytes(store.serialize_cdr(message, _POSE))


def _errors(view: LogView, vehicle: int) -> Messages:
    """Yield a vehicle's errors as JSON; null where they are not known."""
    run = view.estimates
    for k in view.ticks:
        sigma = np.nan if view.gain else view.semi[k, vehicle, -1]
        nees = run.nees[k, vehicle] if np.isfinite(sigma) else np.nan
        level, turn = run.protection_level[k, vehicle]
        errors = run.position_error[k, vehicle], run.orientation_error[k, vehicle]
        values = *errors, sigma, level, np.degrees(turn), nees
        row = {name: float(f"{value:.6g}") for name, value in zip(_NUMBERS, values, strict=True)}
        yield k, json.dumps(jsonable(row), separators=(",", ":")).encode()


def _calibration(view: LogView, k: int, vehicle: int) -> Any:
    """Return a camera's calibration."""
    camera = view.cameras[vehicle]
    (fx, fy), (cx, cy) = camera.focal_length, camera.principal_point
    width, height = camera.image_size
    return fox.CameraCalibration(
        timestamp=view.stamp(k),
        frame_id=f"{view.names[vehicle]}/camera",
        width=int(width),
        height=int(height),
        distortion_model="plumb_bob",
        D=list(camera.distortion),
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _image(view: LogView, k: int, vehicle: int) -> Any:
    """Return an empty image: a canvas for the annotations, as simulated cameras have no pixels."""
    file, (width, height) = BytesIO(), view.cameras[vehicle].image_size
    Image.new("RGB", (int(width), int(height)), _CANVAS).save(file, "png")
    frame = f"{view.names[vehicle]}/camera"
    return fox.CompressedImage(timestamp=view.stamp(k), frame_id=frame, data=file.getvalue(), format="png")


def _annotations(view: LogView, k: int, vehicle: int) -> Any:
    """Return circles where the measured bearings hit the image, with the names of the targets."""
    r, camera, stamp = view.recording, view.cameras[vehicle], view.stamp(k)
    targets = np.flatnonzero(r.visible[k, vehicle])
    places = pixels(r.bearings[k, vehicle, targets] @ camera.to_body(float(view.pan[k, vehicle])), camera)
    circles, words = [], []
    ahead = np.isfinite(places).all(axis=1)
    for target, (x, y) in zip(targets[ahead].tolist(), places[ahead].tolist(), strict=True):
        own = target - r.landmarks.shape[1]
        colour = _colour(DARK_BLUE) if own < 0 else _of(own)
        ring = {"diameter": _RING, "thickness": 2.0, "outline_color": colour}
        circles.append(fox.CircleAnnotation(timestamp=stamp, position=fox.Point2(x=x, y=y), **ring))
        text = {"text": r.setups[vehicle].target_names[target], "font_size": _WORDS, "text_color": colour}
        words.append(fox.TextAnnotation(timestamp=stamp, position=fox.Point2(x=x + _RING, y=y), **text))
    return fox.ImageAnnotations(circles=circles, texts=words)


def _entity(view: LogView, k: int, name: str, frame: str = _MAP, **parts: Any) -> Any:
    return fox.SceneEntity(timestamp=view.stamp(k), frame_id=frame, id=name, **parts)


def _text(view: LogView, words: str, place: Any) -> Any:
    """Return words that face the viewer."""
    look = {"font_size": _LETTERS * view.extent, "color": _colour(INK), "text": words}
    return fox.TextPrimitive(pose=_pose(place), billboard=True, **look)


def _cube(center: Any, rotation: Array, size: Any, colour: Any) -> Any:
    return fox.CubePrimitive(pose=_pose(center, rotation), size=_xyz(fox.Vector3, size), color=colour)


def _ball(center: Any, rotation: Array, size: Any, colour: Any) -> Any:
    return fox.SpherePrimitive(pose=_pose(center, rotation), size=_xyz(fox.Vector3, size), color=colour)


def _xyz(kind: Callable[..., Any], values: Any) -> Any:
    """Return a vector, point or quaternion of a type; numbers in single precision keep files small."""
    return kind(**dict(zip("xyzw", np.asarray(values, np.float32).tolist(), strict=False)))


def _quaternion(rotation: Array, kind: Callable[..., Any] = fox.Quaternion) -> Any:
    return _xyz(kind, Rotation.from_matrix(rotation).as_quat())


def _pose(position: Any = (0.0, 0.0, 0.0), rotation: Array = _UPRIGHT) -> Any:
    return fox.Pose(position=_xyz(fox.Vector3, position), orientation=_quaternion(rotation))


def _colour(name: str, alpha: float = 1.0) -> Any:
    return fox.Color(**dict(zip("rgba", to_rgba(name, alpha), strict=True)))


def _of(vehicle: int, alpha: float = 1.0) -> Any:
    """Return the colour of a vehicle, the same as in figures."""
    return _colour(vehicle_colour(vehicle), alpha)
