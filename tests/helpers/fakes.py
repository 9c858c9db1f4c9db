"""Fake cars on one simulated clock, in one process: what they say is kept."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from coopenv.cars.backend.binding import bind
from coopenv.cars.codec import decode, encode, make
from coopenv.cars.deployment import Car, Deployment, Sensors
from coopenv.cars.fake.car import Fake
from coopenv.cars.gate.core import GateClock, write_drive
from coopenv.cars.profile import RESET_TOPIC, SVEA, CarProfile, MotionCommand, Role
from coopenv.cars.transport.base import Arrival
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.hub import Hub

MARKERS = {"SL1": 1, "SL2": 2, "SL4": 4, "SL5": 5}
OVERTAKING = (Car(name="svea7", marker=7), Car(name="svea8", marker=6))
CROSSING = (Car(name="svea7"), Car(name="svea3", marker=3, landmark="ML"))
EXACT = {"noise.enabled": False}
STEP = 1_000_000
"""ns by which the clock goes on."""


class Stage:
    """Fakes of an environment, commanded over the network."""

    def __init__(
        self,
        environment: str,
        cars: tuple[Car, ...],
        overrides: dict[str, Any] | None = None,
        sensors: Sensors | None = None,
        profile: CarProfile = SVEA,
        **options: Any,
    ) -> None:
        self.now, self.wall = 10**12, 1_700_000_000 * 10**9
        self.scenario: Scenario = load_scenario(environment, overrides or {})
        sensors = sensors or Sensors()
        wheel = sensors.odometry == "wheel"
        self.fleet = Deployment(
            environment=environment, cars=cars, markers=MARKERS, fakes=True, sensors=sensors, profile=profile
        )
        self.hub, self._said = Hub(), defaultdict[str, list[Arrival]](list)
        self.network = self.hub.connect()
        self.network.subscribe("**", lambda arrival: self._said[arrival.topic].append(arrival))
        binding = bind(self.scenario, cars, MARKERS, "test", None, profile)
        clock = GateClock(lambda: self.wall + self.now, lambda: self.now)
        self.cars = {
            car.name: Fake(binding, car.name, self.hub.connect(), differential=wheel, clock=clock, **options)
            for car in cars
        }

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds * 1e9 / STEP)):
            self.now += STEP
            for car in self.cars.values():
                car.advance()

    def command(self, car: str, speed: float, steering: float = 0.0) -> None:
        """Send what a gate would."""
        payload = write_drive(self.wall + self.now, self.fleet.profile.command, MotionCommand(steering, speed))
        self.network.publish(self.fleet.profile.topic_of(car, Role.MANUAL), payload)

    def drive(self, car: str, speed: float, steering: float, seconds: float) -> None:
        """Send a command 20 times a second."""
        for _ in range(round(20 * seconds)):
            self.command(car, speed, steering)
            self.run(0.05)

    def reset(self, seed: int) -> None:
        """Put all fakes at the start of a seed."""
        self.network.publish(RESET_TOPIC, encode(make("std_msgs/msg/Int64", data=seed)))

    def arrivals(self, car: str, role: Role) -> list[Any]:
        """Return the messages under a topic since `forget`, decoded."""
        return [
            decode(arrival.payload, self.fleet.profile.topics[role].type)
            for arrival in self._said[self.fleet.profile.topic_of(car, role)]
        ]

    @property
    def hub_arrivals(self) -> list[Arrival]:
        """All messages since `forget`."""
        return [arrival for arrivals in self._said.values() for arrival in arrivals]

    def forget(self) -> None:
        """Forget what has been said."""
        self._said.clear()
