"""The data of one or several bags: samples of all cars on one clock, see `tracks.py`, and a table of the topics."""

import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress, groupby
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, DataError, DataWarning, listed
from coopenv.cars.backend.binding import Binding, check_calibrated
from coopenv.cars.bags.clocks import NO_CRYSTAL, Leads
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.leads import leads_of, moves_of
from coopenv.cars.bags.topic_map import TRUTH, Chosen, ClockSettings, MapFrame, TopicMap, select
from coopenv.cars.bags.topics import NS, TopicRow, regularity
from coopenv.cars.bags.tracks import Clocks, Track, common_rate, delays_of, reconcile, samples_of
from coopenv.cars.bags.transforms import StaticTree, odd_mountings, unread_truth
from coopenv.cars.calibration.drives import drive_of_car
from coopenv.cars.doctor.doctor import examine, examine_constants, treated
from coopenv.cars.doctor.finding import Finding
from coopenv.cars.doctor.streams import Streams
from coopenv.cars.doctor.timing import of_timing
from coopenv.cars.gate.wheel_command import read_drive
from coopenv.cars.messages.codec import encode, stamp_of
from coopenv.cars.messages.detectors import PLACED
from coopenv.cars.messages.readings import (
    OTHER_FIELDS,
    CarPose,
    Detections,
    Sample,
    Twist,
    Value,
    read,
    without_outliers,
)
from coopenv.cars.messages.stated import stated
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction
from coopenv.scenario.sensing import rotation_of

IMU = "sensor_msgs/msg/Imu"

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
    frames, here = {Role.TRUTH: given.frames.truth or given.frames.map}, MapFrame()

    def read_value(entry: Chosen, message: Any, known_already: CarPose | None) -> Value:
        calibration = calibrations.get(entry.car)
        if entry.role is Role.MANUAL:
            return read_drive(encode(message), binding.profile.command)
        settings: dict[str, Any] = {"distorted": given.distorted, "vision": given.vision, "any_unit": True}
        value = known_already or read(entry.role, message, calibration, **settings)
        if isinstance(value, Detections) and (others := [m for m in value.markers if m not in known]):
            unknown.update(others)
            there = [m in known for m in value.markers]
            markers, qualities = (tuple(compress(some, there)) for some in (value.markers, value.qualities))
            kept: dict[str, Any] = {"markers": markers, "bearings": value.bearings[there], "qualities": qualities}
            value = replace(value, dropped=value.dropped + len(others), **kept)
        if isinstance(value, CarPose):
            frame = frames.get(entry.role, given.frames.map)
            return value if frame == here else in_frame(value, frame)
        if isinstance(value, Twist):
            return given.corrections.get(entry.car, right).twist(value, entry.role, entry.car in turning)
        return value

    return read_value


def _published(files: Sequence[BagFile], chosen: Collection[Chosen], given: TopicMap) -> dict[str, Calibration]:
    """Return the first usable calibration of each car that publishes one."""
    cars, found = {e.topic: e.car for e in chosen if e.role is Role.CAMERA_INFO}, dict[str, Calibration]()
    for file in files:
        left, why = cars.keys() & file.topics.keys(), dict[str, str]()
        for topic, _, decode in file.messages(frozenset(left)) if left else ():
            if topic in left:
                try:
                    message = decode()
                    if np.any(getattr(message, "k", getattr(message, "K", 1.0))):
                        value = read(Role.CAMERA_INFO, message, vision=given.vision)
                        if isinstance(value, Calibration):
                            found.setdefault(cars[topic], value)
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
        track.entries = without_outliers(track.entries, track.refused)
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
    unknown_markers: Mapping[int, int]  # detections by the number of the marker, of markers that are not in the map
    sent: Mapping[tuple[str, Role], tuple[Sample, ...]]  # samples with unchanged times, by car and role
    findings: tuple[Finding, ...]  # streams that others contradict
    streams: Streams  # the same samples, the lenses of cameras, and what was added to stamps


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
        lenses |= _published(files, chosen, given)  # which replace the environment's
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
    trusted = given.trust
    drifting = [track for track in tracks if not {track.chosen.topic, "all"} & {*trusted}]
    drifts = {track.chosen.topic: drift for track in drifting if (drift := track.remove_drift(tolerance))}
    clocks = reconcile(delays, tolerance, stated)
    streams = Streams(
        samples_of(tracks, clocks, {}),
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
    samples = samples_of(tracks, clocks, moves) if examined.mends or moves else tuple(streams.samples)
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
    timing = [*of_timing(tracks, samples, drifts, examined, trusted), *([treated(common, trusted)] if common else [])]
    findings = [*timing, *examined.findings, *constants]
    return BagLog(samples, rows, tuple(notes), unknown, sent, tuple(findings), streams)


def _check(entry: Chosen, tracks: Sequence[Track], where: str) -> None:
    """Refuse bags in which a needed topic, with such tracks in the files, has no usable message."""
    if not entry.needed or any(track.entries for track in tracks):
        return
    refused: Counter[str] = sum((track.refused for track in tracks), Counter())
    if not refused:
        raise DataError(f"{where}: topic {entry.topic} of {entry.car} has no messages")
    [(reason, _)], total = refused.most_common(1), refused.total()
    raise DataError(f"{where}: topic {entry.topic} of {entry.car}: none of {total} messages is of use: {reason}")


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
