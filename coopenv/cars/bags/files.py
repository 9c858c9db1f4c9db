"""Bags as files: ROS 1 `.bag`, ROS 2 folders, bare `.db3` and `.mcap`; types and decoding by rosbags."""

import struct
import tempfile
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coopenv.backends.mcap_format import REPAIR
from coopenv.base.errors import CoopenvError, DataError, DataWarning, error_text
from coopenv.base.installation import install_command
from coopenv.cars import codec

METADATA, PACKED = "metadata.yaml", ".zstd"

REPAIRS = {".bag": "rosbag reindex", ".db3": "sqlite3 FILE .recover", ".mcap": REPAIR}
"""Repair tool for a bag with a truncated recording, by the suffix of the file."""

LATEST = 4 * 10**18  # ns, in 2096: sums of two such times fit into 64 bits


class BagFile:
    """An open bag; a context manager."""

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            CoopenvError: the extra is not installed.
            DataError: no such bag, none at all, or damaged beyond reading.
        """
        self.path = path
        check_extra()
        if not path.exists():
            raise DataError(f"no such bag: {path}")
        if path.is_file() and path.suffix not in REPAIRS:
            raise DataError(f"{path}: no bag, expected a folder or one of {', '.join(REPAIRS)}")
        self._stack = ExitStack()
        inside = [path] if path.is_file() else [part for part in sorted(path.iterdir()) if part.is_file()]
        self._files = [part for part in inside if Path(part.name.removesuffix(PACKED)).suffix in REPAIRS]
        if not self._files and not any(part.name == METADATA for part in inside):
            raise DataError(f"{path}: a folder without {METADATA}, which a bag of ROS 2 has")
        try:
            self._reader = self._open()
            self._complete_types()
            self.topics = {name: info.msgtype or "" for name, info in self._reader.topics.items()}
            """Type of every topic; empty where messages of several types came on it."""
            self.counts = {name: int(info.msgcount) for name, info in self._reader.topics.items()}
            self.seconds = max(0.0, (self._reader.end_time - self._reader.start_time) * 1e-9)
            """Between its first and its last message."""
        except Exception as error:  # any error of the library at a malformed file
            self._stack.close()
            raise error if isinstance(error, CoopenvError) else self._unreadable(error) from None
        self._warn_damaged()

    def __enter__(self) -> Self:
        """Return the bag."""
        return self

    def __exit__(self, *unused: object) -> None:
        """Close the file."""
        self._stack.close()

    def _open(self) -> Any:
        """Return the reader of rosbags, with streams of the files in place of its own readers."""
        from rosbags.highlevel import AnyReader

        from coopenv.cars.bags.streams import Part

        files = [self._unpacked(file) if file.suffix == PACKED else file for file in self._files]
        if not files:
            raise ValueError("no file with messages is beside its metadata")
        store = codec.ros1() if files[0].suffix == ".bag" else codec.ros2()
        reader: Any = AnyReader(files, default_typestore=store)
        reader.readers = self._parts = [Part(file) for file in files]
        self._stack.enter_context(reader)
        error = next((part.error for part in self._parts if part.error), None)
        if error is not None and not any(connection.msgcount for connection in reader.connections):
            raise error
        return reader

    def _unpacked(self, file: Path) -> Path:
        """Return a copy of a packed file that is unpacked, until the bag is closed. Raises TooLargeError."""
        import zstandard

        from coopenv.backends.mcap_container import Allowance

        place = Path(self._stack.enter_context(tempfile.TemporaryDirectory()), file.name.removesuffix(PACKED))
        allowance = Allowance(file.stat().st_size)
        with file.open("rb") as packed, place.open("wb") as out:
            for data in zstandard.ZstdDecompressor().read_to_iter(packed):
                allowance.take(len(data))
                out.write(data)
        return place

    def _complete_types(self) -> None:
        """Add the definitions that are ours to give and that the bag lacks."""
        store, known = self._reader.typestore, codec.ros1() if not self._reader.is2 else codec.ros2()
        wanted = {connection.msgtype for connection in self._reader.connections}
        if wanted - set(store.fielddefs):
            store.register({kind: known.fielddefs[kind] for kind in known.fielddefs if kind not in store.fielddefs})

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Yield topic, time of reception (ns, recorder's clock) and decoder of messages of some topics, as they stand.

        Those of a file that breaks off, or a part of which is damaged, are those before; a DataWarning was given.
        """
        for connection, received, data in self._raw(topics):
            yield connection.topic, received, partial(self._decode, data, connection.msgtype)

    def times(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Return stamps (0: none) and times of reception (n,), ns, of the messages of every topic."""
        found: dict[str, list[tuple[int, int]]] = {name: [] for name in self.topics}
        fields = self._reader.typestore.fielddefs
        headed = {
            kind: "std_msgs/msg/Header" in str(fields[kind][1][:1]) for kind in self.topics.values() if kind in fields
        }
        for connection, received, data in self._raw(self.topics):
            stamp = 0
            if headed.get(connection.msgtype) and len(data) >= 12:  # after 4 bytes: encapsulation, or seq of ROS 1
                order = "<" if data[1] & 1 or not self._reader.is2 else ">"
                seconds, nanoseconds = struct.unpack_from(f"{order}II", data, 4)
                stamp = seconds * 10**9 + nanoseconds
            found[connection.topic].append((stamp, received))
        ordered = {name: sorted(rows, key=itemgetter(1)) for name, rows in found.items()}
        tables = {name: np.array(rows, np.int64).reshape(-1, 2).T for name, rows in ordered.items()}
        return {name: (stamps, received) for name, (stamps, received) in tables.items()}

    def _raw(self, topics: Collection[str]) -> Iterator[tuple[Any, int, bytes]]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        for connection, received, data in self._reader.messages(connections) if connections else ():
            if 0 <= received < LATEST:
                yield connection, received, data
            else:
                text = f"topic {connection.topic}: messages are left out that were received after 2096"
                warnings.warn(f"{self.path}: {text}", DataWarning, stacklevel=3)

    def _warn_damaged(self) -> None:
        for part in self._parts:
            if part.error is not None:
                seconds = max(0.0, (part.end_time - part.start_time) * 1e-9)
                text = f"damaged after {seconds:.1f} s ({error_text(part.error)}); what came before it is used"
                warnings.warn(f"{self.path}: {text}", DataWarning, stacklevel=3)

    def _decode(self, data: bytes, kind: str) -> Any:
        """Return a message of a type. Raises CoopenvError: it makes no sense."""
        try:
            return self._reader.deserialize(data, kind)
        except Exception as error:
            raise CoopenvError(f"{kind}: cannot be read ({type(error).__name__})") from None

    def _unreadable(self, error: Exception) -> DataError:
        from coopenv.backends.mcap_container import TooLargeError

        if isinstance(error, TooLargeError):
            return DataError(f"{self.path}: {error}")
        repair = next((REPAIRS[file.suffix] for file in self._files if file.suffix in REPAIRS), None)
        hint = f"; if its recording was cut off, `{repair}` mends it" if repair else ""
        if repair == REPAIR:
            hint += "; coopenv run reads a recording of coopenv"
        return DataError(f"{self.path}: cannot be read as a ROS bag ({error_text(error)}){hint}")


def check_extra() -> None:
    """Make sure that bags can be read. Raises CoopenvError: the extra is not installed."""
    if find_spec("rosbags") is None:
        raise CoopenvError(f"ROS bags need an extra: {install_command('log')}")
