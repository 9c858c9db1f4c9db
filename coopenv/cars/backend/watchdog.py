"""The watchdog: it looks by itself and stops the cars whatever the driving program does."""

import math
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.station import BYPASSED, OLD, OPEN, Gates, Station
from coopenv.cars.gate.gate import Reason
from coopenv.cars.messages.readings import CarPose, Sample
from coopenv.cars.settings.deployment import Safety
from coopenv.cars.settings.limits import inside
from coopenv.cars.settings.profile import Role, presence_of
from coopenv.estimation.poses import Array, skew
from coopenv.observers.contract import Message
from coopenv.sources.base import VehicleBroadcast


@dataclass(frozen=True)
class Place:
    """Position of a car."""

    position: Array  # (3,) m, in the coordinates of the scenario's file
    time: int  # ns, when that was known
    velocity: Array  # (3,) m/s, the mean over `VELOCITY_TIME`


def bearing_nis(sent: VehicleBroadcast, landmarks: Array, lever: Array, bearings: Array) -> Array:
    """Return the normalised innovation squared per degree of freedom (m,) of bearings to landmarks.

    Args:
        sent: the estimate.
        landmarks: (m, 3) map, m.
        lever: (3,) of the camera in the body frame, m.
        bearings: (m, 3) measured, unit vectors in the body frame.
    """
    found = []
    for landmark, bearing in zip(landmarks, bearings, strict=True):
        seen = sent.rotation.T @ landmark  # of it the error of (2 lambda, p) takes [seen]x and -I
        ray = seen - sent.rotation.T @ sent.position - lever
        distance = max(float(np.linalg.norm(ray)), 1e-3)
        across = np.eye(3) - np.outer(ray, ray) / distance**2
        J = across @ np.hstack([skew(seen), -np.eye(3)]) / distance
        tangent = across @ bearing
        angle = np.arctan2(np.linalg.norm(tangent), bearing @ ray / distance)
        r = tangent / max(float(np.linalg.norm(tangent)), 1e-9) * angle
        found.append(float(r @ np.linalg.solve(J @ sent.covariance @ J.T + BEARING_STD**2 * np.eye(3), r)) / 2.0)
    return np.array(found)


BEARING_STD = 0.01  # rad, with calibration
NIS_TIME = 1_000_000_000  # ns over which the median is taken
FEWEST = 8  # bearings of which it is taken
LASTING = 0.2  # s
UNSETTLED = 2.0  # s that an estimate has at first, while the car stands
VELOCITY_TIME = 200_000_000  # ns


