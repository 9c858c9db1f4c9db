"""The messages of topics, and how their clocks come together.

Every message has two times: its stamp, by the clock of who sent it, and when it was received, by the clock of who
recorded it. A *source* is whose clock makes the stamps: a car, or motion capture, which is one source for all bodies,
or a topic whose delay is far from those of the other topics of its car.

- Within a file, a source's clock is behind the recorder's by the least (received - stamp) of its topics, the least
  time of transport included; wrong stamps are dropped. By no more than the tolerance, stamps stay what they are.
- Topics of a car that measure the same motion are brought together by it, see `clocks.py`.
- Files of different recorders are brought together by what they have in common. A source that stands in both, motion
  capture above all, is behind one recorder by d1 and behind the other by d2, so that the clocks of the recorders differ
  by d1 - d2. Files without anything in common with the others are merged by their stamps.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from coopenv.cars.bags.clocks import NO_CRYSTAL, Delay, checked, jumps
from coopenv.cars.bags.topic_map import Chosen
from coopenv.cars.bags.topics import NS
from coopenv.cars.doctor.finding import Finding, Treatment, with_error
from coopenv.cars.messages.readings import Sample

Delays = Mapping[str, int]
"""ns by which each source of a file is behind its recorder."""


@dataclass(frozen=True)
class Shift:
    """Correction of the stamps of a source."""

    offset: int | None  # ns by which its clock is behind that of the first recorder; None: not known
    added: int  # ns that are added to its stamps


@dataclass(frozen=True)
class Clocks:
    """Conversion of the times of a bag to one clock."""

    shifts: Mapping[str, Shift]  # by source
    recorders: tuple[int, ...]  # ns to add to the times of reception of each file


def reconcile(files: Sequence[Delays], tolerance: float, stated: Mapping[str, int]) -> Clocks:
    """Return the corrections of the times of every source and file.

    Args:
        files: delays of the sources of each file.
        tolerance: ns up to which clocks count as the same.
        stated: ns to add to the stamps of sources, by the map.
    """
    behind = recorders(files)
    found: dict[str, Shift] = {}
    for delays, recorder in zip(files, behind, strict=True):
        for source, delay in delays.items():
            offset = stated.get(source, None if recorder is None else delay + recorder)
            moved = offset is not None and (source in stated or abs(offset) > tolerance)
            found.setdefault(source, Shift(offset, offset if offset is not None and moved else 0))
    return Clocks(found, tuple(recorder or 0 for recorder in behind))


def recorders(files: Sequence[Delays]) -> list[int | None]:
    """Return the lag (ns) of each file's recorder behind the first one's; None: unknown."""
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


@dataclass
class Track:
    """The messages of one topic in one file, and why some were left out."""

    file: int  # its number
    chosen: Chosen
    entries: list[Sample] = field(default_factory=list)  # by the clocks of source and recorder; stamp 0: none
    refused: Counter[str] = field(default_factory=Counter)

    jumps: list[tuple[int, int]] = field(default_factory=list)  # first message after each, and ns that were added
    outlying: int = 0  # messages that were dropped for their stamps
    delay: Delay | None = None  # None: no message with a stamp
    source: str = ""  # source of the stamps' clock

    def date_undated(self) -> None:
        """Let messages whose time of reception is 0, before the recorder's clock was set, be received as the others."""
        dated = [entry for entry in self.entries if entry.received]
        usual = int(np.median([entry.received - entry.stamp for entry in dated if entry.stamp] or [0]))
        early = [e.at(e.stamp, e.stamp + usual) for e in self.entries if not e.received and e.stamp]
        self.refused["received at 0, without a stamp"] += len(self.entries) - len(dated) - len(early)
        self.refused, self.entries = +self.refused, early + dated

    def clean_stamps(self, mode: str) -> None:
        """Drop messages with wrong stamps, after jumps of the clock if a mode removes them; measure the delay."""
        self.entries.sort(key=lambda entry: entry.received)
        stamps, received = (
            np.array([getattr(e, name) for e in self.entries], np.int64) for name in ("stamp", "received")
        )
        given = stamps != 0
        self.jumps = list(jumps(stamps[given], received[given]).items()) if mode == "auto" else []
        for k, behind in self.jumps:
            stamps[np.flatnonzero(given)[k:]] += behind
        if self.jumps:
            self.entries = [e.at(int(s), e.received) for e, s in zip(self.entries, stamps, strict=True)]
        wrong, self.delay = checked(stamps, received)
        self.outlying += int(wrong.sum())
        self.entries = [entry for entry, off in zip(self.entries, wrong, strict=True) if not off]

    def behind(self, clocks: Clocks) -> float | None:
        """Return its lag (s) after its source's stamps were moved; None: unknown."""
        delay, shift = self.delay, clocks.shifts.get(self.source)
        if delay is None or shift is None or shift.offset is None:
            return None
        return (delay.offset + clocks.recorders[self.file] - shift.added) / NS

    def remove_drift(self, tolerance: float) -> float:
        """Remove the drift of its clock if that changes the offset by more than a tolerance, ns; return it, or 0."""
        if (delay := self.delay) is None:
            return 0.0
        if abs(delay.drift) * (self.entries[-1].received - self.entries[0].received) <= 2.0 * tolerance:
            return 0.0
        for k, entry in enumerate(self.entries):
            gained = round(delay.drift * (entry.received - delay.middle)) if entry.stamp else 0
            self.entries[k] = entry.at(entry.stamp + gained, entry.received)
        return delay.drift


