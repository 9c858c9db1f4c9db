"""Recordings in MCAP files: one is written as one file; every entry of a file that is read back is checked."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from heapq import merge
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.base.errors import DataError, OutputError, check_memory, shown
from coopenv.base.files import check_file, replacing_file
from coopenv.base.installation import version
from coopenv.base.plugins import loaded, offered
from coopenv.base.sections import validated
from coopenv.observers.arrays import ARRAYS, recorded_names, sizes_of
from coopenv.observers.contract import Setup
from coopenv.observers.readings import shapes_of_readings
from coopenv.observers.recording import Recording, check_recording, recorded_arrays
from coopenv.observers.sensed import Truth
from coopenv.sources.mcap_format import (
    ATTACHMENT,
    CONTENTS,
    FORMAT,
    LANDMARKS,
    LANDMARKS_TYPE,
    READING_TYPE,
    SHOWN,
    LogClock,
    RecordingHeader,
    RosLog,
    View,
    codec,
    exact_topics,
    header_of,
    reading,
    reading_topic,
    topic,
)

if TYPE_CHECKING:
    from coopenv.sources.mcap_container import Container


class TickArrays:
    """The arrays of a recording while its messages come in."""

    def __init__(self, ticks: int, setups: Sequence[Setup], names: Sequence[str]) -> None:
        """Allocate the arrays of these names. Raises CoopenvError: they would not fit into memory."""
        vehicles, sizes = [setup.name for setup in setups], {"K": ticks, **sizes_of(setups)}
        shapes = {name: ARRAYS[name].shape(sizes) for name in names if ARRAYS[name].axes[0] == "K"}
        readings = {name: (ticks, *shape) for name, shape in shapes_of_readings(setups).items()}
        needed = 8 * sum(math.prod(shape) for shape in (*shapes.values(), *readings.values()))
        check_memory(needed, f"a recording of {ticks} ticks, {len(vehicles)} vehicles and {sizes['T']} targets")
        self._shape_of_landmarks = shapes.pop("landmarks")[1:]
        shapes["due"] = (ticks, len(vehicles))
        # zeros take no memory before they are written to
        self._arrays = {name: np.zeros(shape, ARRAYS[name].dtype) for name, shape in shapes.items()}
        self._ticks, self._targets = ticks, sizes["T"]
        self._landmarks: dict[int, np.ndarray] = {}
        exact = exact_topics(names)
        self._places = {topic(name, field): (field, i) for i, name in enumerate(vehicles) for field in exact}
        self.kinds = {LANDMARKS: LANDMARKS_TYPE} | {name: exact[field] for name, (field, _) in self._places.items()}
        self._readings = {name: np.full(shape, np.nan) for name, shape in readings.items()}
        self._rows = {
            reading_topic(setup.name, sensor.name): self._readings[sensor.name][:, i]
            for i, setup in enumerate(setups)
            for sensor in setup.sensors
        }
        self.kinds |= dict.fromkeys(self._rows, READING_TYPE)
        """Topic to the type of its messages."""
        self._columns = {
            name: [(part, self._arrays[array][:, i]) for part, array in CONTENTS[field].items()]
            for name, (field, i) in self._places.items()
        }
        self._seen = {name: np.zeros(ticks, dtype=bool) for name in self._places}

    def put(self, name: str, k: int, message: Any) -> None:
        """Take the message of a topic at a tick. Raises ValueError: it does not fit."""
        if k >= self._ticks:
            raise ValueError(f"the recording ends at tick {self._ticks - 1}")
        if self._seen[name][k] if name in self._seen else k in self._landmarks:
            raise ValueError("is there twice")
        if name == LANDMARKS:
            points = [[q.position.x, q.position.y, q.position.z] for q in message.poses]
            self._landmarks[k] = np.array(points, np.float64).reshape(self._shape_of_landmarks)
            return
        if name in self._rows:
            self._put_reading(self._rows[name][k], message)
            return
        field, i = self._places[name]
        self._seen[name][k] = True
        if field == "bearings":
            self._put_bearings(k, i, message)
        for part, column in self._columns[name]:
            column[k] = getattr(message, part).reshape(column.shape[1:])

    @staticmethod
    def _put_reading(row: np.ndarray, m: Any) -> None:
        """Write the message of a sensor to its row (T, size) of a tick."""
        targets, count = m.targets, len(m.targets)
        if len(np.unique(targets)) != count or (targets >= len(row)).any():
            raise ValueError(f"targets are not different ones of {len(row)}")
        if not np.isnan(row).all():
            raise ValueError("is there twice")
        row[targets] = m.values.reshape(count, row.shape[1])

    def _put_bearings(self, k: int, i: int, m: Any) -> None:
        targets, count = m.targets, len(m.targets)
        if len(np.unique(targets)) != count or (targets >= self._targets).any():
            raise ValueError(f"targets are not different ones of {self._targets}")
        self._arrays["due"][k, i] = m.due
        self._arrays["bearings"][k, i] = np.nan
        self._arrays["bearings"][k, i, targets] = m.vectors.reshape(count, 3)
        self._arrays["visible"][k, i, targets] = m.visible.reshape(count).view(np.uint8) != 0

    def complete(self) -> dict[str, Any]:
        """Return the arrays as arguments of a `Recording`; a ValueError names what is missing or contradicts itself."""
        for name, seen in {LANDMARKS: np.array([0 in self._landmarks]), **self._seen}.items():
            if not seen.any():
                raise ValueError(f"topic '{name}' is missing")
            if not seen.all():
                raise ValueError(f"topic '{name}': tick {int(np.argmin(seen))} is missing")
        arrays, changes = dict(self._arrays), sorted(self._landmarks)
        due = arrays.pop("due")
        for k in np.flatnonzero((due != due[:, :1]).any(axis=1)).tolist():
            raise ValueError(f"at tick {k} a correction is due for some vehicles only")
        arrays["due"] = due[:, 0].copy()
        lengths = np.diff([*changes, self._ticks])
        arrays["landmarks"] = np.repeat([self._landmarks[k] for k in changes], lengths, axis=0)
        truth = Truth(arrays.pop("truth.rotation"), arrays.pop("truth.position"))
        return {**arrays, "truth": truth, "readings": self._readings}


def read_recording(path: str | Path) -> Recording:
    """Read what `write_recording` wrote.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: no such file, not an MCAP file, cut off, damaged, not a recording of coopenv, or one that contradicts
            itself.
    """
    codec()
    from coopenv.sources.mcap_container import Container

    where = str(path)
    with reading(where):
        recording = _read(Container(Path(path)), where)
    check_recording(recording, where)
    return recording


def _read(container: Container, where: str) -> Recording:
    header = _header(container, where)
    constants = header.constants(f"{where}: {ATTACHMENT}")
    ticks = TickArrays(header.ticks, constants["setups"], recorded_names(constants["scenario"]))
    for channel, schema, message in container.messages():
        kind = ticks.kinds.get(channel.topic)
        if kind is None:
            continue
        try:
            found = f"{schema.name} ({schema.encoding}, {channel.message_encoding})" if schema else "no schema"
            if found != f"{kind} (ros2msg, cdr)":
                raise ValueError(f"holds {found}, expected {kind} (ros2msg, cdr)")
            ticks.put(channel.topic, message.sequence, codec().deserialize_cdr(message.data, kind))
        except Exception as error:  # of the codec too, which has its own
            reason = str(error) or type(error).__name__
            raise DataError(f"{where}: {channel.topic}, tick {message.sequence}: {reason}") from None
    try:
        return Recording(**ticks.complete(), **constants)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None


def _header(container: Container, where: str) -> RecordingHeader:
    metadata, attachments = container.extras()
    found = metadata.get("coopenv")
    if found is None:
        raise DataError(f"{where}: an MCAP file, but no recording of coopenv (metadata 'coopenv' is missing)")
    if found.get("format") != FORMAT:
        raise DataError(f"{where}: format {shown(found.get('format'))} is not known; known: {FORMAT}")
    if ATTACHMENT not in attachments:
        raise DataError(f"{where}: attachment '{ATTACHMENT}' is missing")
    if hashlib.sha256(attachments[ATTACHMENT]).hexdigest() != found.get("sha256"):
        raise DataError(f"{where}: {ATTACHMENT} is damaged, its check sum differs")
    return validated(RecordingHeader, attachments[ATTACHMENT], f"{where}: {ATTACHMENT}", DataError)


def log_views() -> dict[str, Any]:
    """Return modules that write the views of logs for other programs, by the program's name.

    They are the entry points `coopenv.views`; `coopenv.foxglove.log_views` shows which functions a module has.
    """
    return {name: loaded(point, "view") for name, point in offered("coopenv.views").items()}


def write_recording(recording: Recording, path: str | Path, *, views: Sequence[View] = (), start: float = 0.0) -> None:
    """Write every tick of a recording to a file, which is replaced; `read_recording` gives it back bit for bit.

    Args:
        recording: what is read back.
        path: of the file.
        views: further topics for viewers, such as those of `log_views` make.
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
        self.exact = exact_topics(recorded_arrays(recording))
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
            for sensor in setup.sensors:
                self.channel(reading_topic(setup.name, sensor.name), READING_TYPE)
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
        for k, pose in enumerate(self._poses(*_dead_reckoned(r, i))):
            for field, parts in columns.items():
                row = {part: column[k] for part, column in parts.items()} or self._bearings(k, i)
                self._send(topic(name, field), self.exact[field], k, "map" if field == "truth_exact" else name, **row)
            self._send_readings(k, i, name)
            self._show_odometry(k, i, name, pose)
            if k in truth:
                self._send(topic(name, "truth"), SHOWN["truth"], k, "map", pose=truth[k])
            yield k

    def _send_readings(self, k: int, i: int, name: str) -> None:
        for sensor in self.recording.setups[i].sensors:
            values = self.recording.readings[sensor.name][k, i]
            measured = np.flatnonzero(~np.isnan(values[:, 0]))
            if len(measured):
                row = {"targets": measured.astype(np.uint32), "values": values[measured].ravel()}
                self._send(reading_topic(name, sensor.name), READING_TYPE, k, name, **row)

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
