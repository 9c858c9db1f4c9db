"""Replay: a recording in the place of the simulated world."""

from coopenv.backends.replay.backend import Replay
from coopenv.backends.replay.source import is_recorded, open_recording

__all__ = ["Replay", "is_recorded", "open_recording"]
