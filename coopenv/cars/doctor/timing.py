"""Checks of when messages come: outages, messages that come twice, delays, and clocks that no crystal drives."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.bags.clocks import CAMERAS, NO_CRYSTAL, Times
from coopenv.cars.bags.topic_map import COMMANDS, UNNEEDED
from coopenv.cars.bags.tracks import Track
from coopenv.cars.doctor.doctor import Examined, treated
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.doctor.motion import IN_THE_ROOM, velocity_relations
from coopenv.cars.doctor.streams import MOVING
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist
from coopenv.cars.settings.profile import Role

NS = 1e-9
OUTAGE, PERIODS, OFTEN = 1.5, 20.0, 4.0
"""s, and periods of the topic, of a silence that is stated, and periods of one that may come more often."""
FEWEST, LOST, STEADY, NEAR, QUARTER = 50, 0.2, 0.9, 0.2, 0.25
"""Intervals at least; share of lost messages above which that is stated, and of the intervals that are whole numbers of
periods, up to a share of one; share of the intervals that are a single period."""
FEW, SHARE = 5, 0.02
"""Messages, and their share, that come twice, above which that is stated."""
REPEATED = 0.2
"""Share of equal values in a row above which a stream repeats itself, of values with noise."""
HELD, FREE, LENGTHS, BLOCK = 0.95, 0.4, (2, 3, 4, 5, 6), 60
"""Share of equal frames at a place of a pattern at least, and at another one at most, with which a camera holds them;
lengths of patterns; frames in which these do not shift, as they do after a frame that is lost."""
LATE = 0.25
"""s by which a twentieth of the messages come later than the earliest: a network buffers them."""


def of_outages(samples: Sequence[Sample], topic: str, begin: int, end: int) -> Iterator[Finding]:
    """Yield the longest silence of a topic of a drive that begins and ends at times, ns.

    Cameras that send nothing without a marker in view are often silent, and by right.
    """
    if len(samples) < 2 * FEW:
        return
    stamps = np.array([begin, *(sample.stamp for sample in samples), end])
    gaps = np.diff(stamps) * NS
    if samples[0].role in CAMERAS and (gaps > OFTEN * np.median(gaps)).sum() > FEW and all(map(_markers, samples)):
        return
    if gaps.max() > max(OUTAGE, PERIODS * float(np.median(gaps))):
        after = (stamps[int(np.argmax(gaps))] - stamps[0]) * NS
        count = int((gaps > OUTAGE).sum())
        more = f", the longest of {count}" if count > 1 else ""
        text = f"an outage of {gaps.max():.1f} s after {after:.1f} s{more}"
        yield Finding(topic, text, float(gaps.max()), car=samples[0].car)


def _markers(sample: Sample) -> bool:
    return isinstance(sample.value, Detections) and bool(sample.value.markers)


def of_losses(samples: Sequence[Sample], topic: str) -> Iterator[Finding]:
    """Yield that single messages of a topic with a steady period are lost again and again.

    Cameras that send nothing without a marker in view are often silent, and by right.
    """
    steps = np.diff([sample.stamp for sample in samples]) * NS
    if len(steps) < FEWEST or (samples[0].role in CAMERAS and all(map(_markers, samples))):
        return
    period = float(np.median(steps[steps <= np.quantile(steps, QUARTER)]))
    steps = steps[steps < PERIODS * period]
    count = np.rint(steps / max(period, NS))
    whole, lost = np.abs(steps - count * period) < NEAR * period, int(np.maximum(count - 1.0, 0.0).sum())
    share = lost / (lost + len(samples))
    if share > LOST and whole.mean() > STEADY and (count > 1.0).sum() > 2 * FEW:
        text = f"{lost} messages are lost here and there, {share:.0%}: intervals are multiples of {1e3 * period:.3g} ms"
        yield Finding(topic, text, share, car=samples[0].car)


def of_duplicates(samples: Sequence[Sample], topic: str) -> Iterator[Finding]:
    """Yield that messages have the stamp of an earlier one; a stamp of 0 is none."""
    first: dict[int, list[float]] = {}
    twice = other = 0
    for sample in (sample for sample in samples if sample.stamp):
        twice += sample.stamp in first
        other += first.setdefault(sample.stamp, numbers := _numbers(sample)) != numbers
    given = len(first) + twice
    if twice > max(FEW, SHARE * given):
        text, key = f"{twice} of {given} messages are duplicates: they have the stamp of another one", ""
        if other > 0.5 * twice:
            text = f"{twice} of {given} messages have other values than the first of the same stamp: stamps are coarse"
            key = 'clocks.mode = "received"'
        yield Finding(topic, text, twice, None, key, Treatment.LEFT_OUT, samples[0].car)


def of_repeats(samples: Sequence[Sample], topic: str) -> Iterator[Finding]:
    """Yield that a topic repeats values under new stamps: with noise of its own, or frames of a car that moves."""
    if len(samples) < 2 * FEW or samples[0].role in MOVING:  # a speed may be a setpoint
        return
    values = [some for sample in samples if (some := _numbers(sample))]  # but frames without any marker
    same = np.array([one == other for one, other in pairwise(values)], bool)
    if samples[0].role in CAMERAS:
        count, repeats = int(same.sum()), _are_held(same)
    else:
        alone = same & ~np.append(same[1:], False) & ~np.append(False, same[:-1])  # not of a stream that sticks
        count, repeats = int(alone.sum()), alone.mean() > REPEATED
    if repeats:
        text = f"{count} of {len(samples)} messages are duplicates: they repeat the value of the one before"
        yield Finding(topic, text, count, car=samples[0].car)


def _are_held(same: NDArray[np.bool_]) -> bool:
    """Return whether frames repeat themselves (n,) in a pattern of so many frames, as those that a camera holds.

    Whole pixels of a slow car repeat themselves, too, at any place of a pattern.
    """
    found = []
    for begin in range(0, len(same) - BLOCK + 1, BLOCK):
        block = same[begin : begin + BLOCK]
        held = False
        for length in LENGTHS:
            share = np.array([block[k::length].mean() for k in range(length)])
            held |= bool(share.max() >= HELD and share.min() <= FREE)
        found.append(held)
    return len(found) > 2 and float(np.mean(found)) > 0.5


def _numbers(sample: Sample) -> list[float]:
    if isinstance(sample.value, Twist) and sample.value.angular is not None:
        return [*sample.value.angular]
    if isinstance(sample.value, Detections):
        return [*sample.value.markers, *sample.value.bearings.ravel().tolist()]
    return [*sample.value.position] if isinstance(sample.value, CarPose) else [float(sample.stamp)] * 3


def of_delays(stamps: Times, received: Times, topic: str, car: str) -> Iterator[Finding]:
    """Yield that messages with stamps (n,), ns, come much later than the earliest of them, as through a full buffer."""
    late = (received - stamps)[stamps != 0] * NS
    if len(late) < 2 * FEW:
        return
    late = late - np.quantile(late, 0.05)
    if float(np.quantile(late, 0.95)) > LATE:
        text = f"messages come up to {late.max():.2f} s later than the earliest (median {np.median(late):.2f} s): "
        yield Finding(topic, text + "a one-way delay that changes; stamps count", float(late.max()), car=car)


def of_drift(drift: float, topic: str, car: str) -> Iterator[Finding]:
    """Yield that a clock runs at another rate (s per s) than any crystal, or that a buffer fills."""
    if abs(drift) > NO_CRYSTAL:
        text = f"its clock drifts by {1e6 * drift:+.0f} us per s, which no crystal does: the drift was removed"
        yield Finding(topic, text, drift, None, 'clocks.mode = "received"', Treatment.MENDED, car)


def of_frames(samples: Sequence[Sample], topic: str, frames: Collection[str], in_the_room: bool) -> Iterator[Finding]:
    """Yield that a twist is in another frame than its `child_frame_id` states.

    Args:
        samples: of a topic.
        topic: its name.
        frames: of positions by motion capture.
        in_the_room: whether the twist is in the frame of positions, as others show.
    """
    if not samples or not (child := samples[0].stated.child_frame):
        return
    stated = child == samples[0].stated.frame or child in frames
    if stated != in_the_room:
        where, other = ("pose's", "body's") if in_the_room else ("body's", "pose's")
        text = f"its twist is in the {where} frame, while child_frame_id = {child!r} states the {other}"
        yield Finding(topic, text, car=samples[0].car)


def of_timing(
    tracks: Sequence[Track],
    samples: Sequence[Sample],
    drifts: Mapping[str, float],
    examined: Examined,
    trusted: Collection[str],
) -> Iterator[Finding]:
    """Yield what is wrong with the times of messages, and with the frames that these state.

    Args:
        tracks: of the topics, without drifts.
        samples: of all topics, on one clock.
        drifts: of topics, which were removed.
        examined: the gate's findings of the topics' values.
        trusted: subjects of findings that stay unchanged; of two messages with one stamp only one can be used.
    """
    for track in tracks:
        yield from of_duplicates(track.entries, track.chosen.topic)
    for finding in _of_topics(tracks, samples, drifts, examined):
        yield treated(finding, trusted)


def _of_topics(
    tracks: Sequence[Track], samples: Sequence[Sample], drifts: Mapping[str, float], examined: Examined
) -> Iterator[Finding]:
    """Yield what is wrong with times and frames, but for duplicates."""
    in_the_room = {finding.subject for finding in examined.findings if IN_THE_ROOM in finding.text}
    truth = {s.stated.frame for s in samples if s.role is Role.TRUTH}
    needed = [s.stamp for s in samples if s.role not in UNNEEDED] or [0]
    by_topic = {
        entry: [s for s in samples if (s.car, s.role) == (entry.car, entry.sample_role)]
        for entry in dict.fromkeys(track.chosen for track in tracks)
    }
    for track in tracks:
        car, topic = track.chosen.car, track.chosen.topic
        stamps, received = (np.array([getattr(e, name) for e in track.entries]) for name in ("stamp", "received"))
        yield from of_delays(stamps, received, topic, car)
        if topic in drifts:
            yield from of_drift(drifts[topic], topic, car)
    left_out = {finding.subject for finding in examined.findings if finding.treatment is Treatment.LEFT_OUT}
    for entry, own in by_topic.items():
        if entry.role in COMMANDS or entry.topic in left_out:
            continue
        yield from of_outages(own, entry.topic, min(needed), max(needed))
        yield from of_losses(own, entry.topic)
        yield from of_repeats(own, entry.topic)
        streams = examined.cars.get(entry.car) if entry.role in MOVING else None
        paths = None if streams is None else streams.truth_signals or streams.own_signals
        if streams is not None and paths is not None and velocity_relations(streams, *paths)[0] is not None:
            yield from of_frames(own, entry.topic, truth, entry.topic in in_the_room)
