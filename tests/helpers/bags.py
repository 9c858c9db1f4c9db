"""Bags of a simulated drive: messages with real definitions, written by rosbags as ROS 1, ROS 2 sqlite3 or MCAP."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.cars import codec
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import log_so3
from coopenv.observers import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.scenario.sensing import ROTATION_OF_CAMERA

BEGIN = 1_700_000_000_000_000_000  # ns
DISTORTION = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
MAP = """
environment = "crossing_path"
names = "authors"
markers = { SL1 = 1, SL2 = 2, SL4 = 4, SL5 = 5 }

[overrides]
"camera.distortion" = [-0.352043, 0.137879, 0.001953, 0.000628, 0.0]
"rates.odometry" = 60.0
"observer.P0" = [0.1, 0.1]
"vehicles.0.initial_estimate" = { position = [0.2, 0.0, 0.1], yaw = 1.8 }

[[cars]]
name = "svea3"
marker = 7
agent = 8

[[cars]]
name = "svea1"
landmark = "ML"
marker = 3
agent = 7
"""


@dataclass(frozen=True)
class Message:
    """One message; times in ns since the begin."""

    topic: str
    kind: str
    stamp: int
    received: int
    fields: dict[str, Any]


@cache
def drive(seconds: float = 4.0, seed: int = 0) -> Recording:
    """Return a drive past four landmarks, with the lens's distortion and whole pixels."""
    overrides = {
        "camera.distortion": DISTORTION,
        "rates.odometry": 60.0,
        "observer.P0": (0.1, 0.1),
        "vehicles.0.initial_estimate": {"position": [0.2, 0.0, 0.1], "yaw": 1.8},
        "horizon": seconds,
        "vehicles.0.motion": {
            "kind": "segments",
            "segments": [{"duration": 0.5}, {"duration": 2.1, "linear": [0.26, 0.0, 0.0], "angular": [0, 0, 0.1]}],
        },
        "landmarks.ML.position": [-0.5, 1.45, 0.0],
        "landmarks.ML.motion": {"kind": "segments", "segments": [{"duration": 2.0, "linear": [0.26, 0.0, 0.0]}]},
    }
    return record(load_scenario("crossing_path", overrides), seed)


def vector(kind: str, values: Any) -> tuple[str, dict[str, Any]]:
    return f"geometry_msgs/msg/{kind}", dict(zip("xyz", map(float, values), strict=True))


def pose(R: np.ndarray, p: np.ndarray) -> tuple[str, dict[str, Any]]:
    half = 0.5 * log_so3(R)
    angle = float(np.linalg.norm(half))
    axis = half if angle < 1e-12 else half / angle * np.sin(angle)
    turn = dict(zip("xyzw", [*map(float, axis), float(np.cos(angle))], strict=True))
    return "geometry_msgs/msg/Pose", {
        "position": vector("Point", p),
        "orientation": ("geometry_msgs/msg/Quaternion", turn),
    }


AUTHORS = {
    "blocks": "/agent8/pixy_node/objectsInfo",
    "twist": "/agent8/actuation_twist",
    "truth": "/qualisys/svea3/pose",
}
NUMBERS = {0: 1, 1: 2, 2: 4, 3: 5, 4: 3}  # target to number of its marker


def messages(r: Recording) -> list[Message]:
    """Return what the car and the moving landmark of a drive send, under the authors' names."""
    found = of_vehicle(r, 0, AUTHORS, NUMBERS, DISTORTION)
    for k in range(r.ticks):
        t = round(k * 1e9 * r.dt)
        point = r.landmarks[k, 4] - np.array([0.0, 0.0, 0.25])  # of a point only the marker's height is added
        fields = {"point": vector("Point", point)}
        found.append(Message("/agent7/riccatiPoint", "geometry_msgs/msg/PointStamped", t, t, fields))
    return found


def of_vehicle(
    r: Recording, i: int, names: dict[str, str], numbers: dict[int, int], distortion: tuple[float, ...]
) -> list[Message]:
    """Return what one vehicle senses: blocks, twists and its true pose at every tick."""
    found = []
    for k in range(r.ticks):
        t = round(k * 1e9 * r.dt)
        seen = {"objects": blocks(r, k, i, numbers, distortion)}
        found.append(Message(names["blocks"], "pixy_camera/msg/ObjectInfoArrayStamped", t, t, seen))
        if k + 1 < r.ticks:
            moved = {"twist": twist(r, k + 1, i)}
            found.append(Message(names["twist"], "geometry_msgs/msg/TwistWithCovarianceStamped", t, t, moved))
        place = {"pose": pose(r.truth.rotation[k, i], r.truth.position[k, i])}
        found.append(Message(names["truth"], "geometry_msgs/msg/PoseStamped", t, t, place))
    return found