APART = NS  # ns between the delays of two topics of a car beyond which they have different clocks


def delays_of(tracks: Sequence[Track], files: int, tolerance: float, stated: Collection[str] = ()) -> list[Delays]:
    """Return the lag (ns) of each source behind the recorder, for each of so many files; set the tracks' sources.

    Topics ahead of it by more than the tolerance, ns, do not count where others are not; those `stated` are sources.
    """
    found: list[dict[str, int]] = [{} for _ in range(files)]
    for file, source in {(track.file, track.chosen.source) for track in tracks}:
        own = [track for track in tracks if (track.file, track.chosen.source) == (file, source)]
        delays = sorted(track.delay.offset for track in own if track.delay is not None)
        usual = delays[(len(delays) - 1) // 2] if delays else 0
        for track in own:
            apart = track.delay is not None and abs(track.delay.offset - usual) > APART and source not in stated
            track.source = track.chosen.topic if apart or track.chosen.topic in stated else source
        for name in {track.source for track in own}:
            known = [track.delay.offset for track in own if track.source == name and track.delay is not None]
            if known:
                found[file][name] = min([delay for delay in known if delay >= -tolerance] or known)
    return [*found]


def samples_of(tracks: Sequence[Track], clocks: Clocks, moves: Mapping[str, int]) -> tuple[Sample, ...]:
    """Return the samples, each once, in the order of their stamps, to which `moves` are added by topic, ns."""
    found: dict[tuple[Chosen, int], Sample] = {}
    for track in tracks:
        added, recorder = clocks.shifts.get(track.source), clocks.recorders[track.file]
        moved = moves.get(track.chosen.topic, 0)
        for entry in track.entries:
            time = entry.stamp + added.added + moved if entry.stamp and added else entry.received + recorder
            found.setdefault((track.chosen, time), entry.at(time, time))
    return tuple(sorted(found.values(), key=lambda sample: sample.stamp))


REFINED = 3  # times that the rate is estimated: windows of a steep delay have a small error


def common_rate(tracks: Sequence[Track]) -> Finding | None:
    """Return the finding that all clocks run at another rate than the recorder's; times of reception get theirs.

    If all sources drift alike, their stamps are the time: of a simulation, or beside a recorder whose clock is wrong.
    """
    known = [track for track in tracks if track.delay is not None and len(track.entries) >= 100]
    drifts = np.array([track.delay.drift for track in known if track.delay is not None])
    if len(drifts) < 2 or abs(np.median(drifts)) < NO_CRYSTAL:
        return None
    spread = np.abs(drifts - np.median(drifts))
    if (spread > max(NO_CRYSTAL, 0.05 * abs(np.median(drifts)))).mean() > 0.2:
        return None
    begin, rate = min(track.entries[0].received for track in known), 1.0
    for _ in range(REFINED):
        step = 1.0 - float(np.median([track.delay.drift for track in known if track.delay is not None]))
        rate *= step
        for track in tracks:
            track.entries = [e.at(e.stamp, begin + round(step * (e.received - begin))) for e in track.entries]
            track.clean_stamps("stamps")
    error = float(np.std(drifts) / np.sqrt(len(drifts)))
    size = with_error(1e6 * (1.0 - rate), max(1.0, 1e6 * error))
    text = f"all {len(drifts)} topics drift alike, by {size} us per s: time runs {rate:.4g} times as fast in"
    text += " stamps as where they were received, as in a simulation; stamps count"
    return Finding("clocks", text, 1.0 - rate, error, treatment=Treatment.MENDED)
