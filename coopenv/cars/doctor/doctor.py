"""The gate: all checks of streams, the treatment of what contradicts, and the streams without it.

A fault hides others. So the first check that finds one is mended in memory, whatever its treatment, and all checks look
again, until no check finds more. A fault without which the others explain everything is taken back at the end, as a
backward elimination of regressors does. Source: Draper and Smith, Applied Regression Analysis, 1998, chapter 15.
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np

from coopenv.cars.bags.clocks import CAMERAS
from coopenv.cars.calibration.drives import CalibrationDrive
from coopenv.cars.doctor.constants import of_constants
from coopenv.cars.doctor.conventions import of_conventions
from coopenv.cars.doctor.finding import Diagnosis, Finding, Mend, Treatment
from coopenv.cars.doctor.flips import of_flips
from coopenv.cars.doctor.motion import of_frozen_streams, of_noise, of_turning, of_velocity, turns_contradict
from coopenv.cars.doctor.sight import exchanged_bodies, of_sight
from coopenv.cars.doctor.slip import of_slip
from coopenv.cars.doctor.streams import MOVING, TURNING, CarStreams, Streams
from coopenv.cars.doctor.turning import constant_turn_rate
from coopenv.cars.messages.readings import Detections, Sample, Twist
from coopenv.cars.settings.profile import Role

REMOVED = (Treatment.MENDED, Treatment.LEFT_OUT)
"""Treatments after which a stream is without the fault."""
FEW = 20  # detections
SHORT = 2.0
"""s up to which a contradiction refuses no drive."""
ROUNDS = 6
"""Times that all checks look at a car."""
Check = Callable[[CarStreams], Iterator[Diagnosis]]


@dataclass
class Examined:
    """The findings of a gate, the mends of samples, and the streams without all faults that are known."""

    findings: list[Finding] = field(default_factory=list)
    mends: list[Mend] = field(default_factory=list)
    cars: dict[str, CarStreams] = field(default_factory=dict)
    spoilt: set[str] = field(default_factory=set)
    """Cars with a fault that nothing removes."""
    parts: set[str] = field(default_factory=set)
    """Constants that are estimated already, by the titles of a calibration."""

    def mended(self, samples: Sequence[Sample]) -> list[Sample]:
        """Return samples without the faults that are mended."""
        for mend in self.mends:
            samples = [changed for sample in samples if (changed := mend(sample)) is not None]
        return [*samples]


def treated(finding: Finding, trusted: Collection[str]) -> Finding:
    """Return a finding, its stream unchanged if it is trusted."""
    return replace(finding, treatment=Treatment.TRUSTED) if {finding.subject, "all"} & {*trusted} else finding


def examine(
    streams: Streams, trusted: Collection[str] = (), counts: Callable[[CarStreams], bool] = lambda car: True
) -> Examined:
    """Return what is wrong with the streams of all cars, but for constants and clocks.

    Args:
        streams: of a bag or of live cars.
        trusted: topics, or other subjects of findings, that stay unchanged.
        counts: whether a car is looked at.
    """
    cars = (streams.car(name) for name in streams.binding.cars)
    return examine_cars([car for car in cars if car.samples and counts(car)], trusted)


def examine_cars(cars: Iterable[CarStreams], trusted: Collection[str] = ()) -> Examined:
    """Return what is wrong with the streams of cars, as `examine` does."""
    found, by_name = Examined(), {car.name: car for car in cars}
    for one, other in combinations([*by_name], 2):
        if right := exchanged_bodies(by_name[one], by_name[other]):
            text, key = f"motion capture of {one} and {other} is exchanged", "the key `body` of both cars"
            about = [Finding(car.topic([Role.TRUTH]), text, key=key, car=car.name) for car in right]
            found.findings += [treated(finding, trusted) for finding in about]
            by_name |= {car.name: car for car in right}
    for name, car in by_name.items():
        diagnoses = diagnosed(car)
        found.cars[name] = changed(car, diagnoses)
        for each in diagnoses:
            mend, finding = _mend_of(each, car), treated(each.finding, trusted)
            found.findings.append(finding)
            found.parts |= {*each.parts}
            if finding.treatment in REMOVED:
                found.mends.append(mend)
            elif each.change is None:
                found.spoilt.add(name)
        named = {each.finding.subject for each in diagnoses}
        noisy = (finding for finding in of_noise(car) if finding.subject not in named)
        found.findings += [treated(finding, trusted) for finding in (*_of_detections(car), *noisy)]
    return found


def diagnosed(car: CarStreams) -> list[Diagnosis]:
    """Return the faults of a car that together explain what its streams contradict."""
    found: list[Diagnosis] = []
    for _ in range(ROUNDS):
        new = next(_unnamed(changed(car, found), found), [])
        if not new:
            break
        found += new
    for each in found[:-1]:
        others = [other for other in found if other is not each]
        if not any(_unnamed(changed(car, others), others)):
            found = others
    return found


def changed(car: CarStreams, diagnoses: Iterable[Diagnosis]) -> CarStreams:
    """Return a car without the faults that are known."""
    for each in diagnoses:
        car = car if each.change is None else each.change(car)
    return car


def _unnamed(car: CarStreams, named: Sequence[Diagnosis]) -> Iterator[list[Diagnosis]]:
    """Yield what each check finds, but for what is named already, in the order in which faults hide each other."""
    known = {_words(each.finding) for each in named}
    unexplained = any(each.change is None and each.finding.subject == car.topic([Role.TRUTH]) for each in named)
    checks: list[Check] = [_of_unmeasured, of_flips, _of_constant_turning, of_frozen_streams]
    checks += [*([] if unexplained else [of_conventions, of_sight]), partial(_of_motion, unexplained=unexplained)]
    for check in checks:
        if new := [each for each in check(car) if _words(each.finding) not in known]:
            yield new


def _words(finding: Finding) -> tuple[str, str]:
    """Return the subject and the text of a finding without its numbers."""
    return finding.subject, re.sub(r"[-\d.()]+", "", finding.text.partition(":")[0])


def _of_unmeasured(car: CarStreams) -> Iterator[Diagnosis]:
    for what, kind, roles in (("velocity", "wheel", MOVING), ("turn rate", "gyro", TURNING)):
        role = next((role for role in roles if role in car.topics), None)
        if role is not None and not len(car.tracks[kind]) and (n := sum(s.role is role for s in car.samples)):
            text = f"the {what} of {car.name} is measured in none of {n} messages: variances of -1, or NaN"
            about = Finding(car.topics[role], text, treatment=Treatment.REFUSED, car=car.name)
            yield Diagnosis(about)


def _of_constant_turning(car: CarStreams) -> Iterator[Diagnosis]:
    if why := constant_turn_rate(car.tracks, car.sightings_in_plane, car.wheelbase):
        text, lasted = f"the turn rate of {car.name} {why}", np.ptp(car.tracks["gyro_time"])
        treatment = Treatment.REFUSED if lasted > SHORT else Treatment.USED
        about = Finding(car.topic(TURNING), text, treatment=treatment, car=car.name)
        yield Diagnosis(about, (lambda car: car.following_truth("gyro")) if car.truth_signals else None)


def _of_motion(car: CarStreams, unexplained: bool) -> Iterator[Diagnosis]:
    use_truth = not (unexplained and turns_contradict(car))
    if use_truth and car.truth_signals is not None:
        yield from of_slip(car, *car.truth_signals)
    if len(rates := car.tracks["gyro"]) and np.ptp(rates) > 0.0:
        yield from of_turning(car, use_truth)
    yield from of_velocity(car, use_truth)


def _mend_of(diagnosis: Diagnosis, car: CarStreams) -> Mend:
    """Return the change of a car's samples that removes a fault, by its key if it has no other."""
    change = diagnosis.mend or partial(_by_key, diagnosis.finding.key)
    return lambda sample: change(sample) if sample.car == car.name else sample


