"""A table of what is in bags, topic by topic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coopenv.backends.bags.clocks import Clocks
from coopenv.backends.bags.files import BagFile
from coopenv.backends.bags.selection import Chosen
from coopenv.svea.samples import Sample


@dataclass(frozen=True)
class Row:
    """A topic; what is not known is None."""

    topic: str
    type: str
    messages: int
    rate: float | None  # Hz
    car: str | None = None  # that it was read for
    role: str | None = None
    used: int | None = None  # messages
    gap: float | None = None  # s, the longest between two
    gaps: int | None = None  # pauses of more than three times the usual period
    offset: float | None = None  # s by which its clock is behind the recorder's


def rows_of(
    files: Sequence[BagFile],
    chosen: Mapping[str, Chosen] | None = None,
    samples: Sequence[Sample] = (),
    clocks: Clocks | None = None,
) -> tuple[Row, ...]:
    """Return a row per topic, those that are read before the others."""
    names = sorted(
        {name for file in files for name in file.topics}, key=lambda name: (name not in (chosen or {}), name)
    )
    times: dict[tuple[str, str], list[int]] = {}
    for sample in samples:
        times.setdefault((sample.car, sample.role), []).append(sample.stamp)
    rows = []
    for name in names:
        kind = next(file.topics[name] for file in files if name in file.topics)
        count = sum(file.counts.get(name, 0) for file in files)
        seconds = max(file.seconds for file in files if name in file.topics)
        entry = (chosen or {}).get(name)
        if entry is None or clocks is None:
            rows.append(Row(name, kind, count, (count - 1) / seconds if count > 1 and seconds > 0.0 else None))
            continue
        stamps = np.array(times.get((entry.car, entry.told_as), []), dtype=np.int64)
        shift = clocks.shifts.get(entry.source)
        offset = None if shift is None or not shift.linked else shift.offset * 1e-9
        rate, gap, gaps = regularity(stamps)
        rows.append(Row(name, kind, count, rate, entry.car, entry.role.value, len(stamps), gap, gaps, offset))
    return tuple(rows)


def regularity(stamps: np.ndarray) -> tuple[float | None, float | None, int | None]:
    """Return the rate in Hz, the longest gap in s and the number of gaps over three median periods of stamps in ns."""
    steps = np.diff(stamps) * 1e-9
    if not len(steps) or steps.sum() <= 0.0:
        return None, None, None
    return float(len(steps) / steps.sum()), float(steps.max()), int((steps > 3.0 * np.median(steps)).sum())
