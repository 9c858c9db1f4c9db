"""The gate for live cars: the same checks, on a window of the last samples."""

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from coopenv.cars.backend.binding import Binding
from coopenv.cars.calibration.drives import drive_of_car
from coopenv.cars.doctor.doctor import REMOVED, examine, examine_constants
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.doctor.streams import CarStreams, Streams
from coopenv.cars.doctor.turning import constant_turn_rate
from coopenv.cars.messages.readings import Sample, Twist, without_outliers
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role

KEPT, MOST = 20_000_000_000, 60_000  # ns of the last samples of a car, and samples
MOVED = 0.3  # m
LASTS = 1_000_000_000  # ns for which a result holds


class StreamMonitor:
    """The last samples of live cars, and what contradicts in them.

    A finding stands until its car has moved without it.
    """

    def __init__(
        self, binding: Binding, trusted: Collection[str] = (), lenses: Mapping[str, Calibration] | None = None
    ) -> None:
        """Begin without samples; `trusted` are subjects of findings that do not count, `lenses` those of cameras."""
        self._binding, self._trusted, self._lenses = binding, trusted, lenses or {}
        self._kept = {car: deque[Sample](maxlen=MOST) for car in binding.cars}
        self._rates: dict[str, float] = {}
        self._turning: set[str] = set()
        self._constant: dict[str, str] = {}  # last contradictions, which stand until a turn rate changes
        self._looked = 0
        self._found: dict[str, list[Finding]] = {}

    def begin(self) -> None:
        """Forget the samples, as cars are moved to another place; a turn rate that never changed stays known."""
        self.findings()
        for car in self._turning:
            self._kept[car].clear()

    def put(self, sample: Sample) -> None:
        """Take a sample, with the turn rate that is used, or a command; earlier ones of a later time are forgotten."""
        if (kept := self._kept.get(sample.car)) is None:
            return
        if kept and sample.received < kept[-1].received - LASTS:  # the clock was set back
            self._looked = 0
            for each in self._kept.values():
                each.clear()
        while kept and kept[0].received < sample.received - KEPT:
            kept.popleft()
        if isinstance(sample.value, Twist) and sample.value.angular is not None:
            rate = float(sample.value.angular[2])
            if self._rates.setdefault(sample.car, rate) != rate:
                self._turning.add(sample.car)
        kept.append(sample)

    def contradiction(self, car: str) -> str | None:
        """Return what contradicts a turn rate that never changes, see `constant_turn_rate`."""
        if car in self._turning:
            return None
        streams = Streams([*self._kept[car]], self._binding, {}).car(car)
        if why := constant_turn_rate(streams.tracks, streams.sightings_in_plane, streams.wheelbase):
            self._constant[car] = why
        return self._constant.get(car)

    def findings(self) -> list[Finding]:
        """Return the streams that others contradict; a result holds for a second of the samples."""
        samples = self._samples()
        now = max((sample.received for sample in samples), default=0)
        if now > self._looked + LASTS:
            self._looked = now
            self._found |= examined(samples, self._binding, self._trusted, self._lenses)
        return [finding for found in self._found.values() for finding in found]

    def constants(self) -> list[Finding]:
        """Return wrong constants of cars that have moved; the least squares take up to a second of CPU."""
        found = examined(self._samples(), self._binding, self._trusted, self._lenses, constants=True)
        return [finding for some in found.values() for finding in some if finding.treatment is Treatment.USED]

    def _samples(self) -> list[Sample]:
        return [sample for kept in self._kept.values() for sample in kept]


def examined(
    samples: Sequence[Sample],
    binding: Binding,
    trusted: Collection[str] = (),
    lenses: Mapping[str, Calibration] | None = None,
    *,
    constants: bool = False,
) -> dict[str, list[Finding]]:
    """Return, of live cars that have moved, the streams that others contradict by a known cause; nothing is mended.

    What a bag mends is refused here: gate and watchdog use the streams as they come. So is wrong motion capture, by
    which the distances of cars are judged. Poor detections are left out here, too. Other findings stay warnings.
    Contradictions without a known cause are the watchdog's, which compares estimates. From one place many causes look
    alike, so that cars that have stood are left out.

    Args:
        samples: those of a topic in the order of their reception.
        binding: of the fleet.
        trusted: subjects of findings that do not count.
        lenses: of the cameras of cars.
        constants: whether wrong constants are looked for, too.
    """
    roles = {(s.car, s.role) for s in samples if s.role in binding.profile.topics}
    by_topic = [[s for s in samples if (s.car, s.role) == key] for key in {(s.car, s.role) for s in samples}]
    samples = sorted((s for own in by_topic for s in without_outliers(own, Counter())), key=lambda s: s.stamp)
    topics = {(car, role): binding.profile.topic_of(car, role) for car, role in roles}
    streams = Streams(samples, binding, topics, lenses or {})
    found = examine(streams, trusted, moved)
    given = [*found.findings, *(examine_constants(found, partial(drive_of_car, streams), trusted) if constants else ())]
    truth = {topic for (_, role), topic in topics.items() if role is Role.TRUTH}
    counted = [f for f in given if f.explained and f.treatment is not Treatment.TRUSTED]
    counted = [f for f in counted if f.treatment is not Treatment.LEFT_OUT or f.subject in truth]
    refused = [replace(f, treatment=Treatment.REFUSED) if f.subject in truth else f for f in counted]
    refused = [replace(f, treatment=Treatment.REFUSED) if f.treatment in REMOVED else f for f in refused]
    return {car: [f for f in refused if f.car == car] for car in found.cars}


def moved(car: CarStreams) -> bool:
    """Return whether a car has moved, by motion capture."""
    place = car.tracks["truth"]
    return bool(np.abs(place - place[:1]).max(initial=0.0) > MOVED)
