"""The messages of bag files in the order of the file, without an index, within limits of their unpacked size.

A file whose recording broke off is read as far as it goes: it may break off within a chunk, of which what can be
unpacked counts as well. Channels that are not read have no effect on the others, whatever their encoding and contents.
"""

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import apsw
import zstandard

from coopenv.base.errors import regular
from coopenv.cars.bags.definitions import ROS1, BagChannel
from coopenv.cars.bags.reader import in_reader
from coopenv.sources import mcap_container as container
from coopenv.sources.mcap_container import Allowance, TooLargeError, messages_of, records_of
from coopenv.sources.mcap_format import MAGIC, is_cut_off

ENDS_EARLY = "its end is missing"
ZSTD = b"\x28\xb5\x2f\xfd"
"""Begin of a packed message; a message of CDR begins with 0."""
WHOLE = BagChannel("", "", "zstd")
"""Channel of the blocks of a packed file."""
MOST_CHANNELS = 2**16  # as many as an MCAP file has numbers for
EXPANSION = {".mcap": 1000, ".db3": 200, ".bag": 200}
"""Times that a bag may grow when it is unpacked: dark frames and empty maps, which no car needs, pack well."""
OVERHEAD, IN_MEMORY = 2.5, 10.0
"""Packed bytes of that allowance which a message takes for the time to pass over it, and for memory once it is read."""

Entries = Iterator[tuple[BagChannel, int, bytes | None]]
"""Messages: channel, time of reception (ns), bytes; None: the channel alone."""


class Part:
    """A file of a bag."""

    def __init__(self, path: Path) -> None:
        """Go through a file once that ends with .bag, .db3 or .mcap. Raises TooLargeError: it unpacks to too much."""
        self.path, self._growth = path, EXPANSION[path.suffix]
        self.start_time, self.end_time = 2**63 - 1, 0
        self.error: Exception | None = None
        """Why it is read no further than it is."""
        self.counts: Counter[BagChannel] = Counter()
        """Messages of every channel."""
        try:
            for channel, received, data in in_reader(self._without_contents, path.stat().st_size):
                self.counts[channel] += data is not None
                if data is not None and received:  # 0: before the recorder's clock was set
                    self.start_time, self.end_time = min(self.start_time, received), max(self.end_time, received)
                if len(self.counts) > MOST_CHANNELS:
                    raise TooLargeError(f"has more than {MOST_CHANNELS} topics")
        except TooLargeError:
            raise
        except Exception as error:  # any error of the libraries at a truncated file
            self.error = error

    def messages(self, wanted: Collection[BagChannel]) -> Iterator[tuple[BagChannel, int, bytes]]:
        """Yield channel, time of reception (ns) and bytes of the messages of some channels, up to a damaged part.

        Raises TooLargeError: the messages take too much memory.
        """
        allowance, growth = Allowance(self.path.stat().st_size, self._growth), self._growth
        try:
            for channel, received, data in self._entries():
                if data is not None and channel in wanted:
                    allowance.take(round(IN_MEMORY * growth))
                    yield channel, received, _unpacked(data, allowance) if data[:4] == ZSTD else data
        except (MemoryError, TooLargeError):
            raise
        except Exception:  # as it was noted when the file was opened
            return

    def _without_contents(self) -> Entries:
        return ((channel, received, data and b"") for channel, received, data in self._entries())

    def _entries(self) -> Entries:
        """Yield messages up to where the file makes no sense. Raises any error of the libraries."""
        allowance, growth = Allowance(self.path.stat().st_size, self._growth), self._growth
        try:
            for entry in FORMS[self.path.suffix](self.path, allowance):
                allowance.take(round(OVERHEAD * growth))
                yield entry
        except apsw.TooBigError as error:
            raise TooLargeError(str(error)) from None
        if self.path.suffix == ".mcap" and is_cut_off(self.path):
            raise EOFError(ENDS_EARLY)


def _unpacked(data: bytes, allowance: Allowance) -> bytes:
    """Return a packed message; an empty one if it is damaged. Raises TooLargeError."""
    try:
        return allowance.unpack("zstd", data)
    except TooLargeError:
        raise
    except Exception:  # any error of the library at malformed bytes
        return b""


def blocks_of(path: Path) -> Entries:
    """Yield the blocks of a packed file. Raises TooLargeError; other errors are the library's."""
    allowance = Allowance(path.stat().st_size)
    with regular(path).open("rb") as packed:
        for block in zstandard.ZstdDecompressor().read_to_iter(packed):
            allowance.take(len(block))
            yield WHOLE, 0, block


def _channel(topic: bytes, kind: bytes, encoding: str, language: str = "", definition: bytes = b"") -> BagChannel:
    """Return a channel by its texts; the full name of the type sensor_msgs/Imu is sensor_msgs/msg/Imu."""
    name, about, text = (part.decode(errors="replace") for part in (topic, kind, definition))
    package, _, last = about.rpartition("/")
    full = f"{package}/msg/{last}" if package and "/" not in package else about
    return BagChannel(name, full, encoding if full else "no type", language, text)


def _of_mcap(path: Path, allowance: Allowance) -> Entries:
    with regular(path).open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise ValueError("not an MCAP file")
        records = records_of(stream, max(container.AT_ONCE, path.stat().st_size), allowance, of_others=True)
        known: dict[int, BagChannel] = {}
        for channel, schema, message in messages_of(records, of_others=True):
            if message is None:
                name, language, text = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
                about = channel.topic.encode(), name.encode(), channel.message_encoding, language, text
                known[channel.id] = _channel(*about)
                yield known[channel.id], 0, None
            else:
                yield known[channel.id], message.log_time, message.data


