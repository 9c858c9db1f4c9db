"""The records of an MCAP file: the library reads them, but what a chunk unpacks to is checked before it is unpacked.

Needs the extra `log`.
"""

from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from itertools import takewhile
from pathlib import Path

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, MessageIndex, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from coopenv.backends.mcap.peek import CUT_OFF, MAGIC, MENDED
from coopenv.base.errors import DataError, check_memory

MAX_CHUNK_BYTES = 16 * 2**20  # unpacked; writers make chunks of about 1 MiB
MAX_EXPANSION = 50
"""Times that a whole file may grow when it is unpacked, beyond one such chunk; recordings expand 3 to 10 times."""


class Container:
    """An MCAP file, read from begin to end; the index behind its data says nothing that its records do not."""

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

        A ValueError says that a chunk would unpack to too much or a message has no channel; others are the library's.
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
        allowance = MAX_CHUNK_BYTES + MAX_EXPANSION * self._size
        for record in self._records:
            if isinstance(record, Chunk):
                data = _unpack(record, min(MAX_CHUNK_BYTES, allowance))
                allowance -= len(data)
                yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)
            else:
                yield record


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
    return data