class LinkMonitor:
    """Kept by the step loop, read by the watchdog's thread; times are in ns on the receiver's clock.

    Received bytes alone do not count: a message must be readable, with a stamp newer than all before (`Assembler.put`).
    """

    def __init__(self, judge: Literal["truth", "estimate"]) -> None:
        """Choose the source of the judged positions: motion capture, or the cars' estimates."""
        self._judging = (Role.TRUTH,) if judge == "truth" else (Role.ESTIMATE, Role.REPORT, Role.POINT)
        self._known_at: dict[tuple[str, Role], int] = {}
        self.odd: dict[tuple[str, Role], str] = {}
        """Why the last velocity by car and role is no car's."""
        self.begin(0)

    def begin(self, now: int) -> None:
        """Forget where the cars were."""
        self.places: Mapping[str, Place] = {}
        """Replaced as a whole whenever one changes."""
        self.looked = self._begun = now
        """Time of the last check of messages."""
        self._nis: dict[str, deque[tuple[int, float]]] = {}
        self._recent: dict[str, deque[Place]] = {}
        self._doubts: dict[str, tuple[str, int]] = {}  # why an estimate is wrong, and since when, ns
        self._well: dict[str, int] = {}  # since when an estimate has been within all limits, ns
        self._settled: set[str] = set()

    def put(self, sample: Sample) -> None:
        """Take a sample that is newer than all before of its car and role."""
        # Motion capture has a clock of its own with an unknown delay.
        known_at = sample.received if sample.role is Role.TRUTH else min(sample.stamp, sample.received)
        self._known_at[sample.car, sample.role] = known_at
        self.odd.pop((sample.car, sample.role), None)
        value = sample.value
        if sample.role in self._judging and isinstance(value, CarPose | Message) and value.position is not None:
            self.place(sample.car, value.position, known_at)

    def place(self, car: str, position: Array, time: int) -> None:
        """Set the position of a car, m, and the time at which it was known, ns."""
        if np.isfinite(position).all():
            recent = self._recent.setdefault(car, deque())
            while len(recent) > 1 and recent[1].time <= time - VELOCITY_TIME:
                recent.popleft()
            lasted, velocity = time - recent[0].time if recent else 0, np.zeros(3)
            if lasted > VELOCITY_TIME // 2:  # noise counts for too much before
                velocity = (position - recent[0].position) / (lasted * 1e-9)
            recent.append(Place(position, time, velocity))
            self.places = {**self.places, car: recent[-1]}

    def judge(
        self,
        car: str,
        safety: Safety,
        error: float,
        turn: float,
        std: float,
        level: float,
        nis: Array,
        known: bool = True,
    ) -> None:
        """Compare an estimate with the limits.

        Args:
            car: its name.
            safety: limits.
            error: distance to the true position, m; NaN: not known.
            turn: angle to the true orientation, rad; NaN: not known.
            std: of its position, m.
            level: horizontal protection level, m; inf: unknown.
            nis: per degree of freedom, of the bearings of its tick.
            known: whether its observer would broadcast the estimate; one that searches for the pose does not.
        """
        now, recent = self.looked, self._nis.setdefault(car, deque())
        recent.extend((now, float(value)) for value in nis)
        while recent and recent[0][0] < now - NIS_TIME:
            recent.popleft()
        median = float(np.median([value for _, value in recent])) if len(recent) >= FEWEST else 0.0
        measured = (
            (error, "max_error", " m from motion capture"),
            (turn, "max_turn_error", " rad from motion capture"),
            (std, "max_std", " m uncertain"),
            (level, "max_protection_level", " m off at worst, if one source is faulty"),
            (median, "max_nis", " squared standard deviations from its bearings"),
        )
        for value, name, what in measured:
            most = getattr(safety, name)
            if most is not None and value > most:
                why = f"its estimate is {value:.3g}{what}, safety.{name} = {most:g}"
                since_when = self._doubts[car][1] if car in self._doubts else now
                self._doubts[car] = why, since_when
                self._well.pop(car, None)
                return
        if not known:
            self._well.pop(car, None)
        elif (now - self._well.setdefault(car, now)) * 1e-9 > LASTING:
            self._settled.add(car)
        if self.settled(car):
            self._doubts.pop(car, None)

    def settled(self, car: str) -> bool:
        """Return whether the estimate of a car has once been within all limits for long enough to drive by it."""
        return car in self._settled

    def doubt(self, car: str) -> str:
        """Return why the estimate of a car has been wrong for too long; empty: it has not."""
        why, since_when = self._doubts.get(car, ("", self.looked))
        return why if (self.looked - since_when) * 1e-9 > (LASTING if self.settled(car) else UNSETTLED) else ""

    def age(self, car: str, role: Role) -> float:
        """Return the age of a sensor's last message when messages were looked at last, s; inf: none was received."""
        known_at = self._known_at.get((car, role))
        return float("inf") if known_at is None else max(self.looked - known_at, 0) * 1e-9

    def lost(self, car: str) -> float:
        """Return for how long a car's position had been unknown when messages were looked at last, s."""
        place = self.places.get(car)
        return max(self.looked - (self._begun if place is None else place.time), 0) * 1e-9


def since(age: float) -> str:
    """Return the time since a last message, s, in words."""
    return "(none was received)" if math.isinf(age) else f"for {age:.2f} s"


