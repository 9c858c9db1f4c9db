"""The records of an MCAP file, and the limit of what compressed files may unpack to. Needs the extra `log`."""

import bz2
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from itertools import takewhile
from pathlib import Path

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, MessageIndex, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from coopenv.backends.mcap.format import CUT_OFF, MAGIC, MENDED
from coopenv.base.errors import DataError, check_memory, shown

AT_ONCE = 32 * 2**20
"""Bytes that a chunk, or a message, may unpack to: a raw 4K image fits. Writers of logs make chunks of about 1 MiB."""
EXPANSION = 50
"""Times that a whole file may grow when it is unpacked, beyond one such chunk; recordings expand 3 to 10 times."""


class TooLargeError(ValueError):
    """Something would unpack to more than its file may."""


class Allowance:
    """The bytes that a file may still unpack to."""

    def __init__(self, packed: int) -> None:
        """Begin with that of a file of so many bytes."""
        self.left = AT_ONCE + EXPANSION * packed

    def take(self, size: int) -> None:
        """Count bytes that have been unpacked. Raises TooLargeError: there were not so many left."""
        self.left -= size
        if self.left < 0:
            raise TooLargeError(f"would unpack to more than {EXPANSION} times its size")

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


class Container:
    """An MCAP file, read from begin to end; the index behind its data is not needed."""

    def __init__(self, path: Path, forgiving: bool = False) -> None:
        """Read a file; if `forgiving`, of one that is cut off what is whole.

        Raises:
            DataError: it is no MCAP file, or cut off; other errors are the library's.
        """
        check_memory(path.stat().st_size, f"{path}:")
        data = path.read_bytes()
        if not data.startswith(MAGIC):
            raise DataError(f"{path}: not an MCAP file (it does not begin as one)")
        self.cut_off = len(data) < 2 * len(MAGIC) or not data.endswith(MAGIC)
        """Whether the end is missing."""
        if self.cut_off and not forgiving:
            raise DataError(f"{path}: {CUT_OFF}; {MENDED}")
        records = StreamReader(BytesIO(data), emit_chunks=True, record_size_limit=len(data)).records
        section = takewhile(lambda record: not isinstance(record, DataEnd), self._whole(records))
        self._records = [record for record in section if not isinstance(record, MessageIndex)]
        self._size = len(data)

    def extras(self) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
        """Return the file's metadata and its attachments, by name."""
        metadata = {record.name: record.metadata for record in self._records if isinstance(record, Metadata)}
        return metadata, {record.name: record.data for record in self._records if isinstance(record, Attachment)}

    def messages(self) -> Iterator[tuple[Channel, Schema | None, Message]]:
        """Yield all messages in the order of the file, each with its channel and the schema of that.

        Raises ValueError: a chunk would unpack to too much, or a message has no channel. Others are the library's.
        """
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._whole(self._unpacked()):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                if record.channel_id not in channels:
                    raise ValueError(f"a message's channel {record.channel_id} is not described")
                channel = channels[record.channel_id]
                yield channel, schemas.get(channel.schema_id), record

    def _whole(self, records: Iterator[McapRecord]) -> Iterator[McapRecord]:
        """Yield records up to where a file is cut off; there anything can be wrong with them."""
        try:
            yield from records
        except Exception:
            if not self.cut_off:
                raise

    def _unpacked(self) -> Iterator[McapRecord]:
        """Yield the records inside and outside of chunks."""
        allowance = Allowance(self._size)
        for record in self._records:
            if isinstance(record, Chunk):
                data = allowance.unpack(record.compression, record.data, record.uncompressed_size)
                if len(data) != record.uncompressed_size:
                    raise ValueError(
                        f"a chunk unpacks to {len(data)} bytes, not to the stated {record.uncompressed_size}"
                    )
                yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)
            else:
                yield record
