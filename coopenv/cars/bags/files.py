"""Bags as files: ROS 1 `.bag`, ROS 2 folders, bare `.db3` and `.mcap`, all by rosbags, which unpacks within limits."""

import struct
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from coopenv.backends.mcap.format import REPAIR
from coopenv.base.errors import CoopenvError, DataError, DataWarning, error_text
from coopenv.base.installation import install_command
from coopenv.cars import codec

if TYPE_CHECKING:
    from coopenv.backends.mcap.container import Allowance

METADATA = "metadata.yaml"

REPAIRS = {".bag": "rosbag reindex", ".db3": "sqlite3 FILE .recover", ".mcap": REPAIR}
"""By the suffix of bags that are files, the tool that mends one whose recording was cut off."""


class BagFile:
    """One bag, open; a context manager."""

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
        self._parts = [path] if path.is_file() else [part for part in sorted(path.iterdir()) if part.is_file()]
        self._bytes = sum(part.stat().st_size for part in self._parts)
        if not any(part.suffix in REPAIRS or part.name == METADATA for part in self._parts):
            raise DataError(f"{path}: a folder without {METADATA}, which a bag of ROS 2 has")
        try:
            self._reader = self._open()
            self._complete_types()
            self.topics = {name: info.msgtype or "" for name, info in self._reader.topics.items()}
            """Type of every topic; empty where messages of several types came on it."""
            self.counts = {name: int(info.msgcount) for name, info in self._reader.topics.items()}
            self.seconds = max(0.0, (self._reader.end_time - self._reader.start_time) * 1e-9)
            """Between its first and its last message."""
        except Exception as error:  # whatever the library raises at files that make no sense
            self._stack.close()
            raise error if isinstance(error, CoopenvError) else self._unreadable(error) from None

    def __enter__(self) -> Self:
        """Return the bag."""
        return self

    def __exit__(self, *unused: object) -> None:
        """Close the file."""
        self._stack.close()

    def _open(self) -> Any:
        """Return the reader of rosbags; where an index is missing, what is left of the files."""
        from rosbags.highlevel import AnyReader

        from coopenv.backends.mcap.container import Allowance
        from coopenv.cars.bags.remains import Remains, ends_early

        files = [part for part in self._parts if part.suffix in REPAIRS]
        whole = self.path.is_file() or (self.path / METADATA).is_file()
        store = codec.ros1() if self.path.suffix == ".bag" else codec.ros2()
        early = any(map(ends_early, files))
        with limited(Allowance(self._bytes)):
            try:
                if early:
                    raise EOFError("its end is missing")
                return self._stack.enter_context(AnyReader([self.path] if whole else files, default_typestore=store))
            except Exception as error:
                if is_too_large(error) or not (early or any(part.suffix != ".mcap" for part in files)):
                    raise
                reader: Any = AnyReader(files, default_typestore=store)
                reader.readers = [Remains(part) for part in files]
                self._stack.enter_context(reader)
                if not reader.connections:
                    raise
                self._warn_damaged((reader.end_time - reader.start_time) * 1e-9, error)
                return reader

    def _complete_types(self) -> None:
        """Add the definitions that are ours to give and that the bag lacks."""
        store, known = self._reader.typestore, codec.ros1() if not self._reader.is2 else codec.ros2()
        wanted = {connection.msgtype for connection in self._reader.connections}
        if wanted - set(store.fielddefs):
            store.register({kind: known.fielddefs[kind] for kind in known.fielddefs if kind not in store.fielddefs})

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Yield topic, time of reception (ns, recorder's clock) and decoder of messages of some topics, as they came.

        Where the file breaks off, or a part of it is damaged, the messages before it have been yielded, and a
        DataWarning is given.
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
        tables = {name: np.array(rows, np.int64).reshape(-1, 2).T for name, rows in found.items()}
        return {name: (stamps, received) for name, (stamps, received) in tables.items()}

    def _raw(self, topics: Collection[str]) -> Iterator[tuple[Any, int, bytes]]:
        from coopenv.backends.mcap.container import Allowance

        connections = [c for c in self._reader.connections if c.topic in topics]
        last, first, allowance = None, None, Allowance(self._bytes)
        try:
            found = iter(self._reader.messages(connections) if connections else ())
            while True:
                with limited(allowance):
                    message = next(found, None)
                if message is None:
                    return
                last = message[1]
                first = last if first is None else first
                yield message
        except Exception as error:
            if last is None or first is None or is_too_large(error):
                raise self._unreadable(error) from None
            self._warn_damaged((last - first) * 1e-9, error)

    def _warn_damaged(self, read: float, error: Exception) -> None:
        text = f"{self.path}: damaged after {read:.1f} s ({error_text(error)}); what came before it is used"
        warnings.warn(text, DataWarning, stacklevel=3)

    def _decode(self, data: bytes, kind: str) -> Any:
        """Return a message of a type. Raises CoopenvError: it makes no sense."""
        try:
            return self._reader.deserialize(data, kind)
        except Exception as error:
            raise CoopenvError(f"{kind}: cannot be read ({type(error).__name__})") from None

    def _unreadable(self, error: Exception) -> DataError:
        if is_too_large(error):
            return DataError(f"{self.path}: {error}")
        repair = next((REPAIRS[part.suffix] for part in self._parts if part.suffix in REPAIRS), None)
        hint = f"; if its recording was cut off, `{repair}` mends it" if repair else ""
        if repair == REPAIR:
            hint += "; coopenv run reads a recording of coopenv"
        return DataError(f"{self.path}: cannot be read as a ROS bag ({error_text(error)}){hint}")


def check_extra() -> None:
    """Make sure that bags can be read. Raises CoopenvError: the extra is not installed."""
    if find_spec("rosbags") is None:
        raise CoopenvError(f"ROS bags need an extra: {install_command('log')}")


_allowance: ContextVar["Allowance | None"] = ContextVar("_allowance", default=None)
"""What the bag that is read now may still unpack to; None: rosbags reads for another program."""


@contextmanager
def limited(allowance: "Allowance") -> Iterator[None]:
    """Let rosbags unpack no more than is allowed, and SQLite return no value above `AT_ONCE`.

    Raises:
        CoopenvError: this version of rosbags unpacks in another way.
    """
    _guard_rosbags()
    token = _allowance.set(allowance)
    try:
        yield
    finally:
        _allowance.reset(token)


def is_too_large(error: Exception) -> bool:
    """Return whether an error is about a part of a bag that is too large."""
    import apsw

    from coopenv.backends.mcap.container import TooLargeError

    return isinstance(error, TooLargeError | apsw.TooBigError)


@cache
def _guard_rosbags() -> None:
    """Replace the functions with which rosbags unpacks by some that respect `_allowance`."""
    from coopenv.backends.mcap.container import AT_ONCE, Allowance

    try:
        import apsw
        from rosbags.rosbag1.reader import decompressors
        from rosbags.rosbag2 import reader as rosbag2_reader
        from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

        reader: Any = rosbag2_reader
        unpack_message, open_file = reader.zstd.decompress, reader.zstd.open
    except (ImportError, AttributeError):
        raise CoopenvError(
            "this version of rosbags would unpack without limits; pip install 'rosbags==0.11.9'"
        ) from None

    def unpacker(original: Callable[..., bytes], compression: str, *, alone: bool = False) -> Callable[..., bytes]:
        """Return what unpacks as `original` does, within the limits; `alone`: each chunk has limits of its own."""

        def unpack(data: bytes, *size: int) -> bytes:
            if (allowance := _allowance.get()) is None:
                return original(data, *size)
            return (Allowance(len(data)) if alone else allowance).unpack(compression, data, *size)

        return unpack

    def file(stream: Any, mode: str) -> Any:
        return open_file(stream, mode) if _allowance.get() is None else _Counted(open_file(stream, mode))

    def connected(database: Any) -> None:
        if _allowance.get() is not None:
            database.limit(apsw.SQLITE_LIMIT_LENGTH, AT_ONCE)

    reader.zstd = SimpleNamespace(decompress=unpacker(unpack_message, "zstd"), open=file)
    tables: tuple[tuple[Any, bool], ...] = ((DECOMPRESSORS, False), (decompressors, True))
    for table, alone in tables:  # of a bag of ROS 1, rosbags holds one chunk at a time, and may come back to it
        table.update({name: unpacker(original, name, alone=alone) for name, original in table.items()})
    apsw.connection_hooks.append(connected)


class _Counted:
    """A file that is unpacked while it is read; what it gives is counted."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes. Raises TooLargeError: there are more than the bag may unpack to."""
        data = bytes(self._stream.read(size))
        allowance = _allowance.get()
        if allowance is not None:
            allowance.take(len(data))
        return data
