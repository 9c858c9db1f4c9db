"""The records of an MCAP file, and the limit of what compressed files may unpack to. Needs the extra `log`."""

import bz2
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import nullcontext, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema

from coopenv.base.errors import DataError, check_memory, regular, shown
from coopenv.sources.mcap_format import CUT_OFF, MAGIC, MENDED, is_cut_off

AT_ONCE = 32 * 2**20
"""Bytes that a chunk, or a message, may unpack to: a raw 4K image fits. Writers of logs make chunks of about 1 MiB."""
EXPANSION = 50
"""Times that a whole file may grow when it is unpacked, beyond one such chunk; recordings expand 3 to 10 times."""


class TooLargeError(ValueError):
    """Something would unpack to more than its file may."""


class Allowance:
    """The bytes that a file may still unpack to."""

    def __init__(self, packed: int, expansion: int = EXPANSION) -> None:
        """Begin with that of a file of so many bytes, which may grow by a factor."""
        self.left, self._expansion = AT_ONCE + expansion * packed, expansion

    def take(self, size: int) -> None:
        """Count bytes that have been unpacked. Raises TooLargeError: there were not so many left."""
        self.left -= size
        if self.left < 0:
            raise TooLargeError(f"would unpack to more than {self._expansion} times its size")

    def unpack(self, compression: str, data: bytes, claimed: int = 0) -> bytes:
        """Return a chunk unpacked, without the memory for more than is allowed.

        Args:
            compression: "zstd", "lz4", "bz2", or "" or "none" for none.
            data: the chunk.
            claimed: stated size after unpacking, bytes (0: unknown); a chunk that claims too much is not touched.

        Raises:
            TooLargeError: it unpacks to more than `AT_ONCE`, or than is left for the file.
            ValueError: its compression is none of these; other errors are the library's.
        """
        limit = min(AT_ONCE, self.left)
        size = claimed
        if compression == "zstd":  # whose frames may state their size; -1 if not
            size = max(claimed, zstandard.frame_content_size(data))
        if size <= limit:
            unpacked = _first(compression, data, (claimed or limit) + 1)
            size = max(size, len(unpacked))
        if size > limit:
            raise TooLargeError(f"a chunk of {len(data)} bytes would unpack to {size}, more than {limit}")
        self.take(size)
        return unpacked


