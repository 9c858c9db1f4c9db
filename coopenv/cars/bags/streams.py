"""The messages of bag files in the order of the file, without an index, within limits of their unpacked size.

`Part` takes the place of the readers of rosbags. So a file whose recording broke off is read as far as it goes: it may
break off within a chunk, of which what can be unpacked counts as well.
"""

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Self

import apsw
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat, TopicInfo
from rosbags.rosbag1.reader import Header, RecordType, normalize, read_uint32
from rosbags.typesys.msg import normalize_msgtype

from coopenv.backends import mcap_container as container
from coopenv.backends.mcap_container import Allowance, TooLargeError, messages_of, records_of
from coopenv.backends.mcap_format import MAGIC, is_cut_off
from coopenv.base.errors import regular

FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
ENDS_EARLY = "its end is missing"
ZSTD = b"\x28\xb5\x2f\xfd"
"""Begin of a packed message; one of CDR begins with 0."""

About = tuple[str, str, str, str]
Entries = Iterator[tuple[About, int, bytes | None]]
"""Messages: (topic, type, encoding of its definition, definition), time of reception (ns), bytes; None: a topic."""


class Part:
    """A file, as the readers of rosbags."""

    def __init__(self, path: Path) -> None:
        """Take a file that ends with .bag, .db3 or .mcap."""
        self.path = path
        self.start_time, self.end_time = 2**63 - 1, 0
        self.error: Exception | None = None
        """Why it is read no further than it is."""

    def __enter__(self) -> Self:
        """Go through the file once. Raises TooLargeError: it unpacks to too much."""
        counts: Counter[About] = Counter()
        for about, received, data in self._entries():
            counts[about] += data is not None
            if data is not None:
                self.start_time, self.end_time = min(self.start_time, received), max(self.end_time, received)
        ext: Any = None
        self.connections = []
        for number, ((topic, kind, encoding, text), count) in enumerate(counts.items()):
            definition = MessageDefinition(FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)
            self.connections.append(Connection(number, topic, kind, definition, "", count, ext, self))
        self.topics = {c.topic: TopicInfo(c.msgtype, c.msgdef, c.msgcount, [c]) for c in self.connections}
        return self

    def __exit__(self, *unused: object) -> None:
        """Nothing is open."""

    def messages(self, connections: Collection[Any], **unused: object) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time of reception (ns) and bytes of messages."""
        wanted = {(c.topic, c.msgtype): c for c in connections}
        for about, received, data in self._entries():
            if data is not None and (connection := wanted.get(about[:2])) is not None:
                yield connection, received, data

    def _entries(self) -> Entries:
        """Yield messages up to where the file makes no sense."""
        allowance = Allowance(self.path.stat().st_size)
        try:
            for about, received, data in FORMS[self.path.suffix](self.path, allowance):
                yield about, received, allowance.unpack("zstd", data) if data and data[:4] == ZSTD else data
            if self.path.suffix == ".mcap" and is_cut_off(self.path):
                raise EOFError(ENDS_EARLY)
        except (TooLargeError, apsw.TooBigError) as error:
            raise TooLargeError(str(error)) from None
        except Exception as error:  # any error of the libraries at a truncated file
            self.error = error


def _of_mcap(path: Path, allowance: Allowance) -> Entries:
    with regular(path).open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise ValueError("not an MCAP file")
        records = records_of(stream, max(container.AT_ONCE, path.stat().st_size), allowance)
        for channel, schema, message in messages_of(records):
            if schema is None or channel.message_encoding != "cdr":
                raise ValueError(f"{channel.topic}: no messages of ROS 2 with their type")
            about = channel.topic, schema.name, schema.encoding, schema.data.decode()
            yield about, message.log_time if message else 0, message.data if message else None


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


def _of_sqlite3(path: Path, _: Allowance) -> Entries:
    files, flags = _Files(), apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    database = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags, vfs=VFS)
    database.limit(apsw.SQLITE_LIMIT_LENGTH, container.AT_ONCE)
    try:
        database.pragma("writable_schema", True)  # or it refuses files that are shorter than their header states
        for name, kind, text in database.execute("SELECT name, type, sql FROM sqlite_schema WHERE type != 'index'"):
            if name.lower() in TABLES and (kind != "table" or "VIRTUAL" in text.upper()):
                raise ValueError(f"{name} is no table")  # but a query, which may have no end
        texts: dict[str, tuple[str, str]] = {}
        if database.table_exists(None, "message_definitions"):
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            texts = {kind: (encoding, text) for kind, encoding, text in database.execute(query)}
        topics = {}
        for key, name, kind in database.execute("SELECT id, name, type FROM topics"):
            topics[key] = about = (name, kind, *texts.get(kind, ("", "")))
            yield about, 0, None
        valid = "typeof(data) = 'blob' AND typeof(timestamp) = 'integer'"  # others are damaged
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE {valid} ORDER BY id"
        for topic, received, data in database.execute(query):
            yield topics[topic], received, data
    finally:
        database.close()
        files.unregister()


def _of_ros1(path: Path, allowance: Allowance) -> Entries:
    known: dict[int, About] = {}
    with regular(path).open("rb") as stream:
        if not stream.readline(64).startswith(b"#ROSBAG V2.0"):
            raise ValueError("no bag of ROS 1")
        for header, data in _ros1_records(stream, allowance):
            number = header.get_uint32("conn")
            if header.get_uint8("op") == RecordType.CONNECTION:
                about = Header.read(BytesIO(struct.pack("<I", len(data)) + data))
                kind = normalize_msgtype(about.get_string("type"))
                topic, text = normalize(header.get_string("topic")), about.get_string("message_definition")
                known[number] = topic, kind, "ros2msg", text
                yield known[number], 0, None
            else:
                yield known[number], header.get_time("time"), data


def _ros1_records(stream: BinaryIO, allowance: Allowance) -> Iterator[tuple[Any, bytes]]:
    """Yield header and data of connections and messages, also of the chunk in which a file breaks off.

    Raises EOFError: it breaks off, or has not the table of chunks that is written last.
    """
    chunks = 0  # that are not in that table
    while stream.read(1):
        stream.seek(-1, SEEK_CUR)
        header = Header.read(stream)
        op, size = header.get_uint8("op"), read_uint32(stream)
        data = stream.read(size)
        chunks += (op == RecordType.CHUNK) - (op == RecordType.CHUNK_INFO)
        if op == RecordType.CHUNK:
            unpacked = allowance.unpack(header.get_string("compression"), data, header.get_uint32("size"))
            yield from _ros1_records(BytesIO(unpacked), allowance)
        if len(data) < size:
            break
        if op in (RecordType.CONNECTION, RecordType.MSGDATA):
            yield header, data
    else:
        if not chunks:
            return
    raise EOFError(ENDS_EARLY)


FORMS: dict[str, Callable[[Path, Allowance], Entries]] = {
    ".mcap": _of_mcap,
    ".db3": _of_sqlite3,
    ".bag": _of_ros1,
}