def blocks(
    r: Recording, k: int, i: int, numbers: dict[int, int], distortion: tuple[float, ...]
) -> list[tuple[str, dict[str, Any]]]:
    """Return the blocks of a frame, an unwanted small one of every marker among them."""
    camera = load_scenario("crossing_path").cameras[0]
    found = []
    for target in np.flatnonzero(r.visible[k, i]).tolist():
        ray = ROTATION_OF_CAMERA["forward"].T @ r.bearings[k, i, target]
        flat = distort((ray[:2] / ray[2])[None], distortion)[0]
        u, v = np.round(flat * camera.focal_length + np.array(camera.principal_point)).astype(int).tolist()
        for x, width in ((u, 9), (1, 2)):
            row = {"signature": numbers[target], "center_x": x, "center_y": v, "width": width, "height": width}
            found.append(("pixy_camera/msg/ObjectInfo", {**row, "angle": 0, "index": 0, "age": 1}))
    return found


def twist(r: Recording, k: int, i: int) -> tuple[str, dict[str, Any]]:
    """Return the twist that leads to a tick when it is held since the last one; its rotation is small or none."""
    turn = log_so3(r.rotation[k, i])
    linear = np.linalg.solve(_left_jacobian(turn), r.translation[k, i])
    both = {"linear": vector("Vector3", linear / r.dt), "angular": vector("Vector3", turn / r.dt)}
    return "geometry_msgs/msg/TwistWithCovariance", {
        "twist": ("geometry_msgs/msg/Twist", both),
        "covariance": np.diag([0.1] * 6).ravel(),
    }


def _left_jacobian(turn: np.ndarray) -> np.ndarray:
    x, y, z = turn
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + W / 2 + W @ W / 6 + W @ W @ W / 24


def later(given: Iterable[Message], *, stamps: float = 0.0, received: float = 0.0, topics: str = "") -> list[Message]:
    """Return messages with other times (s), those of topics that begin with a text."""
    return [
        replace(m, stamp=m.stamp + round(stamps * 1e9), received=m.received + round(received * 1e9))
        if m.topic.startswith(topics)
        else m
        for m in given
    ]


def write(path: Path, given: Iterable[Message], form: str) -> Path:
    """Write a bag; `form` is ros1, sqlite3 or mcap. Return its path, with the suffix that the form has."""
    ordered = sorted(given, key=lambda m: m.received)
    if form == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        path = path.with_suffix(".bag")
        with Writer1(path) as bag:
            _fill(bag, ordered, codec.ros1(), lambda s, m, kind: s.serialize_ros1(m, kind))
        return path
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        _fill(bag, ordered, codec.ros2(), lambda s, m, kind: s.serialize_cdr(m, kind))
    return path


def _fill(bag: Any, ordered: list[Message], store: Any, encode: Any) -> None:
    connections: dict[str, Any] = {}
    for number, m in enumerate(ordered):
        if m.topic not in connections:
            connections[m.topic] = bag.add_connection(m.topic, m.kind, typestore=store)
        message = _made(store, m.kind, {"header": _header(store, BEGIN + m.stamp, number), **m.fields})
        bag.write(connections[m.topic], BEGIN + m.received, encode(store, message, m.kind))


def payload(m: Message, number: int = 0) -> bytes:
    """Return the CDR bytes of a message."""
    return codec.encode(
        _made(codec.ros2(), m.kind, {"header": _header(codec.ros2(), BEGIN + m.stamp, number), **m.fields})
    )


def _header(store: Any, stamp: int, number: int) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    fields = {"stamp": time, "frame_id": ""}
    kind = store.types["std_msgs/msg/Header"]
    return kind(**fields, seq=number) if "seq" in kind.__dataclass_fields__ else kind(**fields)


def _made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    return store.types[kind](**{name: _value(store, value) for name, value in fields.items()})


def _value(store: Any, value: Any) -> Any:
    if isinstance(value, tuple):
        return _made(store, *value)
    return [_value(store, part) for part in value] if isinstance(value, list) else value
