"""Fake cars and stations in lockstep: one process, one simulated clock, and a network within the process."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coopenv.cars.backend.backend import Svea, open_svea
from coopenv.cars.clock import CLOCK, Clock, SimulatedClock
from coopenv.cars.fake.car import Fake
from coopenv.cars.fake.fleet import fleet_of_fakes, prepare_fake
from coopenv.cars.profile import Role
from coopenv.cars.see import FrameReader
from coopenv.cars.transport import Arrival, Callback, Change, matcher
from coopenv.cars.vision import Calibration

Matcher = Callable[[str], bool]


class Hub:
    """A network within this process."""

    def __init__(self, clock: Clock = CLOCK) -> None:
        """Begin without connections; `clock` gives the times of reception."""
        self.clock, self._lock = clock, threading.RLock()
        self._subscribers: list[tuple[Matcher, Callback, object]] = []
        self._watchers: list[tuple[Matcher, Change, object]] = []
        self._present: list[tuple[str, object]] = []

    def connect(self) -> "HubTransport":
        """Return a connection."""
        return HubTransport(self)


class HubTransport:
    """A connection to a hub; messages are delivered in the sender's thread."""

    def __init__(self, hub: Hub) -> None:
        """Connect."""
        self._hub = hub
        self._closed = False

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Deliver a message."""
        arrival = Arrival(topic, payload, self._hub.clock.wall(), attachment)
        with self._hub._lock:
            called = [callback for matches, callback, _ in self._hub._subscribers if matches(topic)]
        for callback in called if not self._closed else ():
            callback(arrival)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        with self._hub._lock:
            self._hub._subscribers.append((matcher(pattern), callback, self))

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        with self._hub._lock:
            new = all(name != known for known, _ in self._hub._present)
            self._hub._present.append((name, self))
        if new:
            self._notify(name, True)

    def watch(self, pattern: str, callback: Change) -> None:
        """Watch, see `Transport`."""
        matches = matcher(pattern)
        with self._hub._lock:
            self._hub._watchers.append((matches, callback, self))
            there = {name for name, _ in self._hub._present if matches(name)}
        for name in sorted(there):
            callback(name, True)

    def close(self) -> None:
        """Leave the hub."""
        hub = self._hub
        with hub._lock:
            self._closed = True
            hub._subscribers = [entry for entry in hub._subscribers if entry[2] is not self]
            hub._watchers = [entry for entry in hub._watchers if entry[2] is not self]
            before = {name for name, _ in hub._present}
            hub._present = [entry for entry in hub._present if entry[1] is not self]
            gone = before - {name for name, _ in hub._present}
        for name in sorted(gone):
            self._notify(name, False)

    def _notify(self, name: str, there: bool) -> None:
        with self._hub._lock:
            called = [callback for matches, callback, _ in self._hub._watchers if matches(name)]
        for callback in called:
            callback(name, there)


class LockstepFakes:
    """The fake cars of a deployment, with their gates, on a simulated clock that their station moves on.

        cars = LockstepFakes("fleet.toml")
        env = coopenv.parallel_env("svea_overtaking", backend=cars.station("svea_overtaking"))

    Messages take no time but what `[fake]` says, and computing none. The same seeds give the same drive.
    """

    def __init__(self, path: str | Path, seed: int = 0, station: str | None = None) -> None:
        """Build the cars.

        Args:
            path: deployment file; its network does not count here.
            seed: see `coopenv.cars.fake.car.Fake`.
            station: whose commands count at the gates (None: those of the file's `security.identity`).

        Raises:
            CoopenvError: the file or its environment is not valid, or its cars are not fakes.
        """
        fleet, self._path = fleet_of_fakes(path), path
        self.clock = SimulatedClock()
        self.hub, self.cars = Hub(self.clock), dict[str, Fake]()
        """The network, and the cars by name."""
        for car in fleet.cars:
            link = self.hub.connect()
            made = self.cars[car.name] = prepare_fake(path, car.name, station=station)(
                link, seed=seed, clock=self.clock
            )
            self.clock.join(made)
            if fleet.profile.sees_frames and car.landmark is None:
                camera = Calibration.of(made.world.scenario.cameras[made.world.vehicle])
                reader = FrameReader(car.name, fleet.profile, camera, link)
                link.subscribe(fleet.profile.topic_of(car.name, Role.DETECTIONS), reader.publish)

    def station(self, environment: str | None = None, **options: Any) -> Svea:
        """Return a station of these cars as a backend; arguments and errors are those of `open_svea`."""
        return open_svea(self._path, environment, transport=self.hub.connect(), clock=self.clock, **options)
