"""One run of an environment: simulate and record it, judge it, write it down."""

from coopenv.runs.recording import Recording, record

__all__ = ["Recording", "record"]
