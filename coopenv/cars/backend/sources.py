"""Cars as sources of ticks: on a network, in a recorded drive, in ROS bags, and in rendered frames.

Rows of the table of sources, which are read whenever a name is looked up: all else loads on first use.
"""

from __future__ import annotations

import struct
from pathlib import Path

from coopenv.base.errors import regular
from coopenv.base.installation import BAGS
from coopenv.sources.registry import LOG_SUFFIX, SourceKind, no_name

_METADATA, _ATTACHMENT, _HEADER = 0x0C, 0x09, 0x01  # records of MCAP
MOST_RECORDS = 16

DRIVE_METADATA = "coopenv-drive"
"""Name of the metadata of drives."""
OURS = {"coopenv", DRIVE_METADATA}
"""Names of the metadata of MCAP files that are no bags of others."""


def is_bag(name: str, topics: str | Path | None = None) -> bool:
    """Return whether a name is that of a ROS bag; of MCAP files it is whatever coopenv has not written.

    With the map of its topics given it is one as well if it cannot be read, if it is a folder, and if it is a drive of
    cars: that is both.
    """
    if name.endswith(BAGS):
        return True
    if name.endswith(LOG_SUFFIX):
        metadata = metadata_names(name)
        if metadata is None or DRIVE_METADATA in metadata:
            return topics is not None
        return not metadata & OURS
    try:
        return (Path(name) / "metadata.yaml").is_file() or (topics is not None and Path(name).is_dir())
    except (OSError, ValueError):  # no valid path
        return False


def is_drive(name: str, topics: str | Path | None = None) -> bool:
    """Return whether a file is a recorded drive; False where it cannot be read, or with a map, as which it is a bag."""
    return topics is None and name.endswith(LOG_SUFFIX) and DRIVE_METADATA in (metadata_names(name) or ())


def metadata_names(path: str | Path) -> frozenset[str] | None:
    """Return the names of the metadata that stand before a file's data; None: it cannot be read or is no MCAP file."""
    from coopenv.sources.mcap_format import MAGIC  # which other commands do not need

    names = set()
    try:
        with regular(path).open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            for _ in range(MOST_RECORDS):
                kind, size = struct.unpack("<BQ", stream.read(9))
                if kind == _METADATA:
                    (length,) = struct.unpack("<I", stream.read(4))
                    names.add(stream.read(min(length, 256)).decode("utf-8", "replace"))
                    stream.seek(size - 4 - min(length, 256), 1)
                elif kind in (_HEADER, _ATTACHMENT):
                    stream.seek(size, 1)
                else:
                    break
    except (OSError, ValueError, OverflowError, struct.error):  # cut off within its first records
        return frozenset(names) if names else None
    return frozenset(names)


SVEA = SourceKind(
    title="driven by cars",
    opener="coopenv.cars.backend.backend:open_cars",
    claims=no_name,
    options=("deployment", "car", "record", "connect", "watch"),
)
BAG = SourceKind(
    title="a ROS bag",
    opener="coopenv.cars.bags.bag:open_bags",
    claims=is_bag,
    options=("topics", "selection"),
    recorded=True,
    conversion="coopenv import",
    writers={"ros2": "coopenv.cars.bags.ros2:export_bag"},
)
DRIVE = SourceKind(
    title="a drive of cars, which --map opens as a bag",
    opener="coopenv.cars.backend.recorded_drive:Drive",
    claims=is_drive,
    recorded=True,
    reader="coopenv.sources.sources:read_log",
)
IMAGES = SourceKind(title="rendered", claims=no_name, simulation="coopenv.cars.fake.frames:Rendered")
