"""The gate: all checks of streams, the treatment of what contradicts, and the streams without it."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from coopenv.cars.bags.clocks import CAMERAS
from coopenv.cars.doctor.constants import of_constants
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.doctor.motion import LEAST, of_frozen_streams, of_turning, of_velocity, turns_contradict
from coopenv.cars.doctor.sight import BAD, explanation, of_sight, sight_of
from coopenv.cars.doctor.streams import TURNING, CarStreams, Streams
from coopenv.cars.doctor.turning import turn_contradiction
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist
from coopenv.cars.settings.profile import Role
from coopenv.estimation.poses import Array

REMOVED = (Treatment.MENDED, Treatment.LEFT_OUT)
"""Treatments after which a stream is without the fault."""
FEW = 20  # detections
SHORT = 2.0
"""s up to which a contradiction refuses no drive."""
Mend = Callable[[Sample], Sample | None]
"""Returns a sample without a fault; None: it is left out."""


@dataclass
class Examined:
    """The findings of a gate, and the mends of samples."""

    findings: list[Finding] = field(default_factory=list)
    mends: list[Mend] = field(default_factory=list)

    def mended(self, samples: Sequence[Sample]) -> list[Sample]:
        """Return samples without the faults that are mended."""
        for mend in self.mends:
            samples = [changed for sample in samples if (changed := mend(sample)) is not None]
        return [*samples]


def treated(finding: Finding, trusted: Collection[str]) -> Finding:
    """Return a finding, its stream unchanged if it is trusted."""
    return replace(finding, treatment=Treatment.TRUSTED) if {finding.subject, "all"} & {*trusted} else finding


def examine_motion(streams: Streams, trusted: Collection[str] = ()) -> Examined:
    """Return what is wrong with turn rates and velocities of all cars.

    Args:
        streams: of a bag or of live cars.
        trusted: topics, or other subjects of findings, that stay unchanged.
    """
    found = Examined()
    for name in streams.binding.cars:
        car = streams.car(name)
        if not car.samples:
            continue
        for finding in _of_motion(streams, car):
            mend = _mend_of(finding, car)
            finding = treated(finding, trusted)
            found.findings.append(finding)
            if finding.treatment in REMOVED:
                found.mends.append(mend)
    return found


def _of_motion(streams: Streams, car: CarStreams) -> Iterator[Finding]:
    scenario = streams.binding.scenario
    mounting = scenario.cameras[car.vehicle].to_body()
    practical = max(LEAST, 3.0 * scenario.noises[car.vehicle].odometry_scale)
    if why := turn_contradiction(car.samples, streams.binding, car.name):
        text, lasted = f"the turn rate of {car.name} {why}", np.ptp(car.tracks["gyro_time"])
        treatment = Treatment.REFUSED if lasted > SHORT else Treatment.USED
        yield Finding(car.topic(TURNING), text, treatment=treatment, car=car.name)
        return
    frozen = [*of_frozen_streams(car)]
    yield from frozen
    if not frozen:
        use_truth = not _truth_is_wrong(streams, car, mounting)
        yield from of_turning(car, mounting, practical, use_truth)
        yield from of_velocity(car, practical, use_truth)


def _truth_is_wrong(streams: Streams, car: CarStreams, mounting: Array) -> bool:
    """Return whether bearings show that motions by motion capture are wrong."""
    sight = sight_of(streams, car, _height(streams, car))
    if sight is None or sight.misfit() < BAD:
        return False
    found = explanation(sight, car, *names_of(streams))
    wrong = any(cause.subject == car.topic([Role.TRUTH]) and not cause.rigid for cause in found)
    return wrong or (not found and turns_contradict(car, mounting))


def names_of(streams: Streams) -> tuple[list[str], dict[int, int]]:
    """Return the names of the standing landmarks, and the numbers of their markers by landmark."""
    standing = streams.standing
    names = [streams.binding.scenario.landmarks[i].name for i in standing]
    return names, {standing.index(t): n for n, t in streams.binding.targets.items() if t in standing}


def _height(streams: Streams, car: CarStreams) -> float:
    """Return the height of a car's origin, m, as a calibration has it."""
    start = streams.binding.scenario.vehicles[car.vehicle].initial_pose
    return start.position[2] if start is not None and start.position is not None else 0.0


