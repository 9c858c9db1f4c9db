"""Replay: a recording in the place of the simulated world."""

from coopenv.backends.replay.backend import Replay

__all__ = ["Replay"]