class _File(apsw.VFSFile):
    """A file beyond whose end nothing is read; SQLite would take zeros."""

    def xRead(self, amount: int, offset: int) -> bytes:  # noqa: N802
        """Return bytes. Raises IOError: there are not so many."""
        data = super().xRead(amount, offset)
        if len(data) < amount:
            raise apsw.IOError(ENDS_EARLY)
        return data


VFS, TABLES = "coopenv-bags", ("topics", "messages", "message_definitions")


class _Files(apsw.VFS):
    def __init__(self) -> None:
        super().__init__(VFS, "")

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: N802
        return _File("", name, flags)


def _of_sqlite3(path: Path, allowance: Allowance) -> Entries:
    files, flags = _Files(), apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    database = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags, vfs=VFS)
    database.limit(apsw.SQLITE_LIMIT_LENGTH, container.AT_ONCE)
    try:
        database.pragma("writable_schema", True)  # or it refuses files that are shorter than their header states
        for name, kind, text in database.execute("SELECT name, type, sql FROM sqlite_schema WHERE type != 'index'"):
            if name.lower() in TABLES and (kind != "table" or "VIRTUAL" in text.upper()):
                raise ValueError(f"{name} is no table")  # but a query, which may have no end
        texts: dict[bytes, tuple[str, bytes]] = {}
        if database.table_exists(None, "message_definitions"):
            columns = "CAST(topic_type AS BLOB), CAST(encoding AS BLOB), CAST(encoded_message_definition AS BLOB)"
            rows = database.execute(f"SELECT {columns} FROM message_definitions")
            texts = {kind: ((language or b"").decode(errors="replace"), text or b"") for kind, language, text in rows}
        topics = {}
        columns = "id, CAST(name AS BLOB), CAST(type AS BLOB), CAST(serialization_format AS BLOB)"
        for key, name, kind, encoding in database.execute(f"SELECT {columns} FROM topics"):
            form = (encoding or b"").decode(errors="replace")
            topics[key] = _channel(name or b"", kind or b"", form, *texts.get(kind, ()))
            yield topics[key], 0, None
        valid = "typeof(data) = 'blob' AND typeof(timestamp) = 'integer'"  # others are damaged
        fitting = f"CASE WHEN length(data) <= {container.AT_ONCE} THEN data ELSE x'' END"
        query = f"SELECT topic_id, timestamp, {fitting} FROM messages WHERE {valid} ORDER BY id"
        for topic, received, data in database.execute(query):
            allowance.take(len(data))
            if topic in topics:
                yield topics[topic], received, data
    finally:
        database.close()
        files.unregister()


def _of_ros1(path: Path, allowance: Allowance) -> Entries:
    known: dict[int, BagChannel] = {}
    with regular(path).open("rb") as stream:
        if not stream.readline(64).startswith(b"#ROSBAG V2.0"):
            raise ValueError("no bag of ROS 1")
        for header, data in _ros1_records(stream, allowance, path.stat().st_size):
            with suppress(KeyError, struct.error):  # a record that makes no sense costs no other one anything
                (number,) = struct.unpack("<I", header[b"conn"])
                if header[b"op"] == CONNECTION:
                    about = _ros1_header(data)
                    topic = b"/" + b"/".join(part for part in header[b"topic"].split(b"/") if part)
                    text = about.get(b"message_definition", b"")
                    known[number] = _channel(topic, about.get(b"type", b""), ROS1, "ros1msg", text)
                    yield known[number], 0, None
                elif number in known:
                    seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                    yield known[number], seconds * 10**9 + nanoseconds, data


MESSAGE, CHUNK, CHUNK_INFO, CONNECTION = b"\x02", b"\x05", b"\x06", b"\x07"
"""Kinds of the records of ROS 1."""


def _ros1_header(data: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record's header."""
    fields, at = {}, 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        fields[name], at = value, at + 4 + size
    return fields


def _ros1_records(stream: BinaryIO, allowance: Allowance, most: int) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yield header and data of connections and messages, also of the chunk in which a file of `most` bytes breaks off.

    Raises EOFError: it breaks off, or has not the table of chunks that is written last.
    """
    chunks = 0  # that are not in that table
    while size := stream.read(4):
        header = _ros1_header(stream.read(min(most, *struct.unpack("<I", size))))
        op, (size,) = header.get(b"op"), struct.unpack("<I", stream.read(4))
        data = stream.read(min(most, size))
        chunks += (op == CHUNK) - (op == CHUNK_INFO)
        if op == CHUNK:
            (claimed,) = struct.unpack("<I", header[b"size"])
            unpacked = allowance.unpack(header[b"compression"].decode(), data, claimed)
            yield from _ros1_records(BytesIO(unpacked), allowance, len(unpacked))
        if len(data) < size:
            break
        if op in (CONNECTION, MESSAGE):
            yield header, data
    else:
        if not chunks:
            return
    raise EOFError(ENDS_EARLY)


FORMS: dict[str, Callable[[Path, Allowance], Entries]] = {".mcap": _of_mcap, ".db3": _of_sqlite3, ".bag": _of_ros1}
