"""Write a recording as one MCAP file."""

import hashlib
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.header import header_of
from coopenv.backends.mcap.messages import (
    ATTACHMENT,
    CONTENTS,
    EXACT,
    FORMAT,
    LANDMARKS,
    LANDMARKS_TYPE,
    PAN,
    SHOWN,
    codec,
    topic,
)
from coopenv.errors import OutputError
from coopenv.files import check_file, replacing_file
from coopenv.observers.recording import Recording
from coopenv.observers.recording_checks import check_recording
from coopenv.shipped import version


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write every tick of a recording to a file, which is replaced; `read_recording` gives it back bit for bit.

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
    """Refuse before any work a path that no recording can be written to, or to work without the extra `log`."""
    codec()
    if Path(path).suffix != ".mcap":
        raise OutputError(f"{path}: the name must end in .mcap")
    check_file(path)


class _Log:
    """One file under way."""

    def __init__(self, stream: Any, recording: Recording) -> None:
        from mcap.writer import Writer

        self.recording, self.codec = recording, codec()
        self.exact = EXACT if recording.pan is None else EXACT | PAN
        self.types = {name.removeprefix("geometry_msgs/msg/"): kind for name, kind in self.codec.types.items()}
        self.writer = Writer(stream)
        self.writer.start(profile="ros2", library=f"coopenv {version()}")
        self.schemas: dict[str, int] = {}
        self.channels: dict[str, int] = {}

    def write(self) -> None:
        """Write everything."""
        r = self.recording
        header = header_of(r)
        about = {"format": FORMAT, "version": version(), "sha256": hashlib.sha256(header).hexdigest()}
        self.writer.add_metadata("coopenv", about)
        self.writer.add_attachment(0, 0, ATTACHMENT, "application/json", header)
        for i, setup in enumerate(r.setups):  # so that topics are there even if nothing is ever known
            for name, kind in {**self.exact, **SHOWN}.items():
                self._channel(topic(setup.name, name), kind)
            self._write_vehicle(i, setup.name)
        changed = (r.landmarks[1:] != r.landmarks[:-1]).any(axis=(1, 2))
        for k in [0, *(np.flatnonzero(changed) + 1).tolist()]:
            poses = self._poses(r.landmarks[k], np.broadcast_to(np.eye(3), (*r.landmarks[k].shape, 3)))
            self._send(LANDMARKS, LANDMARKS_TYPE, k, "map", poses=list(poses))
        self.writer.finish()

    def _write_vehicle(self, i: int, name: str) -> None:
        r, known = self.recording, np.flatnonzero(self.recording.truth.known[:, i])
        columns = {
            field: {part: attrgetter(array)(r)[:, i].reshape(r.ticks, -1) for part, array in CONTENTS[field].items()}
            for field in self.exact
        }
        for k, shown in enumerate(self._poses(*_dead_reckoned(r, i))):
            for field, parts in columns.items():
                row = {part: column[k] for part, column in parts.items()} or self._bearings(k, i)
                self._send(topic(name, field), self.exact[field], k, "map" if field == "truth_exact" else name, **row)
            self._show_odometry(k, i, name, shown)
        truth = self._poses(r.truth.position[known, i], r.truth.rotation[known, i])
        for k, pose in zip(known.tolist(), truth, strict=True):
            self._send(topic(name, "truth"), SHOWN["truth"], k, "map", pose=pose)

    def _bearings(self, k: int, i: int) -> dict[str, Any]:
        r = self.recording
        seen = np.flatnonzero(r.visible[k, i] | ~np.isnan(r.bearings[k, i]).all(axis=1))
        row = {"targets": seen.astype(np.uint32), "visible": r.visible[k, i, seen]}
        return {**row, "due": bool(r.due[k]), "vectors": r.bearings[k, i, seen].ravel()}

    def _show_odometry(self, k: int, i: int, name: str, pose: Any) -> None:
        vectors = (self.recording.velocity[k, i], self.recording.angular_velocity[k, i])
        twist = self.types["Twist"](*(self.types["Vector3"](*vector.tolist()) for vector in vectors))
        unknown = np.zeros(36)
        about = {
            "child_frame_id": name,
            "pose": self.types["PoseWithCovariance"](pose, unknown),
            "twist": self.types["TwistWithCovariance"](twist, unknown),
        }
        self._send(topic(name, "odometry"), SHOWN["odometry"], k, "map", **about)

    def _poses(self, positions: np.ndarray, rotations: np.ndarray) -> Iterator[Any]:
        quaternions = Rotation.from_matrix(np.array(rotations)).as_quat().tolist() if len(rotations) else []
        pose, point, orientation = (self.types[name] for name in ("Pose", "Point", "Quaternion"))
        pairs = zip(positions.tolist(), quaternions, strict=True)
        return (pose(point(*position), orientation(*quaternion)) for position, quaternion in pairs)

    def _send(self, name: str, kind: str, k: int, frame: str, **fields: Any) -> None:
        nanoseconds = round(k * self.recording.dt * 1e9)
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
        header = self.types["std_msgs/msg/Header"](stamp, frame)
        data = bytes(self.codec.serialize_cdr(self.codec.types[kind](header=header, **fields), kind))
        self.writer.add_message(self._channel(name, kind), nanoseconds, data, nanoseconds, k)

    def _channel(self, name: str, kind: str) -> int:
        if name not in self.channels:
            if kind not in self.schemas:
                text, _ = self.codec.generate_msgdef(kind, ros_version=2)
                self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", text.encode())
            self.channels[name] = self.writer.register_channel(name, "cdr", self.schemas[kind])
        return self.channels[name]


def _dead_reckoned(recording: Recording, vehicle: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (K, 3) and rotations (K, 3, 3) by odometry alone from the start estimate, map frame."""
    positions, rotations = [recording.start_position[vehicle]], [recording.start_rotation[vehicle]]
    for dR, dp in zip(recording.rotation[1:, vehicle], recording.translation[1:, vehicle], strict=True):
        positions.append(positions[-1] + rotations[-1] @ dp)
        rotations.append(rotations[-1] @ dR)
    return np.array(positions), np.array(rotations)