def _first(compression: str, data: bytes, most: int) -> bytes:
    """Return at most so many bytes of what a chunk unpacks to."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True).read(most)
    if compression == "lz4":
        return bytes(LZ4FrameDecompressor().decompress(data, max_length=most))
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data, most)
    if compression in ("", "none"):
        return data[:most]
    raise ValueError(f"unknown compression {shown(compression)}")


KINDS: dict[int, Any] = {
    **{Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel},
    **{Opcode.ATTACHMENT: Attachment, Opcode.METADATA: Metadata},
}
"""Classes of the records that are read as they stand."""


def records_of(stream: BinaryIO, most: int, allowance: Allowance | None, of_others: bool = False) -> Iterator[Any]:
    """Yield the records of a file's data behind its magic, or of a chunk.

    Args:
        stream: of the records.
        most: largest length of a record, bytes.
        allowance: what chunks may unpack to, whose records come instead of them; None: they are left out.
        of_others: of a bag, of which metadata and attachments, and records that make no sense, are left out.

    Raises:
        EOFError: it breaks off. Of a chunk in which it does, what there is has been yielded.
        ValueError: a record is too long, a chunk is damaged or unpacks to too much; other errors are the library's.
    """
    while head := stream.read(9):
        opcode, length = struct.unpack("<BQ", head)
        if length > most:
            name = Opcode(opcode).name if opcode in list(Opcode) else f"unknown ({opcode})"
            raise ValueError(f"{name} record has length {length} that exceeds limit {most}")
        body = stream.read(length)
        if opcode == Opcode.CHUNK and allowance is not None:
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            data = allowance.unpack(chunk.compression, chunk.data, chunk.uncompressed_size)
            whole = len(data) == chunk.uncompressed_size
            if whole and chunk.uncompressed_crc not in (0, zlib.crc32(data)):
                raise ValueError("a chunk is damaged, its check sum differs")
            with nullcontext() if whole else suppress(EOFError, struct.error):
                yield from records_of(BytesIO(data), len(data), allowance, of_others)
            if not whole:
                raise ValueError(f"a chunk unpacks to {len(data)} bytes, not to the stated {chunk.uncompressed_size}")
        if len(body) < length:
            raise EOFError(CUT_OFF)
        if of_others and not _sensible(opcode, body):
            continue
        if opcode == Opcode.MESSAGE:  # the library reads a message number by number, which takes five times as long
            channel, sequence, logged, published = struct.unpack_from("<HIQQ", body)
            yield Message(channel, logged, body[22:], published, sequence)
        elif opcode in KINDS:
            yield KINDS[opcode].read(ReadDataStream(BytesIO(body)))
        elif opcode == Opcode.DATA_END:
            return


def _sensible(opcode: int, body: bytes) -> bool:
    """Return whether a record of a bag concerns its messages and can be read."""
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return opcode not in KINDS and (opcode != Opcode.MESSAGE or len(body) >= 22)
    with suppress(Exception):  # any error of the library at malformed bytes
        KINDS[opcode].read(ReadDataStream(BytesIO(body)))
        return True
    return False


def messages_of(
    records: Iterable[Any], of_others: bool = False
) -> Iterator[tuple[Channel, Schema | None, Message | None]]:
    """Yield messages in their order, each with its channel and the schema of that; a channel, too, as it is described.

    Raises ValueError: a message has no channel, unless it is that of a bag.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
            yield record, schemas.get(record.schema_id), None
        elif isinstance(record, Message):
            if record.channel_id not in channels:
                if of_others:
                    continue
                raise ValueError(f"a message's channel {record.channel_id} is not described")
            channel = channels[record.channel_id]
            yield channel, schemas.get(channel.schema_id), record


class Container:
    """An MCAP file in memory, read from begin to end; the index behind its data is not needed."""

    def __init__(self, path: Path, truncated: bool = False) -> None:
        """Read a file; if `truncated`, the whole records of one that is cut off.

        Raises:
            DataError: it is no MCAP file, or cut off; other errors are the library's.
        """
        check_memory(path.stat().st_size, f"{path}:")
        self._data = regular(path).read_bytes()
        if not self._data.startswith(MAGIC):
            raise DataError(f"{path}: not an MCAP file (it does not begin as one)")
        self.cut_off = is_cut_off(path)
        """True if the end is missing."""
        if self.cut_off and not truncated:
            raise DataError(f"{path}: {CUT_OFF}; {MENDED}")

    def extras(self) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
        """Return the file's metadata and its attachments, by name."""
        records = list(self._records(None))
        metadata = {record.name: record.metadata for record in records if isinstance(record, Metadata)}
        return metadata, {record.name: record.data for record in records if isinstance(record, Attachment)}

    def topics(self) -> list[str]:
        """Return the names of all topics, sorted; errors as in `messages`."""
        described = messages_of(self._records(Allowance(len(self._data))))
        return sorted({channel.topic for channel, _, message in described if message is None})

    def messages(self) -> Iterator[tuple[Channel, Schema | None, Message]]:
        """Yield all messages in the order of the file, with their channels and the schemas of those.

        Raises ValueError: a chunk would unpack to too much, or a message has no channel. Others are the library's.
        """
        for channel, schema, message in messages_of(self._records(Allowance(len(self._data)))):
            if message is not None:
                yield channel, schema, message

    def _records(self, allowance: Allowance | None) -> Iterator[Any]:
        """Yield records up to where a file is cut off; there anything can be wrong with them."""
        try:
            yield from records_of(BytesIO(self._data[len(MAGIC) :]), len(self._data), allowance)
        except Exception:
            if not self.cut_off:
                raise
