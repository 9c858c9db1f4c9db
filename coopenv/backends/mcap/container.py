"""The records of an MCAP file, one by one: every length is checked before anything is read, unpacked or allocated.

The library's own readers unpack a chunk to whatever size it claims. Needs the extra `log`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO, NamedTuple

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema

from coopenv.errors import DataError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of the contents
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, time of logging, time of publishing; data follow

MAX_CHUNK_BYTES = 16 * 2**20
"""Unpacked; writers make chunks of about 1 MiB."""
MAX_EXPANSION = 50
"""Times that a whole file may grow when it is unpacked, beyond one such chunk; recordings expand 3 to 10 times."""


class LoggedMessage(NamedTuple):
    """A message, and what the file says about its channel."""

    channel: Channel
    schema: Schema | None
    sequence: int
    data: bytes


class Container:
    """An MCAP file, read from begin to end; the index behind its data says nothing that its records do not."""

    def __init__(self, stream: IO[bytes], where: str) -> None:
        """Check both ends of the file, whose name `where` is.

        Raises:
            DataError: it is no MCAP file, or cut off.
        """
        self._stream = stream
        if stream.read(len(MAGIC)) != MAGIC:
            raise DataError(f"{where}: not an MCAP file (it does not begin as one)")
        self._end = stream.seek(0, 2) - len(MAGIC)
        stream.seek(max(0, self._end))
        if self._end < len(MAGIC) or stream.read() != MAGIC:
            raise DataError(f"{where}: cut off, the end of the MCAP file is missing")

    def extras(self) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
        """Return the file's metadata and its attachments, by name.

        Raises:
            ValueError: a record goes on beyond the end.
        """
        metadata, attachments = {}, {}
        for opcode, contents in self._records(Opcode.METADATA, Opcode.ATTACHMENT):
            if opcode == Opcode.METADATA:
                entry = Metadata.read(_stream(contents))
                metadata[entry.name] = entry.metadata
            else:
                attachment = Attachment.read(_stream(contents))
                attachments[attachment.name] = attachment.data
        return metadata, attachments

    def messages(self) -> Iterator[LoggedMessage]:
        """Yield all messages in the order of the file.

        Raises:
            ValueError: a record goes on beyond the end of its chunk or of the file, a chunk is damaged or would unpack
                to too much, or a message has no channel.
        """
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for opcode, contents in self._unpacked_records(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(contents))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(contents))
                channels[channel.id] = channel
            else:
                number, sequence, *_ = MESSAGE.unpack_from(contents)
                if number not in channels:
                    raise ValueError(f"a message's channel {number} is not described")
                channel = channels[number]
                yield LoggedMessage(channel, schemas.get(channel.schema_id), sequence, contents[MESSAGE.size :])

    def _records(self, *wanted: Opcode) -> Iterator[tuple[int, bytes]]:
        self._stream.seek(len(MAGIC))
        return _records_of(self._stream, self._end, wanted)

    def _unpacked_records(self, *wanted: Opcode) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and contents of records inside and outside of chunks."""
        allowance = MAX_CHUNK_BYTES + MAX_EXPANSION * self._end
        for opcode, contents in self._records(Opcode.CHUNK, *wanted):
            if opcode != Opcode.CHUNK:
                yield opcode, contents
                continue
            data = _unpack(Chunk.read(_stream(contents)), min(MAX_CHUNK_BYTES, allowance))
            allowance -= len(data)
            yield from _records_of(BytesIO(data), len(data), wanted)


def _stream(contents: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(contents))


def _records_of(stream: IO[bytes], end: int, wanted: tuple[Opcode, ...]) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and contents of the wanted records from here to a position, or to the end of the data section."""
    position = stream.tell()
    while position < end:
        opcode, length = RECORD.unpack(stream.read(RECORD.size).ljust(RECORD.size))
        position += RECORD.size + length
        if position > end:
            raise ValueError(f"a record of {length} bytes goes on beyond the end")
        if opcode == Opcode.DATA_END:
            return
        if opcode in wanted:
            yield opcode, stream.read(length)
        stream.seek(position)


def _unpack(chunk: Chunk, limit: int) -> bytes:
    """Return the records of a chunk; what it claims to unpack to is checked before any memory is taken."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":  # whose frames have a say of their own
        size = max(size, zstandard.frame_content_size(chunk.data))
    if size > limit:
        raise ValueError(f"a chunk of {len(chunk.data)} bytes would unpack to {size}, more than {limit}")
    if chunk.compression == "zstd":
        data = zstandard.decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r:.20}")
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk unpacks to {len(data)} bytes, not to {chunk.uncompressed_size} as it says")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("the check sum of a chunk differs")
    return data
