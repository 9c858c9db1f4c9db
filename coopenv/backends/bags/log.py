"""Everything that is read of one or several bags: samples of all cars on one clock, and a table of what there is."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from coopenv.backends.bags.clocks import Clocks, reconcile
from coopenv.backends.bags.files import BagFile
from coopenv.backends.bags.inventory import Row, rows_of
from coopenv.backends.bags.selection import Chosen, select
from coopenv.backends.bags.topic_map import TopicMap
from coopenv.backends.bags.tracks import Track, delays_of, tracks_of
from coopenv.backends.bags.values import Values
from coopenv.backends.svea.binding import Binding
from coopenv.errors import CoopenvError, DataError
from coopenv.svea.reading import read
from coopenv.svea.samples import Calibration, Sample
from coopenv.svea.topics import Role

NS = 1_000_000_000


@dataclass(frozen=True)
class Log:
    """What was read."""

    samples: tuple[Sample, ...]  # in the order of their stamps, which all are on one clock
    rows: tuple[Row, ...]  # what there is, by topic
    notes: tuple[str, ...]  # what a user should know

    def span(self, car: str, role: Role) -> tuple[int, int]:
        """Return when the first and the last sample of a car's role were taken, ns; of a role that it has."""
        stamps = [sample.stamp for sample in self.samples if sample.car == car and sample.role is role]
        return stamps[0], stamps[-1]


def read_log(paths: Sequence[Path], given: TopicMap, binding: Binding) -> Log:
    """Read bags.

    Args:
        paths: of one recording, for example one per car.
        given: which topic tells what.
        binding: the cars and their vehicles.

    Raises:
        DataError: one cannot be read, something that is needed is missing or has not one message of use.
    """
    where = ", ".join(str(path) for path in paths)
    with ExitStack() as stack:
        files = [stack.enter_context(BagFile(path)) for path in paths]
        topics = {name: kind for file in files for name, kind in file.topics.items()}
        chosen = {entry.topic: entry for entry in select(given, topics, where)}
        values = Values(given, binding, _calibrations(files, chosen), chosen.values())
        tracks = [tracks_of(file, chosen, values, given.clocks.mode != "received") for file in files]
    _check(tracks, chosen, where)
    clocks = _clocks(tracks, given)
    samples = _samples(tracks, clocks)
    notes = (*_refusals(tracks), *_offsets(clocks, given), *_unstamped(tracks, given))
    return Log(samples, rows_of(files, chosen, samples, clocks), notes)


def _calibrations(files: Sequence[BagFile], chosen: Mapping[str, Chosen]) -> dict[str, Calibration]:
    """Return the first calibration of each car that tells one."""
    found: dict[str, Calibration] = {}
    for file in files:
        for name in [n for n, entry in chosen.items() if entry.role is Role.CAMERA_INFO and n in file.topics]:
            for raw in file.messages([name]):
                try:
                    value = read(Role.CAMERA_INFO, raw.decode())
                except CoopenvError as error:
                    raise DataError(f"{file.path}: topic {name}: {error}") from None
                if isinstance(value, Calibration):
                    found.setdefault(chosen[name].car, value)
                break
    return found


def _check(tracks: Sequence[Mapping[str, Track]], chosen: Mapping[str, Chosen], where: str) -> None:
    """Refuse bags in which a topic that is needed has nothing of use."""
    for name, entry in chosen.items():
        parts = [file[name] for file in tracks if name in file]
        if not entry.needed or any(part.entries for part in parts):
            continue
        refused: Counter[str] = sum((part.refused for part in parts), Counter())
        if not refused:
            raise DataError(f"{where}: topic {name} of {entry.car} has no messages")
        reason, _ = refused.most_common(1)[0]
        raise DataError(f"{where}: topic {name} of {entry.car}: none of {refused.total()} messages is of use: {reason}")


def _clocks(tracks: Sequence[Mapping[str, Track]], given: TopicMap) -> Clocks:
    asked = given.clocks
    tolerance = asked.tolerance * NS if asked.mode == "auto" else float("inf")
    stated = {name: round(seconds * NS) for name, seconds in asked.offsets.items()}
    return reconcile([delays_of(file) for file in tracks], tolerance, stated)


def _samples(tracks: Sequence[Mapping[str, Track]], clocks: Clocks) -> tuple[Sample, ...]:
    """Return the samples in the order of their stamps; one that several files have is there once."""
    found: dict[tuple[str, int], Sample] = {}
    for file, recorder in zip(tracks, clocks.recorders, strict=True):
        for name, track in file.items():
            chosen = track.chosen
            for entry in track.entries:
                added = clocks.shifts[chosen.source].added if entry.stamp else recorder
                time = (entry.stamp or entry.received) + added
                found.setdefault((name, time), Sample(chosen.car, chosen.told_as, time, time, entry.value))
    return tuple(sorted(found.values(), key=lambda sample: sample.stamp))


def _refusals(tracks: Sequence[Mapping[str, Track]]) -> Iterator[str]:
    for file in tracks:
        for name, track in file.items():
            if track.refused:
                reason, _ = track.refused.most_common(1)[0]
                count, whole = track.refused.total(), track.refused.total() + len(track.entries)
                yield f"topic {name}: {count} of {whole} messages left out: {reason}"


def _offsets(clocks: Clocks, given: TopicMap) -> Iterator[str]:
    for source, shift in sorted(clocks.shifts.items()):
        if shift.added and source not in given.clocks.offsets:
            yield f"clock of {source}: stamps are {shift.offset / NS:+.3f} s behind, and were moved by that"
        elif not shift.linked:
            yield f"clock of {source}: nothing ties its file to the first one; its stamps are believed"


def _unstamped(tracks: Sequence[Mapping[str, Track]], given: TopicMap) -> Iterator[str]:
    if given.clocks.mode == "received":
        return
    for file in tracks:
        for name, track in file.items():
            if track.entries and not all(entry.stamp for entry in track.entries):
                yield f"topic {name}: messages without stamps count when they were received"
