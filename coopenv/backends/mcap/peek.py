"""What an MCAP file says of itself before its data, read without the library."""

import struct
from pathlib import Path

MAGIC = b"\x89MCAP0\r\n"
METADATA, ATTACHMENT, HEADER = 0x0C, 0x09, 0x01
MOST_RECORDS = 16

CUT_OFF = "cut off, the end of the MCAP file is missing"
REPAIR = "mcap recover"
"""The tool that mends such a file."""
MENDED = f"`{REPAIR}` mends it"


def is_cut_off(path: Path) -> bool:
    """Return whether a file begins as an MCAP file and does not end as one."""
    with path.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return False
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MAGIC)))
        return size < 2 * len(MAGIC) or stream.read() != MAGIC


def metadata_names(path: str | Path) -> frozenset[str] | None:
    """Return the names of the metadata that stand before a file's data; None: it cannot be read or is no MCAP file."""
    names = set()
    try:
        with Path(path).open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            for _ in range(MOST_RECORDS):
                kind, size = struct.unpack("<BQ", stream.read(9))
                if kind == METADATA:
                    (length,) = struct.unpack("<I", stream.read(4))
                    names.add(stream.read(min(length, 256)).decode("utf-8", "replace"))
                    stream.seek(size - 4 - min(length, 256), 1)
                elif kind in (HEADER, ATTACHMENT):
                    stream.seek(size, 1)
                else:
                    break
    except (OSError, ValueError, OverflowError, struct.error):  # cut off within its first records
        return frozenset(names) if names else None
    return frozenset(names)
