"""Recordings as MCAP files, the log format that Foxglove opens."""

from coopenv.backends.mcap.format import View
from coopenv.backends.mcap.reader import read_recording
from coopenv.backends.mcap.writer import check_target, write_recording

__all__ = ["View", "check_target", "read_recording", "write_recording"]
