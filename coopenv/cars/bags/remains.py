"""What is left of a bag whose recording broke off: its messages in the order of the file, without an index.

`Remains` takes the place of the readers of rosbags. A file may break off within a chunk, of which what can be unpacked
counts as well.
"""

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Self

import apsw
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat, TopicInfo
from rosbags.rosbag1.reader import Header, RecordType, normalize, read_uint32
from rosbags.typesys.msg import normalize_msgtype

from coopenv.backends.mcap.container import Allowance, TooLargeError
from coopenv.backends.mcap.format import MAGIC, is_cut_off

FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}


def ends_early(path: Path) -> bool:
    """Return whether the end of a file of MCAP or SQLite is missing, as far as its length and last bytes show."""
    if path.suffix == ".db3":  # the size of its pages is a big-endian number, 1 for 65536
        with path.open("rb") as stream:
            page = int.from_bytes(stream.read(18)[16:])
        return path.stat().st_size % (65_536 if page == 1 else max(page, 1)) != 0
    return path.suffix == ".mcap" and is_cut_off(path)


Entries = Iterator[tuple[tuple[str, str, str, str], int, bytes]]
"""Messages: (topic, type, encoding of its definition, definition), time of reception (ns), bytes."""


class Remains:
    """A file as far as it goes, as the readers of rosbags."""

    def __init__(self, path: Path) -> None:
        """Take a file that ends with .bag, .db3 or .mcap."""
        self.path = path
        self.start_time, self.end_time = 2**63 - 1, 0

    def __enter__(self) -> Self:
        """Go through the file once. Raises TooLargeError: it unpacks to too much."""
        counts: Counter[tuple[str, str, str, str]] = Counter()
        for about, received, _ in self._entries():
            counts[about] += 1
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
            if (connection := wanted.get(about[:2])) is not None:
                yield connection, received, data

    def _entries(self) -> Entries:
        """Yield messages up to where the file makes no sense."""
        try:
            yield from FORMS[self.path.suffix](self.path, Allowance(self.path.stat().st_size))
        except TooLargeError:
            raise
        except Exception:  # whatever the libraries raise where a file breaks off
            return


def _of_mcap(path: Path, allowance: Allowance) -> Entries:
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    with path.open("rb") as stream:
        stream.read(len(MAGIC))
        for record in _mcap_records(stream, allowance):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            else:
                channel = channels[record.channel_id]
                schema = schemas[channel.schema_id]
                about = channel.topic, schema.name, schema.encoding, schema.data.decode()
                yield about, record.log_time, record.data


def _mcap_records(stream: BinaryIO, allowance: Allowance) -> Iterator[Any]:
    """Yield schemas, channels and messages, also of the chunk in which a file breaks off."""
    while len(head := stream.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", head)
        body = stream.read(length)
        fields = ReadDataStream(BytesIO(body))
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(fields)
            unpacked = allowance.unpack(chunk.compression, chunk.data, chunk.uncompressed_size)
            yield from _mcap_records(BytesIO(unpacked), allowance)
        if len(body) < length or opcode == Opcode.DATA_END:
            return
        if opcode == Opcode.MESSAGE:
            yield Message.read(fields, length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield (Schema if opcode == Opcode.SCHEMA else Channel).read(fields)


class _File(apsw.VFSFile):
    """A file beyond whose end nothing is read; SQLite would take zeros."""

    def xRead(self, amount: int, offset: int) -> bytes:  # noqa: N802
        """Return bytes. Raises IOError: there are not so many."""
        data = super().xRead(amount, offset)
        if len(data) < amount:
            raise apsw.IOError("the file ends here")
        return data


VFS = "coopenv-remains"


class _Files(apsw.VFS):
    def __init__(self) -> None:
        super().__init__(VFS, "")

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: N802
        return _File("", name, flags)


def _of_sqlite3(path: Path, _: Allowance) -> Entries:
    files, flags = _Files(), apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    database = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags, vfs=VFS)
    try:
        database.pragma("writable_schema", True)  # or it refuses files that are shorter than their header states
        texts: dict[str, tuple[str, str]] = {}
        if database.table_exists(None, "message_definitions"):
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            texts = {kind: (encoding, text) for kind, encoding, text in database.execute(query)}
        topics = {key: about for key, *about in database.execute("SELECT id, name, type FROM topics")}
        for topic, received, data in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
            name, kind = topics[topic]
            yield (name, kind, *texts.get(kind, ("", ""))), received, data
    finally:
        database.close()
        files.unregister()


def _of_ros1(path: Path, allowance: Allowance) -> Entries:
    known: dict[int, tuple[str, str, str, str]] = {}
    with path.open("rb") as stream:
        stream.readline()
        for header, data in _ros1_records(stream, allowance):
            number = header.get_uint32("conn")
            if header.get_uint8("op") == RecordType.CONNECTION:
                about = Header.read(BytesIO(struct.pack("<I", len(data)) + data))
                kind = normalize_msgtype(about.get_string("type"))
                topic, text = normalize(header.get_string("topic")), about.get_string("message_definition")
                known[number] = topic, kind, "ros2msg", text
            else:
                yield known[number], header.get_time("time"), data


def _ros1_records(stream: BinaryIO, allowance: Allowance) -> Iterator[tuple[Any, bytes]]:
    """Yield header and data of connections and messages, also of the chunk in which a file breaks off."""
    while stream.read(1):
        stream.seek(-1, SEEK_CUR)
        header = Header.read(stream)
        op, size = header.get_uint8("op"), read_uint32(stream)
        data = stream.read(size)
        if op == RecordType.CHUNK:
            unpacked = allowance.unpack(header.get_string("compression"), data, header.get_uint32("size"))
            yield from _ros1_records(BytesIO(unpacked), allowance)
        if len(data) < size:
            return
        if op in (RecordType.CONNECTION, RecordType.MSGDATA):
            yield header, data


FORMS: dict[str, Callable[[Path, Allowance], Entries]] = {
    ".mcap": _of_mcap,
    ".db3": _of_sqlite3,
    ".bag": _of_ros1,
}
