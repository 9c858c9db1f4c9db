"""The data of one or several bags: samples of all cars on one clock, and a table of the topics.

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

import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress, groupby
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, DataError, DataWarning, listed
from coopenv.cars.backend.binding import Binding, check_calibrated
from coopenv.cars.bags.clocks import Delay, Leads, checked, jumps
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.leads import leads_of, moves_of
from coopenv.cars.bags.topic_map import COMMANDS, TRUTH, UNNEEDED, Chosen, ClockSettings, MapFrame, TopicMap, select
from coopenv.cars.bags.topics import NS, TopicRow, regularity
from coopenv.cars.bags.transforms import StaticTree, odd_mountings, unread_truth
from coopenv.cars.calibration.drives import drive_of_car
from coopenv.cars.doctor.doctor import Examined, examine, examine_constants, treated
from coopenv.cars.doctor.finding import Finding, Treatment, with_error
from coopenv.cars.doctor.motion import IN_THE_ROOM
from coopenv.cars.doctor.streams import MOVING, Streams
from coopenv.cars.doctor.timing import NO_CRYSTAL, of_delays, of_drift, of_duplicates, of_frames, of_outages, of_repeats
from coopenv.cars.gate.wheel_command import read_drive
from coopenv.cars.messages.codec import encode, stamp_of
from coopenv.cars.messages.detectors import PLACED
from coopenv.cars.messages.readings import OTHER_FIELDS, CarPose, Detections, Sample, Twist, Value, read
from coopenv.cars.messages.stated import Stated, stated
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction
from coopenv.scenario.sensing import rotation_of

IMU = "sensor_msgs/msg/Imu"

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


ReadValue = Callable[[Chosen, Any, CarPose | None], Value]
"""Returns the value of a message of a topic, which may be known already. Raises CoopenvError: it is malformed."""


def value_reader(
    given: TopicMap,
    binding: Binding,
    chosen: Collection[Chosen],
    calibrations: Mapping[str, Calibration],
    unknown: Counter[int],
) -> ReadValue:
    """Return the reader of messages by the map.

    Args:
        given: the map.
        binding: the cars and their vehicles.
        chosen: the topics that are read.
        calibrations: of the cars' cameras.
        unknown: counts detections of markers that are not in the map.
    """
    known, turning = frozenset(binding.targets), {entry.car for entry in chosen if entry.role is Role.IMU}
    right = Correction()
    frames = {Role.TRUTH: given.frames.truth or given.frames.map}

    def read_value(entry: Chosen, message: Any, known_already: CarPose | None) -> Value:
        calibration = calibrations.get(entry.car)
        if entry.role is Role.MANUAL:
            return read_drive(encode(message), binding.profile.command)
        value = known_already or read(entry.role, message, calibration, distorted=given.distorted, vision=given.vision)
        if isinstance(value, Detections) and (others := [m for m in value.markers if m not in known]):
            unknown.update(others)
            there = [m in known for m in value.markers]
            markers, qualities = (tuple(compress(some, there)) for some in (value.markers, value.qualities))
            kept: dict[str, Any] = {"markers": markers, "bearings": value.bearings[there], "qualities": qualities}
            value = replace(value, dropped=value.dropped + len(others), **kept)
        if isinstance(value, CarPose):
            return in_frame(value, frames.get(entry.role, given.frames.map))
        if isinstance(value, Twist):
            return given.corrections.get(entry.car, right).twist(value, entry.role, entry.car in turning)
        return value

    return read_value


def _published(
    files: Sequence[BagFile], chosen: Collection[Chosen], given: TopicMap
) -> dict[str, tuple[Calibration, Stated]]:
    """Return the first usable calibration of each car that publishes one, and what its message states besides."""
    cars, found = (
        {e.topic: e.car for e in chosen if e.role is Role.CAMERA_INFO},
        dict[str, tuple[Calibration, Stated]](),
    )
    for file in files:
        left, why = cars.keys() & file.topics.keys(), dict[str, str]()
        for topic, _, decode in file.messages(frozenset(left)) if left else ():
            if topic in left:
                try:
                    message = decode()
                    if np.any(getattr(message, "k", getattr(message, "K", 1.0))):
                        value = read(Role.CAMERA_INFO, message, vision=given.vision)
                        if isinstance(value, Calibration):
                            found.setdefault(cars[topic], (value, stated(message)))
                        left.remove(topic)
                    else:
                        why.setdefault(topic, "")
                except (CoopenvError, *OTHER_FIELDS) as error:
                    why[topic] = why.get(topic) or str(error)
            if not left:
                break
        for topic in left & why.keys():
            if why[topic]:
                raise DataError(f"{file.path}: topic {topic}: {why[topic]}")
            text = f"{file.path}: topic {topic}: says that the camera is not calibrated (k is zero)"
            warnings.warn(f"{text}; the environment's calibration counts", DataWarning, stacklevel=4)
    return found


def in_frame(pose: CarPose, frame: MapFrame) -> CarPose:
    """Return a pose of a frame in the environment's coordinates."""
    R, covariance = rotation_of(frame.yaw, None), pose.covariance
    if covariance is not None:
        both = np.kron(np.eye(2), R)
        covariance = both @ covariance @ both.T
    rotation = None if pose.rotation is None else R @ pose.rotation
    return CarPose(R @ pose.position + np.array(frame.position), rotation, covariance)


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
        early = [replace(e, received=e.stamp + usual) for e in self.entries if not e.received and e.stamp]
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
        self.entries = [replace(e, stamp=int(s)) for e, s in zip(self.entries, stamps, strict=True)]
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
            self.entries[k] = replace(entry, stamp=entry.stamp + gained)
        return delay.drift


