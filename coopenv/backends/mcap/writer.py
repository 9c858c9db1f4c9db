"""Write a recording as one MCAP file."""

import hashlib
from collections.abc import Iterator, Sequence
from heapq import merge
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.format import (
    ATTACHMENT,
    CONTENTS,
    FORMAT,
    LANDMARKS,
    LANDMARKS_TYPE,
    SHOWN,
    LogClock,
    RosLog,
    View,
    codec,
    exact_topics,
    header_of,
    topic,
)
from coopenv.base.errors import OutputError
from coopenv.base.files import check_file, replacing_file
from coopenv.base.installation import version
from coopenv.observers.recording import Recording, check_recording


def write_recording(recording: Recording, path: str | Path, *, views: Sequence[View] = (), start: float = 0.0) -> None:
    """Write every tick of a recording to a file, which is replaced; `read_recording` gives it back bit for bit.

    Args:
        recording: what is read back.
        path: of the file.
        views: further topics for viewers, such as `coopenv.viz.foxglove.views` makes.
        start: s since 1970, time of tick 0, for the stamps alone.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: it could not be read back.
        OutputError: the file cannot be written; an older one is untouched.
    """
    codec()  # before the file is touched
    check_recording(recording, "recording")
    with replacing_file(path) as new, new.open("wb") as stream:
        _Log(stream, recording, LogClock(recording.dt, start)).write(views)


def check_target(path: str | Path) -> None:
    """Refuse before any work a path that no recording can be written to, or to work without the extra `log`."""
    codec()
    if Path(path).suffix != ".mcap":
        raise OutputError(f"{path}: the name must end in .mcap")
    check_file(path)


class _Log(RosLog):
    """One file under way."""

    def __init__(self, stream: Any, recording: Recording, clock: LogClock) -> None:
        super().__init__(stream)
        self.recording, self.clock, self.codec = recording, clock, codec()
        self.exact = exact_topics(recording.pan is not None)
        self.types = {name.removeprefix("geometry_msgs/msg/"): kind for name, kind in self.codec.types.items()}

    def write(self, views: Sequence[View]) -> None:
        """Write everything, tick by tick, as players like it."""
        r = self.recording
        header = header_of(r)
        about = {"format": FORMAT, "version": version(), "sha256": hashlib.sha256(header).hexdigest()}
        self.writer.add_metadata("coopenv", about)
        begun = self.clock.nanoseconds(0)
        self.writer.add_attachment(begun, begun, ATTACHMENT, "application/json", header)
        for setup in r.setups:  # so that topics are there even if nothing is ever known
            for name, kind in {**self.exact, **SHOWN}.items():
                self.channel(topic(setup.name, name), kind)
        changed = (r.landmarks[1:] != r.landmarks[:-1]).any(axis=(1, 2))
        moved = {0, *(np.flatnonzero(changed) + 1).tolist()}
        vehicles = [self._ticks_of(i, setup.name) for i, setup in enumerate(r.setups)]
        shown = merge(*(self._shown(view) for view in views), key=itemgetter(0))
        following = next(shown, None)
        for k in range(r.ticks):
            for ticks in vehicles:
                next(ticks)
            if k in moved:
                poses = self._poses(r.landmarks[k], np.broadcast_to(np.eye(3), (*r.landmarks[k].shape, 3)))
                self._send(LANDMARKS, LANDMARKS_TYPE, k, "map", poses=list(poses))
            while following is not None and following[0] <= k:
                self._add(following[1], k, following[2])
                following = next(shown, None)
        self.writer.finish()

    def _shown(self, view: View) -> Iterator[tuple[int, int, bytes]]:
        """Register the topic of a view; yield (tick, channel, contents) of its messages."""
        name, encoding, definition = view.schema, view.schema_encoding, view.definition
        if name not in self.schemas:
            self.schemas[name] = self.writer.register_schema(name, encoding, definition)
        channel = self.writer.register_channel(view.topic, view.encoding, self.schemas[name])
        return ((k, channel, data) for k, data in view.messages)

    def _ticks_of(self, i: int, name: str) -> Iterator[int]:
        """Write what one vehicle has sensed, a tick each time that the next one is asked for."""
        r, known = self.recording, np.flatnonzero(self.recording.truth.known[:, i])
        poses = self._poses(r.truth.position[known, i], r.truth.rotation[known, i])
        truth = dict(zip(known.tolist(), poses, strict=True))
        columns = {
            field: {part: attrgetter(array)(r)[:, i].reshape(r.ticks, -1) for part, array in CONTENTS[field].items()}
            for field in self.exact
        }
        for k, shown in enumerate(self._poses(*_dead_reckoned(r, i))):
            for field, parts in columns.items():
                row = {part: column[k] for part, column in parts.items()} or self._bearings(k, i)
                self._send(topic(name, field), self.exact[field], k, "map" if field == "truth_exact" else name, **row)
            self._show_odometry(k, i, name, shown)
            if k in truth:
                self._send(topic(name, "truth"), SHOWN["truth"], k, "map", pose=truth[k])
            yield k

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
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(self.clock.nanoseconds(k), 10**9))
        header = self.types["std_msgs/msg/Header"](stamp, frame)
        data = bytes(self.codec.serialize_cdr(self.codec.types[kind](header=header, **fields), kind))
        self._add(self.channel(name, kind), k, data)

    def _add(self, channel: int, k: int, data: bytes) -> None:
        nanoseconds = self.clock.nanoseconds(k)
        self.writer.add_message(channel, nanoseconds, data, nanoseconds, k)


def _dead_reckoned(recording: Recording, vehicle: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (K, 3) and rotations (K, 3, 3) by odometry alone from the start estimate, map frame."""
    positions, rotations = [recording.start_position[vehicle]], [recording.start_rotation[vehicle]]
    for dR, dp in zip(recording.rotation[1:, vehicle], recording.translation[1:, vehicle], strict=True):
        positions.append(positions[-1] + rotations[-1] @ dp)
        rotations.append(rotations[-1] @ dR)
    return np.array(positions), np.array(rotations)
