"""Everything that is read of one or several bags: samples of all cars on one clock, and a table of what there is.

Every message has two times: its stamp, by the clock of who sent it, and when it was received, by the clock of who
recorded it. A *source* is whose clock makes the stamps: a car, or motion capture, which is one source for all bodies.

- Within a file, a source's clock is behind the recorder's by the smallest (received - stamp) over the file, the least
  time that a message was on its way included. By no more than the tolerance, stamps stay what they are.
- Files of different recorders are brought together by what they have in common. A source that stands in both, motion
  capture above all, is behind one recorder by d1 and behind the other by d2, so that the clocks of the recorders differ
  by d1 - d2. Files without anything in common with the others are merged by their stamps.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, DataError
from coopenv.cars.backend.binding import Binding
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topic_map import Chosen, MapFrame, TopicMap, select
from coopenv.cars.codec import stamp_of
from coopenv.cars.profile import Role
from coopenv.cars.readings import Calibration, CarPose, Sample, Twist, Value, read
from coopenv.scenario.base import rotation_of

Delays = Mapping[str, int]
"""ns by which each source of a file is behind its recorder: the smallest (received - stamp)."""


@dataclass(frozen=True)
class Shift:
    """What is done to the stamps of a source."""

    offset: int  # ns by which its clock is behind that of the first recorder, as far as is known
    added: int  # ns that are added to its stamps
    linked: bool = True  # whether it is known; False: stamps are used unchanged


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
        stated: ns to add to the stamps of sources, by the map.
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
    """Return by how many ns the recorder of each file is behind that of the first one; None: not known."""
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


class ValueReader:
    """Reads messages by the map."""

    def __init__(
        self, given: TopicMap, binding: Binding, published: Mapping[str, Calibration], chosen: Collection[Chosen]
    ) -> None:
        """Prepare.

        Args:
            given: the map.
            binding: the cars and their vehicles, whose cameras are those of the environment.
            published: calibrations that cars publish, which count first.
            chosen: the topics that are read.
        """
        self._calibrations = {
            name: published.get(name) or Calibration.of(binding.scenario.cameras[vehicle])
            for name, vehicle in binding.cars.items()
        }
        self._distorted, self._known = given.distorted, frozenset(binding.targets)
        self._frames = {role: given.frames.map for role in Role} | {Role.TRUTH: given.frames.truth or given.frames.map}
        self._turning = {entry.car for entry in chosen if entry.role is Role.IMU}

    def read(self, chosen: Chosen, message: Any) -> Value:
        """Return the value of a message. Raises CoopenvError: it is malformed."""
        calibration = self._calibrations.get(chosen.car)
        value = read(chosen.role, message, calibration, distorted=self._distorted, known=self._known)
        if isinstance(value, CarPose):
            return in_frame(value, self._frames[chosen.role])
        if isinstance(value, Twist) and chosen.role is Role.WHEEL and chosen.car in self._turning:
            return Twist(value.linear, None)  # the IMU knows better
        return value


def in_frame(pose: CarPose, frame: MapFrame) -> CarPose:
    """Return a pose of a frame in the environment's coordinates."""
    if frame == MapFrame():
        return pose
    R = rotation_of(frame.yaw, None)
    covariance = pose.covariance
    if covariance is not None:
        both = np.kron(np.eye(2), R)
        covariance = both @ covariance @ both.T
    rotation = None if pose.rotation is None else R @ pose.rotation
    return replace(
        pose, position=R @ pose.position + np.array(frame.position), rotation=rotation, covariance=covariance
    )


WILD = 10_000_000_000  # ns by which a stamp may be ahead of the others of its topic before it is left out


@dataclass
class Track:
    """The messages of one topic, and why some were left out."""

    chosen: Chosen
    entries: list[Sample] = field(default_factory=list)  # by the clocks of source and recorder; stamp 0: none
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def delays(self) -> list[int]:
        """By how many ns its messages were received after their stamps."""
        return [entry.received - entry.stamp for entry in self.entries if entry.stamp]


