"""Fake cars and stations in lockstep: one process, one simulated clock, and a network within the process."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Unpack

from coopenv.cars.backend.backend import Svea, open_svea
from coopenv.cars.fake.car import Fake
from coopenv.cars.fake.fleet import fleet_of_fakes, prepare_fake
from coopenv.cars.link.clock import CLOCK, Clock, SimulatedClock
from coopenv.cars.link.transport import Arrival, Callback, HeartbeatTransport, matcher
from coopenv.cars.messages.see import FrameReader
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role, Way


class Hub:
    """A network within this process; messages are delivered in the sender's thread."""

    def __init__(self, clock: Clock = CLOCK) -> None:
        """Begin without connections; `clock` is that of all ends."""
        self.clock, self.ends = clock, list[HubTransport]()

    def connect(self) -> "HubTransport":
        """Return a connection."""
        self.ends = [*self.ends, end := HubTransport(self)]
        return end


class HubTransport(HeartbeatTransport):
    """A connection to a hub, see `Transport`."""

    def __init__(self, hub: Hub) -> None:
        """Connect."""
        super().__init__()
        self._hub, self.clock = hub, hub.clock
        self._subscribed = list[tuple[Callable[[str], bool], Callback]]()

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Deliver a message."""
        arrival = Arrival(topic, payload, self.clock.wall(), attachment)
        for end in () if self._closed.is_set() else self._hub.ends:
            for callback in [callback for matches, callback in end._subscribed if matches(topic)]:
                callback(arrival)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe."""
        self._subscribed.append((matcher(pattern), callback))

    def _send_heartbeat(self, name: str, payload: bytes) -> None:
        for end in self._hub.ends:
            end.heartbeat(name, payload)

    def _receive_heartbeats(self) -> None:
        for end in self._hub.ends:
            for name in end._own:
                self.heartbeat(name, b"+" + end._self)

    def _end(self) -> None:
        self._closed.set()
        self._hub.ends = [end for end in self._hub.ends if end is not self]


class LockstepFakes:
    """The fake cars of a deployment, with their gates, on a simulated clock that their station moves on."""

    def __init__(self, path: str | Path, seed: int = 0) -> None:
        """Build the cars.

        Args:
            path: deployment file; its network does not count here.
            seed: see `coopenv.cars.fake.car.Fake`.

        Raises:
            CoopenvError: the file or its environment is not valid, or its cars are not fakes.
        """
        fleet, self._path = fleet_of_fakes(path), path
        self.clock = SimulatedClock()
        self.hub, self.cars = Hub(self.clock), dict[str, Fake]()
        """The network, and the cars by name."""
        for car in fleet.cars:
            link = self.hub.connect()
            made = self.cars[car.name] = prepare_fake(path, car.name)(link, seed=seed)
            self.clock.join(partial(getattr, made, "next"), made.advance)
            if fleet.profile.sees_frames and car.landmark is None:
                camera = Calibration.of(made.world.scenario.cameras[made.world.vehicle])
                reader = FrameReader(car.name, fleet.profile, camera, link)
                link.subscribe(fleet.profile.topic_of(car.name, Role.DETECTIONS), reader.publish)

    def station(self, environment: str | None = None, **options: Any) -> Svea:
        """Return a station of these cars as a backend; arguments and errors are those of `open_svea`."""
        return open_svea(self._path, environment, transport=self.hub.connect(), **options)