def _mend_of(finding: Finding, car: CarStreams) -> Mend:
    """Return the change of samples that removes a finding that can be mended, or leaves out what repeats itself."""
    key, _, value = finding.key.partition(" = ")
    factor, last = float(value or 1.0), [np.full(3, np.nan)]

    def mend(sample: Sample) -> Sample | None:
        twist = sample.value
        if sample.car != car.name:
            return sample
        if finding.treatment is Treatment.LEFT_OUT and sample.role is Role.TRUTH and isinstance(twist, CarPose):
            same, last[0] = np.array_equal(twist.position, last[0]), twist.position
            return None if same else sample
        if not isinstance(twist, Twist):
            return sample
        if key.endswith("gyro_factor") and twist.angular is not None:
            twist = replace(twist, angular=factor * twist.angular)
        elif key.endswith("wheel_factor") and twist.linear is not None:
            twist = replace(twist, linear=factor * twist.linear)
        elif key and not value and twist.linear is not None and twist.pose is not None:
            R = twist.pose.rotation
            twist = twist if R is None else replace(twist, linear=R.T @ twist.linear)
        return replace(sample, value=twist)

    return mend


def examine_map(streams: Streams, before: Sequence[Finding] = (), trusted: Collection[str] = ()) -> list[Finding]:
    """Return what is wrong with cameras, map, motion capture and constants of all cars.

    Args:
        streams: of a bag, their velocities and turn rates mended.
        before: findings of the motion; constants of a car of which one is not mended are not looked at.
        trusted: subjects of findings that stay unchanged.
    """
    found = examine_sight(streams, trusted)
    spoilt = {finding.car for finding in (*before, *found) if finding.treatment not in REMOVED}
    for name in streams.binding.cars:
        if name not in spoilt and any(sample.car == name for sample in streams.samples):
            found += [treated(finding, trusted) for finding in of_constants(streams, name, True)]
    return [*dict.fromkeys(found)]


def examine_sight(streams: Streams, trusted: Collection[str] = ()) -> list[Finding]:
    """Return the coarse part of `examine_map`: without least squares, and only with motion capture."""
    found: list[Finding] = []
    for name in streams.binding.cars:
        car = streams.car(name)
        found += _of_detections(car)
        sight = sight_of(streams, car, _height(streams, car))
        found += [] if sight is None else of_sight(sight, car, *names_of(streams))
    return [treated(finding, trusted) for finding in found]


OUTSIDE = 0.1
"""Share of detections beyond the image, a tenth: those of another size or region lose at least a fifth of its area."""


def _of_detections(car: CarStreams) -> Iterator[Finding]:
    """Yield detections that were left out for their quality, or for pixels that the image does not have."""
    frames = [s.value for s in car.samples if isinstance(s.value, Detections)]
    poor, outside = sum(frame.poor for frame in frames), sum(frame.outside for frame in frames)
    total, topic = sum(len(frame.markers) + frame.dropped for frame in frames), car.topic(CAMERAS)
    if poor:
        text = f"{poor} of {total} detections have a low quality: margin, score or Hamming distance"
        key = "vision.least_margin, least_score or most_hamming"
        yield Finding(topic, text, poor, float(np.sqrt(poor)), key, Treatment.LEFT_OUT, car.name)
    if outside > max(OUTSIDE * total, FEW) and car.lens is not None:
        width, height = car.lens.image_size
        text = f"{outside} of {total} detections are beyond the image of {width} x {height} pixels: "
        text += "is CameraInfo of another size, binning or region of interest?"
        yield Finding(topic, text, outside, float(np.sqrt(outside)), car=car.name)