def tracks_of(file: BagFile, chosen: Mapping[str, Chosen], values: ValueReader, stamped: bool) -> dict[str, Track]:
    """Return what a file has on the chosen topics, by topic; `stamped`: whether stamps count."""
    wanted = {name for name, entry in chosen.items() if entry.role is not Role.CAMERA_INFO and name in file.topics}
    tracks = {name: Track(chosen[name]) for name in sorted(wanted)}
    for topic, received, decode in file.messages(wanted):
        track = tracks[topic]
        try:
            message = decode()
            stamp = stamp_of(message) if stamped else 0
            value, entry = values.read(track.chosen, message), track.chosen
            track.entries.append(Sample(entry.car, entry.sample_role, stamp, received, value))
        except CoopenvError as error:
            track.refused[str(error)] += 1
        except (AttributeError, TypeError, ValueError) as error:  # a definition with other fields than ours
            track.refused[f"{file.topics[topic]} has other fields than expected ({error})"] += 1
    for track in tracks.values():
        _leave_out_wild(track)
    return tracks


def delays_of(tracks: Mapping[str, Track]) -> Delays:
    """Return by how many ns each source is behind the recorder of a file."""
    least: dict[str, int] = {}
    for track in tracks.values():
        for delay in track.delays:
            source = track.chosen.source
            least[source] = min(delay, least.get(source, delay))
    return least


def _leave_out_wild(track: Track) -> None:
    """Drop messages whose stamps are far ahead of those of the others."""
    if not (delays := track.delays):
        return
    least = float(np.median(delays)) - WILD
    kept = [entry for entry in track.entries if not entry.stamp or entry.received - entry.stamp >= least]
    if len(kept) < len(track.entries):
        track.refused["its stamp is far in the future"] += len(track.entries) - len(kept)
        track.entries = kept


@dataclass(frozen=True)
class TopicRow:
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
) -> tuple[TopicRow, ...]:
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
            rows.append(TopicRow(name, kind, count, (count - 1) / seconds if count > 1 and seconds > 0.0 else None))
            continue
        stamps = np.array(times.get((entry.car, entry.sample_role), []), dtype=np.int64)
        shift = clocks.shifts.get(entry.source)
        offset = None if shift is None or not shift.linked else shift.offset * 1e-9
        rate, gap, gaps = regularity(stamps)
        rows.append(TopicRow(name, kind, count, rate, entry.car, entry.role.value, len(stamps), gap, gaps, offset))
    return tuple(rows)


def regularity(stamps: np.ndarray) -> tuple[float | None, float | None, int | None]:
    """Return the rate in Hz, the longest gap in s and the number of gaps over three median periods of stamps in ns."""
    steps = np.diff(stamps) * 1e-9
    if not len(steps) or steps.sum() <= 0.0:
        return None, None, None
    return float(len(steps) / steps.sum()), float(steps.max()), int((steps > 3.0 * np.median(steps)).sum())


NS = 1_000_000_000


@dataclass(frozen=True)
class BagLog:
    """What was read."""

    samples: tuple[Sample, ...]  # in the order of their stamps, which all are on one clock
    rows: tuple[TopicRow, ...]  # what there is, by topic
    notes: tuple[str, ...]  # what a user should know

    def span(self, car: str, role: Role) -> tuple[int, int]:
        """Return when the first and the last sample of a car's role were taken, ns; of a role that it has."""
        stamps = [sample.stamp for sample in self.samples if sample.car == car and sample.role is role]
        return stamps[0], stamps[-1]


