"""Checks of when messages come: outages, messages that come twice, delays, and clocks that no crystal drives."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from coopenv.cars.bags.clocks import CAMERAS, Times
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist
from coopenv.cars.settings.profile import Role

NS = 1e-9
OUTAGE, PERIODS, OFTEN = 1.5, 20.0, 4.0
"""s, and periods of the topic, of a silence that is stated, and periods of one that may come more often."""
FEW, SHARE = 5, 0.02
"""Messages, and their share, that come twice, above which that is stated."""
REPEATED = 0.2
"""Share of equal values in a row above which a stream repeats itself, of values with noise."""
LATE = 0.25
"""s by which a twentieth of the messages come later than the earliest: a network buffers them."""
NO_CRYSTAL = 500e-6
"""s per s, drift above which a clock is none with a quartz crystal, whose errors are below 100e-6 from -40 to 85 C."""


def of_outages(samples: Sequence[Sample], topic: str, end: int) -> Iterator[Finding]:
    """Yield the longest silence of a topic of a drive that ends at a time, ns.

    Cameras that send nothing without a marker in view are often silent, and by right.
    """
    if len(samples) < 2 * FEW:
        return
    stamps = np.array([*(sample.stamp for sample in samples), end])
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


def of_duplicates(stamps: Times, topic: str, car: str) -> Iterator[Finding]:
    """Yield that messages have the stamp (n,), ns, of another one, 0: none."""
    given = stamps[stamps != 0]
    twice = len(given) - len(np.unique(given))
    if twice > max(FEW, SHARE * len(given)):
        text = f"{twice} of {len(given)} messages are duplicates: they have the stamp of another one"
        yield Finding(topic, text, twice, treatment=Treatment.LEFT_OUT, car=car)


def of_repeats(samples: Sequence[Sample], topic: str) -> Iterator[Finding]:
    """Yield that a topic with noise of its own repeats values under new stamps."""
    if len(samples) < 2 * FEW or samples[0].role not in (Role.IMU, Role.TRUTH):
        return
    values = np.array([_numbers(sample) for sample in samples])
    same = (np.diff(values, axis=0) == 0.0).all(axis=1)
    alone = same & ~np.append(same[1:], False) & ~np.append(False, same[:-1])  # not of a stream that sticks
    if alone.mean() > REPEATED:
        text = f"{int(alone.sum())} of {len(samples)} messages are duplicates: they repeat the value of the one before"
        treatment = Treatment.LEFT_OUT if samples[0].role is Role.TRUTH else Treatment.USED
        yield Finding(topic, text, int(alone.sum()), treatment=treatment, car=samples[0].car)


def _numbers(sample: Sample) -> list[float]:
    if isinstance(sample.value, Twist) and sample.value.angular is not None:
        return [*sample.value.angular]
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
