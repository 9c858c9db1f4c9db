"""What stops the cars whatever the program that drives them does: a thread of its own."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from coopenv.backends.svea.gates import OLD, Gates
from coopenv.backends.svea.station import Station
from coopenv.estimation.arrays import Array
from coopenv.svea.deployment import Safety

PERIOD = 0.01  # s between looks
REPEAT = 0.2  # s between emergency stops that are sent again
STALL = 0.05  # s by which a look may come late: beyond that messages wait to be received, and silence says nothing yet
OPEN = ("armed", "timed_out")
"""States of a gate that takes commands: one that has timed out lets the car stand until the next one."""


@dataclass(frozen=True)
class Watched:
    """What the watchdog looks at of one car."""

    odometry: tuple[str, ...]  # topics, of which each has to come
    truth: str | None  # topic; None: it is not watched


@dataclass(frozen=True)
class Trip:
    """Why the cars were stopped."""

    reason: str
    car: str | None = None  # whose fault it was; None: nobody's
    time: float = 0.0  # monotonic, s


class Watchdog:
    """Looks after cars while they are armed; once it has stopped them they stay so until it is armed again."""

    def __init__(
        self,
        safety: Safety,
        station: Station,
        gates: Gates,
        cars: Mapping[str, Watched],
        positions: Callable[[], Mapping[str, Array]],
        decision: float,
    ) -> None:
        """Begin to look.

        Args:
            safety: what is allowed.
            station: where messages come.
            gates: of the cars.
            cars: what is watched, by name.
            positions: where the cars are by what judges them, map, m; NaN: not known.
            decision: s between decisions.
        """
        self._safety, self._station, self._gates, self._cars = safety, station, gates, cars
        self._positions, self._decision = positions, decision
        self._lock = threading.Lock()
        self._armed, self._closed = False, threading.Event()
        self.trip: Trip | None = None
        self._beat: float | None = None  # of the last decision; None: there has been none
        self._missed = 0
        self._present: dict[str, bool] = {}
        self._overridden: dict[str, bool] = {}
        self._thread = threading.Thread(target=self._watch, name="coopenv watchdog", daemon=True)
        self._thread.start()

    def forget(self) -> None:
        """Stop the cars no longer for what was before, so that they can be armed."""
        with self._lock:
            self.trip = None

    def arm(self) -> None:
        """Look after the cars from now on."""
        with self._lock:
            self._armed, self._beat, self._missed = True, None, 0

    def disarm(self) -> None:
        """Look no longer: the cars stand."""
        with self._lock:
            self._armed = False

    def beat(self, missed: int) -> None:
        """Say that a decision has been made, after `missed` in a row that came late."""
        self._beat, self._missed = time.monotonic(), missed

    def set_present(self, car: str, there: bool) -> None:
        """Say that a car's token has come or gone."""
        self._present[car] = there

    def set_overridden(self, car: str, overridden: bool) -> None:
        """Say whether somebody drives a car by the remote control."""
        self._overridden[car] = overridden

    def stop(self, reason: str, car: str | None = None) -> None:
        """Stop all cars at once; the first reason stands."""
        with self._lock:
            if not self._armed:
                return
            self._armed, self.trip = False, Trip(reason, car, time.monotonic())
        self._gates.stop()
        self._gates.end()

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._thread.join(timeout=1.0)

    def _watch(self) -> None:
        repeated, looked, stalled = 0.0, time.monotonic(), False
        while not self._closed.wait(PERIOD):
            before, looked = looked, time.monotonic()
            stalled = not stalled and looked - before > PERIOD + STALL
            if stalled:  # once: the next look tells, and comes so soon that no car gets further for it
                continue
            if self._armed:
                try:
                    found = next(self._problems(), None)
                except Exception as error:  # a watchdog that fails has to stop the cars
                    found = Trip(f"the watchdog failed: {type(error).__name__}: {error}")
                if found is not None:
                    self.stop(found.reason, found.car)
            elif self.trip is not None and time.monotonic() - repeated > REPEAT:
                repeated = time.monotonic()
                self._gates.stop()

    def _problems(self) -> Iterator[Trip]:
        s = self._safety
        for car, watched in self._cars.items():
            for topic in watched.odometry:
                if (age := self._station.silence(topic)) > s.odometry_age:
                    yield Trip(f"{car}: no odometry on {topic} for {age:.2f} s", car)
            if watched.truth is not None and (age := self._station.silence(watched.truth)) > s.truth_age:
                yield Trip(f"{car}: no motion capture on {watched.truth} for {age:.2f} s", car)
            if self._present.get(car) is False:
                yield Trip(f"{car}: is gone", car)
            if self._overridden.get(car):
                yield Trip(f"{car}: is driven by remote control", car)
        for car, gate in self._gates.states.items():
            if gate.age > OLD:
                yield Trip(f"{car}: its gate is silent for {gate.age:.2f} s", car)
            elif gate.state not in OPEN or gate.session != self._gates.session:
                yield Trip(f"{car}: its gate is {gate.state}", car)
        if self._missed >= s.missed_deadlines:
            yield Trip(f"{self._missed} decisions in a row came too late")
        beat = self._beat
        if beat is not None and (age := time.monotonic() - beat) > (s.missed_deadlines + 1) * self._decision:
            yield Trip(f"no decision for {age:.2f} s")
        yield from self._misplaced()

    def _misplaced(self) -> Iterator[Trip]:
        s, places = self._safety, self._positions()
        if s.geofence:
            from matplotlib.path import Path as Polygon

            fence = Polygon(s.geofence)
            for car, place in places.items():
                if np.isfinite(place).all() and not fence.contains_point((float(place[0]), float(place[1]))):
                    yield Trip(f"{car}: left the geofence at ({place[0]:.2f}, {place[1]:.2f}) m", car)
        if s.separation > 0.0:
            names = [car for car, place in places.items() if np.isfinite(place).all()]
            for i, car in enumerate(names):
                for other in names[i + 1 :]:
                    distance = float(np.linalg.norm(places[car][:2] - places[other][:2]))
                    if distance < s.separation:
                        yield Trip(f"{car} and {other}: {distance:.2f} m apart, {s.separation:g} m is the least", car)