PERIOD = 0.01  # s between looks
REPEAT = 0.2  # s between emergency stops that are sent again
STALL = 0.05  # s by which a look may come late: messages may still wait to be received then


@dataclass(frozen=True)
class Trip:
    """Why the cars were stopped."""

    reason: str
    car: str = ""  # that caused it; empty: no single car
    time: float = 0.0  # steady, s


@dataclass(eq=False, repr=False)
class Watchdog:
    """Watches armed cars. Once it has stopped them, they stand until it is armed again."""

    safety: Safety
    station: Station
    gates: Gates
    monitor: LinkMonitor
    cars: Collection[str]  # that are driven here
    others: Collection[str]  # of the fleet
    odometry: Collection[Role]  # required measurements of each car
    decision: float  # s between decisions
    happened: Callable[[str], str] = lambda car: ""  # the reason to stop a car by its own conditions; empty: none
    stopped: Callable[[Trip], None] = lambda trip: None  # called when the cars are stopped

    def __post_init__(self) -> None:
        """Begin to look."""
        self._lock = threading.Lock()
        self._armed, self._clock = False, self.gates.clock
        self.trip: Trip | None = None
        self._beat: float | None = None  # of the last decision; None: there has been none
        self._missed = 0
        self._present = dict.fromkeys(map(presence_of, self.cars), True)
        self._repeated, self._looked, self._stalled = 0.0, self._clock.seconds(), False
        self._closed, self._end = False, self._clock.repeat(PERIOD, self._look, "coopenv watchdog")

    def forget(self) -> None:
        """Clear the last stop, so that cars can be armed."""
        with self._lock:
            self.trip = None

    def arm(self) -> None:
        """Watch the cars from now on. Raises CoopenvError: the watchdog has ended."""
        if self._closed:
            raise CoopenvError("not armed: the watchdog has ended")
        with self._lock:
            self._armed, self._beat, self._missed = True, None, 0

    def disarm(self) -> None:
        """Stop watching: the cars stand."""
        with self._lock:
            self._armed = False

    def beat(self, missed: int) -> None:
        """Note a decision, after `missed` late ones in a row."""
        self._beat, self._missed = self._clock.seconds(), missed

    def set_present(self, token: str, there: bool) -> None:
        """Note that a token of presence has appeared or disappeared; tokens of other ends do not count."""
        if token in self._present:
            self._present[token] = there

    def stop(self, reason: str, car: str = "") -> None:
        """Stop all cars at once; the first reason stands."""
        with self._lock:
            if not self._armed:
                return
            self._armed = False
            self.trip = trip = Trip(reason, car, self._clock.seconds())
        try:
            self.gates.stop()
            self.stopped(trip)
        finally:
            self.gates.end()

    def close(self) -> None:
        """Look no more."""
        self._closed = True
        self._end()

    def _look(self) -> None:
        before, self._looked = self._looked, self._clock.seconds()
        self._stalled = not self._stalled and self._looked - before > PERIOD + STALL
        if self._stalled:  # once: the next look follows at once
            return
        with suppress(Exception):  # of the network, during a stop: it is repeated
            if self._armed:
                try:
                    found = next(self._problems(), None)
                except Exception as error:  # a watchdog that fails has to stop the cars
                    found = "", f"the watchdog failed: {type(error).__name__}: {error}"
                if found is not None:
                    car, why = found
                    self.stop(f"{car}: {why}" if car else why, car)
            elif self.trip is not None and self._looked - self._repeated > REPEAT:
                self._repeated = self._looked
                self.gates.stop()

    def _problems(self) -> Iterator[tuple[str, str]]:
        """Yield the car and the reason of each violated rule; a car is empty where it is no single one."""
        away = [car for car in self.cars if not self._present[presence_of(car)]]
        for car in self.cars:
            yield from ((car, why) for why in self.silent(car))
            if car in away:
                yield car, "is gone" + (", as others: is the router running?" if len(away) > 1 else "")
            if why := self.happened(car) or self.monitor.doubt(car):
                yield car, why
        for car, gate in self.gates.states.items():
            if gate.age > OLD:
                yield car, f"its gate is silent for {gate.age:.2f} s"
            elif gate.state not in OPEN:
                foreign = self.gates.refused(car).get(Reason.FOREIGN)
                yield car, f"its gate is {gate.state}" + (f": {foreign} {BYPASSED}" if foreign else "")
            elif gate.session != self.gates.session:
                yield car, "another station has armed its gate"
            elif beyond := self.gates.refused(car).get(Reason.LIMITS):
                yield car, f"its gate has refused {beyond} commands: its limits are lower than those of the file here"
        missed, beat = self.safety.missed_deadlines, self._beat
        if self._missed >= missed:
            yield "", f"{self._missed} decisions in a row came too late"
        if beat is not None:
            if (age := self._clock.seconds() - beat) > (missed + 1) * self.decision:
                yield "", f"no decision for {age:.2f} s"
            yield from self.misplaced()

    def silent(self, car: str) -> Iterator[str]:
        """Yield the topics of a car's odometry without a message, or a usable one, for too long, in words."""
        for role in self.odometry:
            topic = self.gates.profile.topic_of(car, role)
            ages = {"odometry": self.station.silence(topic), "usable new message": self.monitor.age(car, role)}
            for what, age in ages.items():
                if age > self.safety.odometry_age:
                    why = self.monitor.odd.get((car, role), "")
                    yield f"no {what} on {topic} {since(age)}{f': {why} (another unit?)' if why else ''}"

    def misplaced(self) -> Iterator[tuple[str, str]]:
        """Yield cars with a position that violates a rule, and the violation in words.

        Cars that are driven here have to be inside the fence, and apart from all.
        """
        safety, monitor, cars = self.safety, self.monitor, self.cars
        apart = safety.separation > 0.0
        watched = [*cars, *self.others] if apart else [*cars] if safety.geofence else []
        for car in watched:
            never = car not in monitor.places
            allowed = max(safety.truth_age, UNSETTLED) if never else safety.truth_age
            if monitor.lost(car) > allowed or (never and safety.judge == "truth"):
                unknown = "is not known" if never else f"has not been known for {monitor.lost(car):.2f} s"
                rules = {"fence": safety.geofence and car in cars, "separation": apart}
                by = " and ".join(name for name, judged in rules.items() if judged)
                yield car, f"its place {unknown}: {by} cannot be judged"
        places = {car: monitor.places[car].position[:2] for car in watched if car in monitor.places}
        ways = {car: self._way_to_stand(monitor.places[car]) for car in places}
        for car in cars:
            if safety.geofence and car in places:
                (x, y), way = places[car], ways[car]
                if not inside(safety.geofence, x, y):
                    yield car, f"left the geofence at ({x:.2f}, {y:.2f}) m"
                elif not inside(safety.geofence, x + way[0], y + way[1]):
                    yield car, f"at ({x:.2f}, {y:.2f}) m it needs {np.linalg.norm(way):.2f} m to stand in the geofence"
        for car, other in combinations(places, 2) if apart else ():
            between, nearing = places[car] - places[other], ways[other] - ways[car]
            now = float(np.linalg.norm(between))  # both stop at once: straight on, in equal shares of their ways
            share = np.clip(between @ nearing / max(float(nearing @ nearing), 1e-9), 0.0, 1.0)
            least = float(np.linalg.norm(between - share * nearing))
            if least < safety.separation and (car in cars or other in cars):
                near = "" if now < safety.separation else f", and {least:.2f} m where they come to a stand"
                yield car, f"{now:.2f} m from {other}{near}, {safety.separation:g} m is the least"

    def _way_to_stand(self, place: Place) -> Array:
        """Return the vector (2,), m, along which a car moves until it stands, by the cause of the longest way."""
        speed = float(np.linalg.norm(place.velocity[:2]))
        way = max(way for _, way in self.safety.stopping(speed, self.gates.profile.command).values())
        return place.velocity[:2] * (way / max(speed, 1e-9))
