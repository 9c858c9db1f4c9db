"""Fake cars and stations in lockstep: one process, one simulated clock, and a network within the process."""

from collections.abc import Callable
from functools import partial
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
    """A network within this process; messages are delivered in the sender's thread."""

    def __init__(self, clock: Clock = CLOCK) -> None:
        """Begin without connections; `clock` gives the times of reception."""
        self.clock, self.ends = clock, list[HubTransport]()

    def connect(self) -> "HubTransport":
        """Return a connection."""
        self.ends.append(end := HubTransport(self))
        return end

    @property
    def present(self) -> set[str]:
        """Announced names."""
        return {name for end in self.ends for name in end.names}

    def notify(self, before: set[str]) -> None:
        """Call the watchers of names that have come or gone."""
        for name in sorted(before ^ self.present):
            for end in [*self.ends]:
                for callback in [callback for matches, callback in end.watched if matches(name)]:
                    callback(name, name not in before)


class HubTransport:
    """A connection to a hub, see `Transport`."""

    def __init__(self, hub: Hub) -> None:
        """Connect."""
        self._hub, self.names = hub, list[str]()
        self.subscribed, self.watched = list[tuple[Matcher, Callback]](), list[tuple[Matcher, Change]]()

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Deliver a message."""
        arrival, ends = Arrival(topic, payload, self._hub.clock.wall(), attachment), [*self._hub.ends]
        for end in ends if self in ends else ():
            for callback in [callback for matches, callback in end.subscribed if matches(topic)]:
                callback(arrival)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe."""
        self.subscribed.append((matcher(pattern), callback))

    def announce(self, name: str) -> None:
        """Announce."""
        before = self._hub.present
        self.names.append(name)
        self._hub.notify(before)

    def watch(self, pattern: str, callback: Change) -> None:
        """Watch."""
        self.watched.append((matcher(pattern), callback))
        for name in sorted(filter(matcher(pattern), self._hub.present)):
            callback(name, True)

    def close(self) -> None:
        """Leave the hub."""
        before = self._hub.present
        self._hub.ends = [end for end in self._hub.ends if end is not self]
        self._hub.notify(before)


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
            made = prepare_fake(path, car.name, station=station)(link, seed=seed, clock=self.clock)
            self.cars[car.name] = made
            self.clock.join(partial(getattr, made, "next"), made.advance)
            if fleet.profile.sees_frames and car.landmark is None:
                camera = Calibration.of(made.world.scenario.cameras[made.world.vehicle])
                reader = FrameReader(car.name, fleet.profile, camera, link)
                link.subscribe(fleet.profile.topic_of(car.name, Role.DETECTIONS), reader.publish)

    def station(self, environment: str | None = None, **options: Any) -> Svea:
        """Return a station of these cars as a backend; arguments and errors are those of `open_svea`."""
        return open_svea(self._path, environment, transport=self.hub.connect(), clock=self.clock, **options)