APART = NS  # ns between the delays of two topics of a car beyond which they have different clocks


def tracks_of(
    number: int, file: BagFile, chosen: Collection[Chosen], value: ReadValue, clocks: ClockSettings, tree: StaticTree
) -> list[Track]:
    """Return the messages of a file, by its number, on the chosen topics; `tree` has its static transforms."""
    wanted = [entry for entry in chosen if entry.role is not Role.CAMERA_INFO and entry.topic in file.topics]
    tracks = [Track(number, entry) for entry in sorted(wanted, key=lambda entry: (entry.topic, entry.frame))]
    by_topic = {topic: [*some] for topic, some in groupby(tracks, key=lambda track: track.chosen.topic)}
    for topic, received, decode in file.messages(by_topic):
        for track in by_topic[topic]:
            try:
                if (sample := _sample(track.chosen, decode(), received, value, clocks, tree)) is not None:
                    track.entries.append(sample)
            except CoopenvError as error:
                track.refused[str(error)] += 1
            except OTHER_FIELDS as error:  # of its stamp or its transforms
                track.refused[f"{file.topics[topic]} has other fields than expected ({error})"] += 1
    for track in tracks:
        if file.dated:
            track.date_undated()
        track.clean_stamps(clocks.mode)
    return tracks


def _sample(
    entry: Chosen, message: Any, received: int, value: ReadValue, clocks: ClockSettings, tree: StaticTree
) -> Sample | None:
    """Return the sample of a message; None: transforms of other frames. Raises CoopenvError: it is malformed."""
    place = None
    if entry.frame:
        if (moved := tree.body_at(message, entry.frame)) is None:
            return None
        message, place = moved
    stamp, found = 0 if clocks.mode == "received" else stamp_of(message), value(entry, message, place)
    if stamp:
        late = found.late if isinstance(found, Detections) else 0
        stamp += late + round(clocks.leads.get(entry.topic, 0.0) * NS)
    return Sample(entry.car, entry.sample_role, stamp, received, found, stated(message))


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


def rows_of(
    files: Sequence[BagFile],
    chosen: Collection[Chosen],
    samples: Sequence[Sample],
    clocks: Clocks,
    tracks: Sequence[Track],
    leads: Leads,
) -> tuple[TopicRow, ...]:
    """Return a row per topic, read topics first."""
    read_as = {entry.topic: entry for entry in chosen}
    names = sorted({name for file in files for name in file.topics}, key=lambda name: (name not in read_as, name))
    times: dict[tuple[str, str], list[int]] = {}
    for sample in samples:
        times.setdefault((sample.car, sample.role), []).append(sample.stamp)
    rows = []
    for name in names:
        kind = next(file.topics[name] for file in files if name in file.topics)
        count = sum(file.counts.get(name, 0) for file in files)
        seconds = max(file.seconds for file in files if name in file.topics)
        if (entry := read_as.get(name)) is None:
            rows.append(TopicRow(name, kind, count, (count - 1) / seconds if count > 1 and seconds > 0.0 else None))
            continue
        stamps = np.array(times.get((entry.car, entry.sample_role), []), dtype=np.int64)
        own = [track for track in tracks if track.chosen is entry]
        delays = [behind + clocks.shifts[t.source].added / NS for t in own if (behind := t.behind(clocks)) is not None]
        (rate, gap, gaps), lead, bad = regularity(stamps), leads.get(name), sum(track.outlying for track in own)
        read = (entry.car, entry.role.value, len(stamps), gap, gaps, min(delays, default=None), bad)
        by_content = () if lead is None else (lead.seconds, lead.error, lead.reference)
        rows.append(TopicRow(name, kind, count, rate, *read, *by_content))
    return tuple(rows)


