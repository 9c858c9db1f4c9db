"""Write a recording as one MCAP file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.header import Header
from coopenv.backends.mcap.messages import ATTACHMENT, EXACT, FORMAT, LANDMARKS, LANDMARKS_TYPE, SHOWN, codec, topic
from coopenv.errors import OutputError
from coopenv.files import check_file, replacing_file
from coopenv.observers.recording import Recording
from coopenv.observers.recording_checks import check_recording
from coopenv.shipped import version

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write every tick of a recording; `read_recording` gives it back bit for bit.

    Args:
        recording: from any source.
        path: of the file, which is replaced.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: it is a recording that nobody could read back.
        OutputError: the file cannot be written; an older one is untouched.
    """
    codec()  # before the file is touched
    check_recording(recording, "recording")
    with replacing_file(path) as new, new.open("wb") as stream:
        _Log(stream, recording).write()


def check_target(path: str | Path) -> None:
    """Say before any work if a recording cannot be written to a path.

    Raises:
        CoopenvError: the extra `log` is not installed.
        OutputError: the name does not end in .mcap, or the file cannot be written.
    """
    codec()
    path = Path(path)
    if path.suffix != ".mcap":
        raise OutputError(f"{path}: the name must end in .mcap")
    check_file(path)


class _Log:
    """One file under way."""

    def __init__(self, stream: Any, recording: Recording) -> None:
        from mcap.writer import Writer

        self.recording, self.codec = recording, codec()
        self.types = self.codec.types
        self.writer = Writer(stream)
        self.writer.start(profile="ros2", library=f"coopenv {version()}")
        self.schemas: dict[str, int] = {}
        self.channels: dict[str, int] = {}

    def write(self) -> None:
        """Write everything."""
        r = self.recording
        header = Header.of(r).model_dump_json().encode()
        about = {"format": FORMAT, "version": version(), "sha256": hashlib.sha256(header).hexdigest()}
        self.writer.add_metadata("coopenv", about)
        self.writer.add_attachment(0, 0, ATTACHMENT, "application/json", header)
        for i, setup in enumerate(r.setups):  # so that topics are there even if nothing is ever known
            for name, kind in {**EXACT, **SHOWN}.items():
                self._channel(topic(setup.name, name), kind)
            self._write_vehicle(i, setup.name)
        changed = np.ones(r.ticks, dtype=bool)
        changed[1:] = (r.landmarks[1:] != r.landmarks[:-1]).any(axis=(1, 2))
        for k in np.flatnonzero(changed).tolist():
            self._send(LANDMARKS, LANDMARKS_TYPE, k, "map", poses=[self._pose(p, UPRIGHT) for p in r.landmarks[k]])
        self.writer.finish()

    def _write_vehicle(self, i: int, name: str) -> None:
        r = self.recording
        R, p = _dead_reckoned(r, i)
        pose = np.concatenate([r.truth.rotation[:, i].reshape(-1, 9), r.truth.position[:, i]], axis=1)
        known = np.flatnonzero(np.isfinite(pose).all(axis=1))
        shown, true = _quaternions(R), _quaternions(r.truth.rotation[known, i])
        for k in range(r.ticks):
            self._write_tick(k, i, name)
            self._show_odometry(k, i, name, self._pose(p[k], shown[k]))
        for k, quaternion in zip(known.tolist(), true, strict=True):
            shown_pose = self._pose(r.truth.position[k, i], quaternion)
            self._send(topic(name, "truth"), SHOWN["truth"], k, "map", pose=shown_pose)

    def _write_tick(self, k: int, i: int, name: str) -> None:
        """Write what is read back."""
        r = self.recording
        send = {field: topic(name, field) for field in EXACT}
        self._send(
            send["increment"],
            EXACT["increment"],
            k,
            name,
            rotation=r.rotation[k, i].ravel(),
            translation=r.translation[k, i],
            velocity=r.velocity[k, i],
            angular_velocity=r.angular_velocity[k, i],
        )
        seen = np.flatnonzero(r.visible[k, i] | ~np.isnan(r.bearings[k, i]).all(axis=1))
        self._send(
            send["bearings"],
            EXACT["bearings"],
            k,
            name,
            due=bool(r.due[k]),
            targets=seen.astype(np.uint32),
            visible=r.visible[k, i, seen],
            vectors=r.bearings[k, i, seen].ravel(),
        )
        self._send(send["v2x"], EXACT["v2x"], k, name, tick_sent=r.inbox_tick[k, i])
        rotation, position = r.truth.rotation[k, i].ravel(), r.truth.position[k, i]
        self._send(send["truth_exact"], EXACT["truth_exact"], k, "map", rotation=rotation, position=position)

    def _show_odometry(self, k: int, i: int, name: str, pose: Any) -> None:
        r, types = self.recording, self.types
        twist = types["geometry_msgs/msg/Twist"](self._vector(r.velocity[k, i]), self._vector(r.angular_velocity[k, i]))
        unknown = np.zeros(36)
        self._send(
            topic(name, "odometry"),
            SHOWN["odometry"],
            k,
            "map",
            child_frame_id=name,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, unknown),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist, unknown),
        )

    def _vector(self, v: np.ndarray) -> Any:
        return self.types["geometry_msgs/msg/Vector3"](*v.tolist())

    def _pose(self, position: np.ndarray, quaternion_xyzw: np.ndarray) -> Any:
        types = self.types
        return types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*position.tolist()),
            types["geometry_msgs/msg/Quaternion"](*quaternion_xyzw.tolist()),
        )

    def _send(self, name: str, kind: str, k: int, frame: str, **fields: Any) -> None:
        nanoseconds = round(k * self.recording.dt * 1e9)
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
        header = self.types["std_msgs/msg/Header"](stamp, frame)
        arrays = {key: np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v for key, v in fields.items()}
        data = bytes(self.codec.serialize_cdr(self.types[kind](header=header, **arrays), kind))
        self.writer.add_message(self._channel(name, kind), nanoseconds, data, nanoseconds, k)

    def _channel(self, name: str, kind: str) -> int:
        if name not in self.channels:
            if kind not in self.schemas:
                text, _ = self.codec.generate_msgdef(kind, ros_version=2)
                self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", text.encode())
            self.channels[name] = self.writer.register_channel(name, "cdr", self.schemas[kind])
        return self.channels[name]


def _dead_reckoned(recording: Recording, vehicle: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (K, 3, 3) and positions (K, 3) by odometry alone from the start estimate, map frame."""
    R, p = recording.start_rotation[vehicle], recording.start_position[vehicle]
    rotations, positions = [R], [p]
    for dR, dp in zip(recording.rotation[1:, vehicle], recording.translation[1:, vehicle], strict=True):
        R, p = R @ dR, p + R @ dp
        rotations.append(R)
        positions.append(p)
    return np.array(rotations), np.array(positions)


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """Return the quaternions (K, 4) in the order x, y, z, w of rotations (K, 3, 3)."""
    return Rotation.from_matrix(rotations).as_quat() if len(rotations) else np.empty((0, 4))
