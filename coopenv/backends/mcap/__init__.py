"""Recordings as MCAP files, the log format that Foxglove opens."""

from coopenv.backends.mcap.format import View
from coopenv.backends.mcap.recordings import check_target, read_recording, write_recording

__all__ = ["View", "check_target", "read_recording", "write_recording"]