@dataclass(frozen=True)
class BagLog:
    """Result of reading a bag."""

    samples: tuple[Sample, ...]  # in the order of their stamps, which all are on one clock
    rows: tuple[TopicRow, ...]  # topics of the bag
    notes: tuple[str, ...]  # remarks for the user
    lenses: Mapping[str, Calibration] = field(default_factory=dict)  # by car; none: its bearings are without pixels
    added: Mapping[tuple[str, Role], tuple[str, float]] = field(default_factory=dict)
    """By car and role: the topic, and s that were added to its stamps."""
    unknown_markers: Mapping[int, int] = field(default_factory=dict)
    """Detections by the number of the marker, of markers that are not in the map."""
    sent: Mapping[tuple[str, Role], tuple[Sample, ...]] = field(default_factory=dict)
    """Samples with unchanged times, by car and role."""
    cameras: Mapping[str, Stated] = field(default_factory=dict)
    """Contents of the CameraInfo of each car that publishes one, beside the calibration in `lenses`."""
    findings: tuple[Finding, ...] = ()
    """Streams that others contradict."""
    streams: Streams | None = None  # the same, as arrays


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
        files = [stack.enter_context(BagFile(path, bool(given.vision.colours))) for path in paths]
        topics = {name: kind for file in files for name, kind in file.topics.items()}
        chosen = select(given, topics, where)
        cameras = {car: binding.scenario.cameras[vehicle] for car, vehicle in binding.cars.items()}
        lenses = {car: Calibration.of(camera) for car, camera in cameras.items() if camera.model == "pinhole"}
        if given.vision.rectified:
            lenses = {name: replace(lens, distortion=(0.0,) * 5) for name, lens in lenses.items()}
        published = _published(files, chosen, given)
        lenses |= {car: lens for car, (lens, _) in published.items()}  # it replaces the environment's
        lenses |= {car: made.lens(lenses[car]) for car, made in given.corrections.items() if car in lenses}
        placed = {e.car for e in chosen if e.role is Role.DETECTIONS and topics[e.topic] in PLACED}
        for car in binding.cars.keys() - lenses.keys() - placed:
            check_calibrated(binding.scenario, binding.cars[car], given.path.name)
        unknown = Counter[int]()
        value, mode = value_reader(given, binding, chosen, lenses, unknown), given.clocks.mode
        tree = StaticTree.of(files)
        tracks = [
            track for n, file in enumerate(files) for track in tracks_of(n, file, chosen, value, given.clocks, tree)
        ]
        elsewhere = [*unread_truth(files, given, chosen)]
    known = sorted(entry.topic for entry in chosen)
    for key in ("offsets", "leads"):
        if odd := [name for name in getattr(given.clocks, key) if name[0] == "/" and name not in known]:
            raise DataError(f"{given.path.name}: clocks.{key}: {odd[0]} is none of the topics read: {listed(known)}")
    for entry in chosen:
        _check(entry, [track for track in tracks if track.chosen is entry], where)
    tolerance = given.clocks.tolerance * NS if mode == "auto" else float("inf")
    stated = {name: round(seconds * NS) for name, seconds in given.clocks.offsets.items()}
    common = common_rate(tracks) if mode == "auto" else None
    delays = delays_of(tracks, len(files), given.clocks.tolerance * NS, stated)
    drifts = {track.chosen.topic: drift for track in tracks if (drift := track.remove_drift(tolerance))}
    clocks = reconcile(delays, tolerance, stated)
    trusted = given.trust
    streams = Streams(
        _samples(tracks, clocks, {}),
        binding,
        {(entry.car, entry.role): entry.topic for entry in chosen},
        lenses,
        given.corrections,
    )
    examined = examine(streams, trusted)
    for track in tracks if examined.mends else ():
        track.entries = examined.mended(track.entries)
    leads = leads_of(examined.cars.values()) if mode != "received" else {}
    fixed = {track.chosen.topic for track in tracks if track.source in stated}
    behind = {track.chosen.topic: seconds for track in tracks if (seconds := track.behind(clocks)) is not None}
    moves = moves_of(leads, chosen, tolerance / NS, fixed, behind)
    samples = _samples(tracks, clocks, moves)
    for entry in chosen:
        if entry.topic in moves and entry.car in examined.cars:
            own = examined.cars[entry.car]
            examined.cars[entry.car] = own.shifted(entry.sample_role, moves[entry.topic] / NS)
    crystals = {topic: drift for topic, drift in drifts.items() if abs(drift) <= NO_CRYSTAL}
    notes = [*_notes(tracks, clocks, given, crystals), *_lead_notes(tracks, clocks, given, leads, moves)]
    used, turning = {e.topic for e in chosen}, {e.car for e in chosen if e.role in (Role.IMU, Role.ODOMETRY)}
    cars = [entry.car for entry in chosen if entry.role is Role.WHEEL and entry.car not in turning]
    if (
        cars
        and given.odometry == "auto"
        and (unread := [name for name, kind in topics.items() if kind == IMU and name not in used])
    ):
        notes.append(f"turn rates of {listed(cars)} are the wheels'; unread: {listed(unread)}, of type {IMU}")
    frames = {s.car: s.stated.frame for s in samples if s.role is Role.DETECTIONS and s.stated.frame}
    mountings = odd_mountings(tree, frames, {car.name: car.names["body"] for car in given.cars}, cameras)
    notes += [*elsewhere, *mountings]
    rays = placed | {entry.car for entry in chosen if entry.role is Role.BEARINGS and not given.distorted}
    pixels = {name: lens for name, lens in lenses.items() if name not in rays}
    added: dict[tuple[str, Role], tuple[str, float]] = {}
    sent = {
        (track.chosen.car, track.chosen.role): tuple(sorted(track.entries, key=lambda entry: entry.stamp))
        for track in reversed(tracks)
    }
    for track in tracks:
        shift, topic = clocks.shifts.get(track.source), track.chosen.topic
        moved = (moves.get(topic, 0) + (shift.added if shift else 0)) / NS + given.clocks.leads.get(topic, 0.0)
        added.setdefault((track.chosen.car, track.chosen.role), (topic, moved))
    rows = rows_of(files, chosen, samples, clocks, tracks, leads)
    streams = replace(streams, samples=samples, lenses=pixels, added=added)
    constants = examine_constants(examined, partial(drive_of_car, streams), trusted)
    timing = [*_of_timing(tracks, samples, drifts, examined), *([common] if common else [])]
    findings = [*(treated(finding, trusted) for finding in timing), *examined.findings, *constants]
    stating = {car: about for car, (_, about) in published.items()}
    return BagLog(samples, rows, tuple(notes), pixels, added, unknown, sent, stating, tuple(findings), streams)


