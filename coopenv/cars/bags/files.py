"""Bags as files: ROS 1 `.bag`, ROS 2 folders, bare `.db3` and `.mcap`. Needs the extra `log`."""

import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, DataError, DataWarning, error_text, listed, printable
from coopenv.base.installation import install_command, needing
from coopenv.cars.backend.sources import metadata_names
from coopenv.cars.settings.profile import COMPRESSED
from coopenv.sources.mcap_format import MAGIC, REPAIR

with needing(f"ROS bags need an extra: {install_command('log')}"):
    from coopenv.cars.bags.definitions import BagChannel, decode, stamp, with_raw_frame
    from coopenv.cars.bags.reader import ReaderError, in_reader
    from coopenv.cars.bags.streams import Part, blocks_of
    from coopenv.sources.mcap_container import TooLargeError

METADATA, PACKED = "metadata.yaml", ".zstd"
OURS = "coopenv"
"""Name of the metadata of recordings."""

REPAIRS = {
    ".bag": (b"#ROSBAG V2.0", "rosbag reindex"),
    ".db3": (b"SQLite format 3", "sqlite3 FILE .recover"),
    ".mcap": (MAGIC, REPAIR),
}
"""First bytes of a bag, and the repair tool for one with a truncated recording, by the suffix of the file."""

LATEST = 4 * 10**18  # ns, in 2096: sums of two such times fit into 64 bits
MOST_DEFINITIONS = 32  # of a topic; each is compiled
YEAR = 10**9 * 86_400 * 365  # ns


