"""Read a recording back from an MCAP file; every entry of the file is checked."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopenv.backends.mcap.format import (
    ATTACHMENT,
    CONTENTS,
    FORMAT,
    LANDMARKS,
    LANDMARKS_TYPE,
    RecordingHeader,
    codec,
    exact_topics,
    reading,
    topic,
)
from coopenv.base.errors import DataError, check_memory, shown
from coopenv.observers.contract import Setup
from coopenv.observers.recording import ARRAYS, Recording, Truth, check_recording, sizes_of

if TYPE_CHECKING:
    from coopenv.backends.mcap.container import Container


class TickArrays:
    """The arrays of a recording while its messages come in; `pan`: whether cameras turn."""

    def __init__(self, ticks: int, setups: Sequence[Setup], pan: bool) -> None:
        """Allocate the arrays. Raises CoopenvError: they would not fit into memory."""
        vehicles, sizes = [setup.name for setup in setups], {"K": ticks, **sizes_of(setups)}
        kept = [n for n, spec in ARRAYS.items() if spec.recorded and spec.axes[0] == "K" and (n != "pan" or pan)]
        shapes = {name: ARRAYS[name].shape(sizes) for name in kept}
        needed = 8 * sum(math.prod(shape) for shape in shapes.values())
        check_memory(needed, f"a recording of {ticks} ticks, {len(vehicles)} vehicles and {sizes['T']} targets")
        self._shape_of_landmarks = shapes.pop("landmarks")[1:]
        shapes["due"] = (ticks, len(vehicles))
        dtypes: dict[str, Any] = {"b": np.bool_, "i": np.int64, "f": np.float64}
        # zeros take no memory before they are written to
        self._arrays = {name: np.zeros(shape, dtypes[ARRAYS[name].kind]) for name, shape in shapes.items()}
        self._ticks, self._targets = ticks, sizes["T"]
        self._landmarks: dict[int, np.ndarray] = {}
        exact = exact_topics(pan)
        self._places = {topic(name, field): (field, i) for i, name in enumerate(vehicles) for field in exact}
        self.kinds = {LANDMARKS: LANDMARKS_TYPE} | {name: exact[field] for name, (field, _) in self._places.items()}
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
        field, i = self._places[name]
        self._seen[name][k] = True
        if field == "bearings":
            self._put_bearings(k, i, message)
        for part, column in self._columns[name]:
            column[k] = getattr(message, part).reshape(column.shape[1:])

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
        return {**arrays, "truth": truth}


def read_recording(path: str | Path) -> Recording:
    """Read what `write_recording` wrote.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: no such file, not an MCAP file, cut off, damaged, not a recording of coopenv, or one that contradicts
            itself.
    """
    codec()
    from coopenv.backends.mcap.container import Container

    where = str(path)
    with reading(where):
        recording = _read(Container(Path(path)), where)
    check_recording(recording, where)
    return recording


def _read(container: Container, where: str) -> Recording:
    header = _header(container, where)
    constants = header.constants(f"{where}: {ATTACHMENT}")
    scenario = constants["scenario"]
    pan = scenario is not None and scenario.action.pan is not None
    ticks = TickArrays(header.ticks, constants["setups"], pan)
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
    return RecordingHeader.read(attachments[ATTACHMENT], f"{where}: {ATTACHMENT}")