def _of_timing(
    tracks: Sequence[Track], samples: Sequence[Sample], drifts: Mapping[str, float], examined: Examined
) -> Iterator[Finding]:
    """Yield what is wrong with the times of messages, and with the frames that these state.

    Args:
        tracks: of the topics, without drifts.
        samples: of all topics, on one clock.
        drifts: of topics, which were removed.
        examined: the gate's findings of the topics' values.
    """
    in_the_room = {finding.subject for finding in examined.findings if IN_THE_ROOM in finding.text}
    truth = {s.stated.frame for s in samples if s.role is Role.TRUTH}
    end = max((s.stamp for s in samples if s.role not in UNNEEDED), default=0)
    by_topic = {
        entry: [s for s in samples if (s.car, s.role) == (entry.car, entry.sample_role)]
        for entry in dict.fromkeys(track.chosen for track in tracks)
    }
    for track in tracks:
        car, topic = track.chosen.car, track.chosen.topic
        stamps, received = (np.array([getattr(e, name) for e in track.entries]) for name in ("stamp", "received"))
        yield from of_duplicates(stamps, topic, car)
        yield from of_delays(stamps, received, topic, car)
        if topic in drifts:
            yield from of_drift(drifts[topic], topic, car)
    left_out = {finding.subject for finding in examined.findings if finding.treatment is Treatment.LEFT_OUT}
    for entry, own in by_topic.items():
        if entry.role in COMMANDS or entry.topic in left_out:
            continue
        yield from of_outages(own, entry.topic, end)
        yield from of_repeats(own, entry.topic)
        streams = examined.cars.get(entry.car)
        if entry.role in MOVING and streams is not None and (streams.truth_signals or streams.own_signals):
            yield from of_frames(own, entry.topic, truth, entry.topic in in_the_room)


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
            track.entries = [replace(e, received=begin + round(step * (e.received - begin))) for e in track.entries]
            track.clean_stamps("stamps")
    error = float(np.std(drifts) / np.sqrt(len(drifts)))
    size = with_error(1e6 * (1.0 - rate), max(1.0, 1e6 * error))
    text = f"all {len(drifts)} topics drift alike, by {size} us per s: time runs {rate:.4g} times as fast in"
    text += " stamps as where they were received, as in a simulation; stamps count"
    return Finding("clocks", text, 1.0 - rate, error, treatment=Treatment.MENDED)