def read_log(paths: Sequence[Path], given: TopicMap, binding: Binding) -> BagLog:
    """Read bags.

    Args:
        paths: of one recording, for example one per car.
        given: the map of topics.
        binding: the cars and their vehicles.

    Raises:
        DataError: one cannot be read, something that is needed is missing or has not one message of use.
    """
    where = ", ".join(str(path) for path in paths)
    with ExitStack() as stack:
        files = [stack.enter_context(BagFile(path)) for path in paths]
        topics = {name: kind for file in files for name, kind in file.topics.items()}
        chosen = {entry.topic: entry for entry in select(given, topics, where)}
        values = ValueReader(given, binding, _calibrations(files, chosen), chosen.values())
        tracks = [tracks_of(file, chosen, values, given.clocks.mode != "received") for file in files]
    _check(tracks, chosen, where)
    tolerance = given.clocks.tolerance * NS if given.clocks.mode == "auto" else float("inf")
    stated = {name: round(seconds * NS) for name, seconds in given.clocks.offsets.items()}
    clocks = reconcile([delays_of(file) for file in tracks], tolerance, stated)
    samples = _samples(tracks, clocks)
    return BagLog(samples, rows_of(files, chosen, samples, clocks), tuple(_notes(tracks, clocks, given)))


def _calibrations(files: Sequence[BagFile], chosen: Mapping[str, Chosen]) -> dict[str, Calibration]:
    """Return the first calibration of each car that publishes one."""
    found: dict[str, Calibration] = {}
    for file in files:
        for name in [n for n, entry in chosen.items() if entry.role is Role.CAMERA_INFO and n in file.topics]:
            for _, _, decode in file.messages([name]):
                try:
                    value = read(Role.CAMERA_INFO, decode())
                except CoopenvError as error:
                    raise DataError(f"{file.path}: topic {name}: {error}") from None
                if isinstance(value, Calibration):
                    found.setdefault(chosen[name].car, value)
                break
    return found


def _check(tracks: Sequence[Mapping[str, Track]], chosen: Mapping[str, Chosen], where: str) -> None:
    """Refuse bags with a needed topic that has no usable message."""
    for name, entry in chosen.items():
        parts = [file[name] for file in tracks if name in file]
        if not entry.needed or any(part.entries for part in parts):
            continue
        refused: Counter[str] = sum((part.refused for part in parts), Counter())
        if not refused:
            raise DataError(f"{where}: topic {name} of {entry.car} has no messages")
        reason, _ = refused.most_common(1)[0]
        raise DataError(f"{where}: topic {name} of {entry.car}: none of {refused.total()} messages is of use: {reason}")


def _samples(tracks: Sequence[Mapping[str, Track]], clocks: Clocks) -> tuple[Sample, ...]:
    """Return the samples in the order of their stamps; one that several files have is there once."""
    found: dict[tuple[str, int], Sample] = {}
    for file, recorder in zip(tracks, clocks.recorders, strict=True):
        for name, track in file.items():
            for entry in track.entries:
                added = clocks.shifts[track.chosen.source].added if entry.stamp else recorder
                time = (entry.stamp or entry.received) + added
                found.setdefault((name, time), replace(entry, stamp=time, received=time))
    return tuple(sorted(found.values(), key=lambda sample: sample.stamp))


def _notes(tracks: Sequence[Mapping[str, Track]], clocks: Clocks, given: TopicMap) -> Iterator[str]:
    """Yield what was left out, moved, or used unchanged."""
    parts = [(name, track) for file in tracks for name, track in file.items()]
    for name, track in parts:
        if track.refused:
            (reason, _), count = track.refused.most_common(1)[0], track.refused.total()
            yield f"topic {name}: {count} of {count + len(track.entries)} messages left out: {reason}"
    for source, shift in sorted(clocks.shifts.items()):
        if shift.added and source not in given.clocks.offsets:
            yield f"clock of {source}: stamps are {shift.offset / NS:+.3f} s behind, and were moved by that"
        elif not shift.linked:
            yield f"clock of {source}: nothing ties its file to the first one; its stamps are used unchanged"
    for name, track in parts if given.clocks.mode != "received" else ():
        if not all(entry.stamp for entry in track.entries):
            yield f"topic {name}: messages without stamps count when they were received"
