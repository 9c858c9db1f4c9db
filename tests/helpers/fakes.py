"""Fake cars on one simulated clock, in one process: what they say is kept."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from contextlib import closing
from typing import Any

import numpy as np

from coopenv.cars.backend.backend import Svea
from coopenv.cars.backend.binding import bind
from coopenv.cars.fake.car import Fake, fault_topic
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.link.clock import Clock
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import decode, encode, make
from coopenv.cars.settings.deployment import Car, Deployment, Sensors
from coopenv.cars.settings.profile import RESET_TOPIC, SVEA, CarProfile, Role
from coopenv.scenario import Scenario, load_scenario

MARKERS = {"SL1": 1, "SL2": 2, "SL4": 4, "SL5": 5}
OVERTAKING = (Car(name="svea7", marker=7), Car(name="svea8", marker=6))
CROSSING = (Car(name="svea7"), Car(name="svea3", marker=3, landmark="ML"))
EXACT = {"noise.enabled": False}
CAMERA, MARKER = np.array([0.3218, 0.0, 0.2233]), np.array([0.16, 0.0, 0.25])
"""Of a car, in the body frame, m."""
STEP = 1_000_000
"""ns by which the clock goes on."""


def turned(yaw: float) -> np.ndarray:
    """Return the rotation about the vertical axis."""
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


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
        self.hub = Hub(Clock(lambda: self.wall + self.now, lambda: self.now))
        self._said = defaultdict[str, list[Arrival]](list)
        self.network = self.hub.connect()
        self.network.subscribe("**", lambda arrival: self._said[arrival.topic].append(arrival))
        self.binding = binding = bind(self.scenario, cars, MARKERS, "test", None, profile)
        self.cars = {
            car.name: Fake(binding, car.name, self.hub.connect(), differential=wheel, **options) for car in cars
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

    def pose(self, car: str) -> tuple[np.ndarray, np.ndarray]:
        """Return rotation and position of a car."""
        world = self.cars[car].world
        return world.pose(world.agent)

    def put(self, car: str, x: float, y: float, yaw: float) -> None:
        """Put a car somewhere."""
        world = self.cars[car].world
        world.put(world.agent, turned(yaw), np.array([x, y, 0.0]))

    def ask(self, fault: str, car: str = "svea7") -> None:
        """Give a car a fault."""
        self.network.publish(fault_topic(car), encode(make("std_msgs/msg/String", data=fault)))
        self.run(0.001)

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

    def roles_read(self, arrivals: Iterable[Arrival]) -> set[Role]:
        """Return the roles of what a station reads of messages, of which it rejects none."""
        with closing(Svea(self.fleet, self.binding, Hub().connect())) as backend:
            found = {sample.role for arrival in arrivals for sample in backend.intake.samples(arrival)}
            assert not any(backend.intake.rejected.values())
        return found

    def forget(self) -> None:
        """Forget what has been said."""
        self._said.clear()