def _check(entry: Chosen, tracks: Sequence[Track], where: str) -> None:
    """Refuse bags in which a needed topic, with such tracks in the files, has no usable message."""
    if not entry.needed or any(track.entries for track in tracks):
        return
    refused: Counter[str] = sum((track.refused for track in tracks), Counter())
    if not refused:
        raise DataError(f"{where}: topic {entry.topic} of {entry.car} has no messages")
    [(reason, _)], total = refused.most_common(1), refused.total()
    raise DataError(f"{where}: topic {entry.topic} of {entry.car}: none of {total} messages is of use: {reason}")


def _samples(tracks: Sequence[Track], clocks: Clocks, moves: Mapping[str, int]) -> tuple[Sample, ...]:
    """Return the samples, each once, in the order of their stamps, to which `moves` are added by topic, ns."""
    found: dict[tuple[Chosen, int], Sample] = {}
    for track in tracks:
        added, recorder = clocks.shifts.get(track.source), clocks.recorders[track.file]
        moved = moves.get(track.chosen.topic, 0)
        for entry in track.entries:
            time = entry.stamp + added.added + moved if entry.stamp and added else entry.received + recorder
            found.setdefault((track.chosen, time), replace(entry, stamp=time, received=time))
    return tuple(sorted(found.values(), key=lambda sample: sample.stamp))


def _notes(tracks: Sequence[Track], clocks: Clocks, given: TopicMap, drifts: Mapping[str, float]) -> Iterator[str]:
    """Yield notes on data left out, moved, or used unchanged."""
    for track in tracks:
        total = track.refused.total() + len(track.entries) + track.outlying
        if track.delay is not None and track.delay.jump:
            jump = f"its delay changes by {track.delay.jump / NS:.2g} s"
            yield f'topic {track.chosen.topic}: {jump}; clocks.mode = "received" needs no stamps'
        if track.jumps:
            sizes = listed([f"{-behind / NS:+.3f}" for _, behind in track.jumps])
            yield f"topic {track.chosen.topic}: its clock jumps by {sizes} s, which was removed"
        if track.outlying:
            yield f"topic {track.chosen.topic}: {track.outlying} of {total} messages left out: wrong stamps"
        if track.refused:
            [(reason, _)], count = track.refused.most_common(1), track.refused.total()
            yield f"topic {track.chosen.topic}: {count} of {total} messages left out: {reason}"
    for source, shift in sorted(clocks.shifts.items()):
        if shift.offset is None:
            yield f"clock of {source}: nothing ties its file to the first one; its stamps are used unchanged"
        elif shift.added and source not in given.clocks.offsets:
            where = "behind" if shift.offset > 0 else "ahead"
            yield f"clock of {source}: stamps are {abs(shift.offset) / NS:.3f} s {where}, and were moved by that"
    for topic, drift in drifts.items():
        yield f"topic {topic}: its clock drifts by {1e6 * drift:+.0f} us per s, which was removed"
    for track in tracks if given.clocks.mode != "received" else ():
        if not all(entry.stamp for entry in track.entries):
            yield f"topic {track.chosen.topic}: messages without stamps count when they were received"


def _lead_notes(
    tracks: Sequence[Track], clocks: Clocks, given: TopicMap, leads: Leads, moves: Mapping[str, int]
) -> Iterator[str]:
    """Yield notes on topics moved, or not moved, by their measurements, and the key that states it."""
    seen: set[str] = set()
    for track in tracks:
        topic, shift = track.chosen.topic, clocks.shifts.get(track.source)
        lead, added, moved = leads.get(topic), 0 if shift is None else shift.added, moves.get(topic)
        name = TRUTH if track.chosen.source == TRUTH else topic
        why = f"{track.chosen.car}: {lead}" if lead else f"{name}: its clock is not that of most topics"
        key = f'clocks.offsets = {{ "{name}" ='
        if moved is not None and name not in seen:
            yield f"{why}; stamps were moved by {moved / NS:+.3f} s, as with {key} {(added + moved) / NS:.4f} }}"
        elif lead is not None and not moves and lead.exceeds(given.clocks.tolerance):
            yield f"{why}; stamps are unchanged, unlike with {key} {added / NS + lead.seconds:.4f} }}"
        seen.add(name)
