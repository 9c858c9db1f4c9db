"""Bags as files: ROS 1 `.bag`, ROS 2 folders, bare `.db3` and `.mcap`, all through rosbags, within limits."""

import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from coopenv.backends.mcap.format import CUT_OFF, MENDED, REPAIR, is_cut_off
from coopenv.base.errors import CoopenvError, DataError, DataWarning, error_text
from coopenv.cars import codec

SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"

REPAIRS = {".bag": "rosbag reindex", ".mcap": REPAIR, ".db3": "sqlite3 FILE .recover"}
"""By suffix, the tool that mends a file whose recording was cut off."""


@dataclass(frozen=True)
class Raw:
    """A message as it stands in a bag."""

    topic: str
    type: str  # ROS 2 name
    received: int  # ns, clock of the recorder
    decode: Callable[[], Any]


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
        if path.is_dir() and not (path / METADATA).is_file():
            raise DataError(f"{path}: a folder without {METADATA}, which a bag of ROS 2 has")
        if path.is_file() and path.suffix not in SUFFIXES:
            raise DataError(f"{path}: no bag, expected a folder or one of {', '.join(SUFFIXES)}")
        self._stack = ExitStack()
        self._parts = [path] if path.is_file() else [part for part in sorted(path.iterdir()) if part.is_file()]
        self._bytes = sum(part.stat().st_size for part in self._parts)
        for part in self._parts:
            if part.suffix == ".mcap" and is_cut_off(part):
                raise DataError(f"{part}: {CUT_OFF}; {MENDED}")
        from rosbags.highlevel import AnyReader

        from coopenv.backends.mcap.container import Allowance
        from coopenv.cars.bags.limits import limited

        try:
            with limited(Allowance(self._bytes)):
                reader = AnyReader([path], default_typestore=codec.ros1() if path.suffix == ".bag" else codec.ros2())
                self._reader = self._stack.enter_context(reader)
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

    def _complete_types(self) -> None:
        """Add the definitions that are ours to give and that the bag lacks."""
        store, known = self._reader.typestore, codec.ros1() if not self._reader.is2 else codec.ros2()
        wanted = {connection.msgtype for connection in self._reader.connections}
        if wanted - set(store.fielddefs):
            store.register({kind: known.fielddefs[kind] for kind in known.fielddefs if kind not in store.fielddefs})

    def messages(self, topics: Collection[str]) -> Iterator[Raw]:
        """Yield the messages of some topics in the order of their reception.

        Where the file breaks off, or a part of it is damaged, the messages before it have been yielded, and a
        DataWarning is given.
        """
        from coopenv.backends.mcap.container import Allowance
        from coopenv.cars.bags.limits import each_limited, is_too_large

        connections = [c for c in self._reader.connections if c.topic in topics]
        last, first = None, None
        try:
            found = iter(self._reader.messages(connections) if connections else ())
            for connection, received, data in each_limited(found, Allowance(self._bytes)):
                first = received if first is None else first
                last = received
                yield Raw(connection.topic, connection.msgtype, received, self._decoder(connection, data))
        except GeneratorExit:
            raise
        except Exception as error:
            if last is None or first is None or is_too_large(error):
                raise self._unreadable(error) from None
            read = (last - first) * 1e-9
            warnings.warn(
                f"{self.path}: damaged after {read:.1f} s ({error_text(error)}); what came before it is used",
                DataWarning,
                stacklevel=2,
            )

    def _decoder(self, connection: Any, data: bytes) -> Callable[[], Any]:
        """Return what decodes a message. It raises a CoopenvError: it makes no sense."""

        def decode() -> Any:
            try:
                return self._reader.deserialize(data, connection.msgtype)
            except Exception as error:
                raise CoopenvError(f"{connection.msgtype}: cannot be read ({type(error).__name__})") from None

        return decode

    def _unreadable(self, error: Exception) -> DataError:
        from coopenv.cars.bags.limits import is_too_large

        if is_too_large(error):
            return DataError(f"{self.path}: {error}")
        repair = next((REPAIRS[part.suffix] for part in self._parts if part.suffix in REPAIRS), None)
        hint = f"; if its recording was cut off, `{repair}` mends it" if repair else ""
        return DataError(f"{self.path}: cannot be read as a ROS bag ({error_text(error)}){hint}")


def check_extra() -> None:
    """Make sure that bags can be read. Raises CoopenvError: the extra is not installed."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        raise CoopenvError("ROS bags need an extra: pip install '.[log]'") from None
