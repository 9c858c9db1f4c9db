"""Read a recording back from an MCAP file, or say what is wrong with it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from coopenv.backends.mcap.header import constants_from
from coopenv.backends.mcap.messages import ATTACHMENT, EXACT, FORMAT, LANDMARKS, LANDMARKS_TYPE, codec, topic
from coopenv.errors import DataError
from coopenv.observers.recording import Recording, Truth

MAGIC = b"\x89MCAP0\r\n"


def read_recording(path: str | Path) -> Recording:
    """Read what `write_recording` wrote.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: no such file, not an MCAP file, cut off, damaged, or not a recording of coopenv.
    """
    codec()
    path = Path(path)
    try:
        with path.open("rb") as stream:
            _check_ends(stream, path)
            return _Reader(stream, path).read()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None


def _check_ends(stream: BinaryIO, path: Path) -> None:
    head = stream.read(len(MAGIC))
    if head != MAGIC:
        raise DataError(f"{path}: not an MCAP file (it does not begin as one)")
    size = stream.seek(0, 2)
    stream.seek(max(0, size - len(MAGIC)))
    if size < 2 * len(MAGIC) or stream.read() != MAGIC:
        raise DataError(f"{path}: cut off, the end of the MCAP file is missing")
    stream.seek(0)


class _Reader:
    """One file being read."""

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self.stream, self.path, self.codec = stream, path, codec()

    def read(self) -> Recording:
        """Return the recording."""
        import struct

        from mcap.exceptions import McapError
        from mcap.reader import make_reader
        from zstandard import ZstdError

        # What the libraries raise at bytes that make no sense, wrong check sums among it.
        damage = (McapError, ZstdError, struct.error, ValueError, LookupError, RuntimeError, EOFError, MemoryError)
        try:
            self.reader = make_reader(self.stream, validate_crcs=True)
            return self._recording(self._facts())
        except DataError:
            raise
        except damage as error:
            raise DataError(f"{self.path}: damaged MCAP file ({error or type(error).__name__})") from None

    def _facts(self) -> dict[str, Any]:
        found = {m.name: m.metadata for m in self.reader.iter_metadata()}.get("coopenv")
        if found is None:
            raise DataError(f"{self.path}: an MCAP file, but no recording of coopenv (metadata 'coopenv' is missing)")
        if found.get("format") != FORMAT:
            raise DataError(f"{self.path}: format '{found.get('format')}' is not known; known: {FORMAT}")
        for attachment in self.reader.iter_attachments():
            if attachment.name == ATTACHMENT:
                if hashlib.sha256(attachment.data).hexdigest() != found.get("sha256"):
                    raise DataError(f"{self.path}: {ATTACHMENT} is damaged, its check sum differs")
                try:
                    facts = json.loads(attachment.data)
                except ValueError as error:
                    raise self._malformed(error) from None
                return facts
        raise DataError(f"{self.path}: attachment '{ATTACHMENT}' is missing")

    def _malformed(self, error: Exception) -> DataError:
        reason = f"'{error.args[0]}' is missing" if isinstance(error, KeyError) else str(error)
        return DataError(f"{self.path}: {ATTACHMENT}: {reason}")

    def _recording(self, facts: dict[str, Any]) -> Recording:
        try:
            constants = constants_from(facts, str(self.path))
            ticks = int(facts["ticks"])
            names = [setup.name for setup in constants["setups"]]
            targets, L = len(constants["setups"][0].target_names), constants["setups"][0].landmarks
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise self._malformed(error) from None
        arrays: dict[str, Any] = self._arrays(names, ticks, targets, L)
        truth = Truth(arrays.pop("true_rotation"), arrays.pop("true_position"))
        for values in arrays.values():
            values.setflags(write=False)  # observers get views
        constants["start_rotation"].setflags(write=False)
        return Recording(truth=truth, **arrays, **constants)

    def _arrays(self, names: list[str], K: int, T: int, L: int) -> dict[str, np.ndarray]:
        N = len(names)
        arrays = {
            "rotation": np.empty((K, N, 3, 3)),
            "translation": np.empty((K, N, 3)),
            "velocity": np.empty((K, N, 3)),
            "angular_velocity": np.empty((K, N, 3)),
            "bearings": np.full((K, N, T, 3), np.nan),
            "visible": np.zeros((K, N, T), dtype=bool),
            "inbox_tick": np.empty((K, N, N), dtype=np.int64),
            "due": np.empty(K, dtype=bool),
            "true_rotation": np.empty((K, N, 3, 3)),
            "true_position": np.empty((K, N, 3)),
        }
        places = {topic(name, field): (field, i) for i, name in enumerate(names) for field in EXACT}
        landmarks: dict[int, np.ndarray] = {}
        count = dict.fromkeys(places, 0)
        for _, channel, message in self.reader.iter_messages([*places, LANDMARKS], log_time_order=False):
            k = message.sequence
            try:
                if channel.topic == LANDMARKS:
                    poses = self.codec.deserialize_cdr(message.data, LANDMARKS_TYPE).poses
                    landmarks[k] = np.array([[q.position.x, q.position.y, q.position.z] for q in poses]).reshape(L, 3)
                    continue
                field, i = places[channel.topic]
                _FILL[field](arrays, k, i, self.codec.deserialize_cdr(message.data, EXACT[field]))
            except (IndexError, ValueError, AssertionError) as error:
                raise DataError(f"{self.path}: {channel.topic}, tick {k}: {error}") from None
            count[channel.topic] += 1
        for name, number in count.items():
            if number != K:
                what = "is missing" if number == 0 else f"has {number} of {K} ticks"
                raise DataError(f"{self.path}: topic '{name}' {what}")
        if 0 not in landmarks:
            raise DataError(f"{self.path}: topic '{LANDMARKS}' is missing")
        changes = sorted(landmarks)
        lengths = np.diff([*changes, K])
        return {**arrays, "landmarks": np.repeat([landmarks[k] for k in changes], lengths, axis=0)}


def _fill_increment(arrays: dict[str, np.ndarray], k: int, i: int, m: Any) -> None:
    arrays["rotation"][k, i] = m.rotation.reshape(3, 3)
    for name in ("translation", "velocity", "angular_velocity"):
        arrays[name][k, i] = getattr(m, name)


def _fill_bearings(arrays: dict[str, np.ndarray], k: int, i: int, m: Any) -> None:
    arrays["due"][k] = m.due
    arrays["bearings"][k, i, m.targets] = m.vectors.reshape(-1, 3)
    arrays["visible"][k, i, m.targets] = m.visible


def _fill_v2x(arrays: dict[str, np.ndarray], k: int, i: int, m: Any) -> None:
    arrays["inbox_tick"][k, i] = m.tick_sent


def _fill_truth(arrays: dict[str, np.ndarray], k: int, i: int, m: Any) -> None:
    arrays["true_rotation"][k, i] = m.rotation.reshape(3, 3)
    arrays["true_position"][k, i] = m.position


_FILL = {
    "increment": _fill_increment,
    "bearings": _fill_bearings,
    "v2x": _fill_v2x,
    "truth_exact": _fill_truth,
}
"""How a message of each exact topic goes into the arrays."""
