"""What a compressed file may unpack to: the one limit of recordings and of ROS bags.

Needs the extra `log`.
"""

import bz2

import zstandard
from lz4.frame import LZ4FrameDecompressor

from coopenv.base.errors import shown

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
            claimed: bytes that it says to unpack to (0: unknown); a chunk that claims too much is not touched.

        Raises:
            TooLargeError: it unpacks to more than `AT_ONCE`, or than is left for the file.
            ValueError: its compression is none of these; other errors are the library's.
        """
        limit = min(AT_ONCE, self.left)
        size = claimed
        if compression == "zstd":  # whose frames have a say of their own; -1 if not
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