def _by_key(given: str, sample: Sample) -> Sample:
    """Return a sample with the factor of a key, or turned by its own pose."""
    (key, _, value), twist = given.partition(" = "), sample.value
    if not isinstance(twist, Twist):
        return sample
    if key.endswith("gyro_factor") and twist.angular is not None:
        twist = replace(twist, angular=float(value) * twist.angular)
    elif key.endswith("wheel_factor") and twist.linear is not None:
        twist = replace(twist, linear=float(value) * twist.linear)
    elif key and not value and twist.linear is not None and twist.pose is not None:
        R = twist.pose.rotation
        twist = twist if R is None else replace(twist, linear=R.T @ twist.linear)
    return replace(sample, value=twist)


def examine_constants(
    found: Examined, drive_of: Callable[[CarStreams], CalibrationDrive], trusted: Collection[str] = ()
) -> list[Finding]:
    """Return wrong constants of all cars; of cars with a fault that nothing removes they are not looked at.

    Args:
        found: the examination of the cars, whose streams are without the faults that are known.
        drive_of: returns the drive of a car alone.
        trusted: subjects of findings that stay unchanged.
    """
    constants: list[Finding] = []
    for name, car in found.cars.items():
        if name not in found.spoilt:
            new = (each for each in of_constants(partial(drive_of, car)) if each.subject not in found.parts)
            constants += [treated(finding, trusted) for finding in new]
    return [*dict.fromkeys(constants)]


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
