"""Bags of a simulated drive: messages with real definitions, written by rosbags as ROS 1, ROS 2 sqlite3 or MCAP."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.cars.messages import codec
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import log_so3
from coopenv.observers import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.scenario.sensing import ROTATION_OF_CAMERA, Camera
from tests.oracles.continuous import left_jacobian

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
        fields = {"point": point}
        found.append(Message("/agent7/riccatiPoint", "geometry_msgs/msg/PointStamped", t, t, fields))
    return found


@cache
def sent() -> tuple[Message, ...]:
    """Return the messages of the drive of four seconds."""
    return tuple(messages(drive()))


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
        place = {"pose": codec.pose(r.truth.rotation[k, i], r.truth.position[k, i])}
        found.append(Message(names["truth"], "geometry_msgs/msg/PoseStamped", t, t, place))
    return found


@cache
def lens() -> Camera:
    """Return the camera of the drives, without distortion."""
    return load_scenario("crossing_path").cameras[0]


def blocks(
    r: Recording, k: int, i: int, numbers: dict[int, int], distortion: tuple[float, ...]
) -> list[dict[str, int]]:
    """Return the blocks of a frame, an unwanted small one of every marker among them."""
    camera, found = lens(), []
    for target in np.flatnonzero(r.visible[k, i]).tolist():
        ray = ROTATION_OF_CAMERA["forward"].T @ r.bearings[k, i, target]
        flat = distort((ray[:2] / ray[2])[None], distortion)[0]
        u, v = np.round(flat * camera.focal_length + np.array(camera.principal_point)).astype(int).tolist()
        for x, width in ((u, 9), (1, 2)):
            sides = {"width": width, "height": width, "age": 1}
            found.append({"signature": numbers[target], "center_x": x, "center_y": v, **sides})
    return found


def twist(r: Recording, k: int, i: int) -> dict[str, Any]:
    """Return the twist that leads to a tick when it is held since the last one; its rotation is small or none."""
    turn = log_so3(r.rotation[k, i])
    linear = np.linalg.solve(left_jacobian(turn), r.translation[k, i])
    return {"twist": (linear / r.dt, turn / r.dt), "covariance": np.diag([0.1] * 6)}


def later(given: Iterable[Message], *, stamps: float = 0.0, received: float = 0.0, topics: str = "") -> list[Message]:
    """Return messages with other times (s), those of topics that begin with a text."""
    return [
        replace(m, stamp=m.stamp + round(stamps * 1e9), received=m.received + round(received * 1e9))
        if m.topic.startswith(topics)
        else m
        for m in given
    ]


def writer(path: Path, form: str) -> tuple[Path, Any, Any]:
    """Return the path of a bag with the form's suffix, what writes it, and its store of types.

    `form` is ros1, sqlite3 or mcap, and a compression.
    """
    storage, _, compression = form.partition(" ")
    if storage == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        path = path.with_suffix(".bag")
        bag = Writer1(path)
        if compression:
            bag.set_compression(Writer1.CompressionFormat[compression])
        return path, bag, codec.ros1()
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    folder = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        folder.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    return path, folder, codec.ros2()


def write(path: Path, given: Iterable[Message], form: str) -> Path:
    """Write a bag and return its path; `form` as for `writer`."""
    ordered = sorted(given, key=lambda m: m.received)
    path, opened, store = writer(path, form)
    connections: dict[str, Any] = {}
    with opened as bag:
        for m in ordered:
            if m.topic not in connections:
                connections[m.topic] = bag.add_connection(m.topic, m.kind, typestore=store)
            payload = codec.encode(made(m))
            payload = payload if store is codec.ros2() else codec.ros1_of(payload, m.kind)
            bag.write(connections[m.topic], BEGIN + m.received, payload)
    return path


def made(m: Message) -> Any:
    """Return a message as one of ROS 2."""
    return codec.make(m.kind, header=codec.header(BEGIN + m.stamp), **m.fields)


def write_raw(path: Path, given: Iterable[tuple[str, bytes, int]], kinds: dict[str, str]) -> None:
    """Write an MCAP bag of CDR payloads with their topics and times of reception, ns; `kinds` are types by topic."""
    _, opened, store = writer(path, "mcap")
    with opened as bag:
        connections: dict[str, Any] = {}
        for topic, payload, received in given:
            if topic in kinds:
                if topic not in connections:
                    connections[topic] = bag.add_connection(f"/{topic}", kinds[topic], typestore=store)
                bag.write(connections[topic], received, payload)
