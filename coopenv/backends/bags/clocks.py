"""Clocks of a bag brought to one: that of the computer which recorded the first file.

Every message has two times: its stamp, by the clock of who sent it, and when it was received, by the clock of who
recorded it. A *source* is whose clock makes the stamps: a car, or motion capture, which is one source for all bodies.

- Within a file, a source's clock is behind the recorder's by the smallest (received - stamp) over the file, the least
  time that a message was on its way included. By no more than the tolerance, stamps stay what they are.
- Files of different recorders are brought together by what they have in common. A source that stands in both, motion
  capture above all, is behind one recorder by d1 and behind the other by d2, so that the clocks of the recorders differ
  by d1 - d2. Files without anything in common with the others are merged by their stamps: these are believed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Delays = Mapping[str, int]
"""ns by which each source of a file is behind its recorder: the smallest (received - stamp)."""


@dataclass(frozen=True)
class Shift:
    """What is done to the stamps of a source."""

    offset: int  # ns by which its clock is behind that of the first recorder, as far as is known
    added: int  # ns that are added to its stamps
    linked: bool = True  # whether it is known; False: stamps are believed


@dataclass(frozen=True)
class Clocks:
    """How times of a bag become those of one clock."""

    shifts: Mapping[str, Shift]  # by source
    recorders: tuple[int, ...]  # ns to add to the times of reception of each file


def reconcile(files: Sequence[Delays], tolerance: float, stated: Mapping[str, int]) -> Clocks:
    """Return what is to be added to the times of every source and file.

    Args:
        files: delays of the sources of each file.
        tolerance: ns up to which clocks count as the same.
        stated: ns to add to the stamps of sources of which somebody knows better.
    """
    behind = recorders(files)
    found: dict[str, Shift] = {}
    for delays, recorder in zip(files, behind, strict=True):
        for source, delay in delays.items():
            if source in found:
                continue
            if source in stated:
                found[source] = Shift(stated[source], stated[source])
            elif recorder is None:
                found[source] = Shift(0, 0, linked=False)
            else:
                offset = delay + recorder
                found[source] = Shift(offset, offset if abs(offset) > tolerance else 0)
    return Clocks(found, tuple(recorder or 0 for recorder in behind))


def recorders(files: Sequence[Delays]) -> list[int | None]:
    """Return by how many ns the recorder of each file is behind that of the first one; None: nobody knows."""
    behind: list[int | None] = [0, *(None for _ in files[1:])]
    known = [0]
    while known:
        i = known.pop()
        for j, delays in enumerate(files):
            common = [files[i][source] - delays[source] for source in files[i] if source in delays]
            here = behind[i]
            if behind[j] is None and common and here is not None:
                behind[j] = here + round(float(np.median(common)))
                known.append(j)
    return behind
