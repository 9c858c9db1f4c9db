"""Robots of MR.CLAM as records of the benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from coopenv.bench.observers.sources import RecordSource, already_warned
from coopenv.mrclam.source import MRCLAM
from coopenv.observers.recording import Recording
from coopenv.sources.selection import WHOLE, Selection
from coopenv.sources.sources import open_recording


@dataclass(frozen=True)
class Robots(RecordSource):
    """A sub-dataset of MR.CLAM."""

    data: Path | None
    """The folder with the data; None: the environment variable COOPENV_DATA."""
    selection: Selection = WHOLE
    named: ClassVar[Mapping[str, str]] = MRCLAM.variants
    usual: ClassVar[tuple[str, ...]] = tuple(MRCLAM.variants)
    windowed: ClassVar[bool] = False

    def world(self) -> Recording:
        """Return the robots' record."""
        return open_recording(self.name, self.data, None, self.selection)

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the robots' record in a variant."""
        with already_warned():
            return open_recording(self.name, self.data, variant, self.selection)