class BagFile:
    """An open bag; a context manager."""

    def __init__(self, path: Path, colours: bool = False) -> None:
        """Open a bag; compressed frames are decoded with colours or in shades of grey.

        Raises:
            DataError: no such bag, none at all, or damaged beyond reading.
        """
        self.path, self._colours = path, colours
        if not path.exists():
            raise DataError(f"no such bag: {path}")
        if path.is_file() and path.suffix not in REPAIRS:
            raise DataError(f"{path}: no bag, expected a folder or one of {', '.join(REPAIRS)}")
        self._stack = ExitStack()
        inside = [path] if path.is_file() else [part for part in sorted(path.iterdir()) if part.is_file()]
        bags = [part for part in inside if Path(part.name.removesuffix(PACKED)).suffix in REPAIRS]
        self._files = [part for part in bags if part == path or part.name[0] != "."]
        if not self._files and not any(part.name == METADATA for part in inside):
            raise DataError(f"{path}: a folder without {METADATA}, which a bag of ROS 2 has")
        try:
            self._parts = self._opened()
        except Exception as error:  # any error of the library at a malformed file
            self._stack.close()
            raise error if isinstance(error, CoopenvError) else self._unreadable(error) from None
        counts = sum((part.counts for part in self._parts), Counter())
        self.channels = frozenset(channel for channel in counts if channel.readable)
        self.topics: dict[str, str] = {}
        """Type of every topic that can be read; empty where messages of several types came on it."""
        self.counts = Counter[str]()
        for channel in sorted(self.channels):
            same = self.topics.get(channel.topic, channel.kind) == channel.kind
            self.topics[channel.topic] = channel.kind if same else ""
            self.counts[channel.topic] += counts[channel]
        begin, end = min(part.start_time for part in self._parts), max(part.end_time for part in self._parts)
        self.seconds = max(0.0, (end - begin) * 1e-9)
        """Between its first and its last message."""
        self.dated = end > YEAR
        """Whether messages were received by a clock that was set, so that 0 is no time."""
        self._warn(sorted({printable(f"{c.topic} ({c.encoding})") for c in counts if not c.readable}))

    def __enter__(self) -> Self:
        """Return the bag."""
        return self

    def __exit__(self, *unused: object) -> None:
        """Close the file."""
        self._stack.close()

    def _opened(self) -> list[Part]:
        """Return the files with messages. Raises an error of the libraries, or that of a file without any message."""
        files = [self._unpacked(file) if file.suffix == PACKED else file for file in self._files]
        if not files:
            raise ValueError("no file with messages is beside its metadata")
        if any(file.suffix == ".mcap" and OURS in (metadata_names(file) or ()) for file in files):
            raise DataError(f"{self.path}: no bag; coopenv run reads a recording of coopenv")
        parts = [Part(file) for file in files]
        error = next((part.error for part in parts if part.error), None)
        if error is not None and not any(part.counts.total() for part in parts):
            raise error
        return parts

    def _unpacked(self, file: Path) -> Path:
        """Return a copy of a packed file that is unpacked, until the bag is closed. Raises TooLargeError."""
        place = Path(self._stack.enter_context(tempfile.TemporaryDirectory()), file.name.removesuffix(PACKED))
        with place.open("wb") as out:
            for _, _, block in in_reader(partial(blocks_of, file), file.stat().st_size):
                out.write(block or b"")
        return place

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Yield topic, time of reception (ns, recorder's clock) and decoder of messages of some topics, as they stand.

        Messages of a file that breaks off, or a part of which is damaged, are those before; a DataWarning was given.
        The decoder raises CoopenvError: the message makes no sense.
        """
        for topic, count in Counter(c.topic for c in self.channels if c.topic in topics).items():
            if count > MOST_DEFINITIONS:
                raise DataError(f"{self.path}: {printable(topic)} has over {MOST_DEFINITIONS} types and definitions")
        for channel, received, data in self._raw(topics, frames=True):
            yield channel.topic, received, partial(decode, channel, data)

    def times(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Return stamps (0: none) and times of reception (n,), ns, of the messages of every topic."""
        found: dict[str, list[tuple[int, int]]] = {name: [] for name in self.topics}
        for channel, received, data in self._raw(self.topics):
            found[channel.topic].append((stamp(channel, data), received))
        ordered = {name: sorted(rows, key=itemgetter(1)) for name, rows in found.items()}
        tables = {name: np.array(rows, np.int64).reshape(-1, 2).T for name, rows in ordered.items()}
        return {name: (stamps, received) for name, (stamps, received) in tables.items()}

    def _raw(self, topics: Collection[str], frames: bool = False) -> Iterator[tuple[BagChannel, int, bytes]]:
        """Yield channel, time of reception and bytes of messages; with `frames` compressed ones as raw ones."""
        wanted = {channel for channel in self.channels if channel.topic in topics}
        if not wanted:
            return
        size = sum(part.path.stat().st_size for part in self._parts)
        try:
            for channel, received, data in in_reader(lambda: self._merged(wanted, frames), size):
                if 0 <= received < LATEST:
                    yield channel, received, data or b""
                else:
                    text = f"topic {channel.topic}: messages are left out that were received after 2096"
                    warnings.warn(f"{self.path}: {text}", DataWarning, stacklevel=3)
        except (ReaderError, TooLargeError) as error:
            raise DataError(f"{self.path}: {str(error) or type(error).__name__}") from None

    def _merged(self, wanted: Collection[BagChannel], frames: bool) -> Iterator[tuple[BagChannel, int, bytes]]:
        """Yield the messages of all parts, in the reader process."""
        for channel, received, data in merge(*(part.messages(wanted) for part in self._parts), key=itemgetter(1)):
            if frames and channel.kind == COMPRESSED:
                yield with_raw_frame(channel, received, data, self._colours)
            else:
                yield channel, received, data

    def _warn(self, others: Sequence[str]) -> None:
        """Warn of parts that are damaged, and of channels that are left out because of their encoding.

        Raises DataError: there are no other channels.
        """
        for part in self._parts:
            if part.error is not None:
                seconds = max(0.0, (part.end_time - part.start_time) * 1e-9)
                text = f"damaged after {seconds:.1f} s ({error_text(part.error)}); what came before it is used"
                where = self.path if self.path.is_file() else self.path / part.path.name
                warnings.warn(f"{where}: {text}", DataWarning, stacklevel=3)
        text = f"left out, since their messages have no encoding of ROS (cdr, ros1): {listed(others)}"
        if others and not self.channels:
            raise DataError(f"{self.path}: no topics of ROS; {text}")
        if others:
            warnings.warn(f"{self.path}: {text}", DataWarning, stacklevel=3)

    def _unreadable(self, error: Exception) -> DataError:
        if isinstance(error, TooLargeError):
            return DataError(f"{self.path}: {error}")
        hint = ""
        for file in self._files:
            begin, repair = REPAIRS.get(file.suffix, (b"", ""))
            with file.open("rb") as stream:
                if repair and stream.read(len(begin)) == begin:
                    hint = f"; if its recording was cut off, `{repair}` mends it"
        return DataError(f"{self.path}: cannot be read as a ROS bag ({error_text(error)}){hint}")
