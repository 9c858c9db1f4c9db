"""Sensors of fake cars: the truth with the scenario's noise and lasting errors, as messages of real cars."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from coopenv.cars.codec import encode, header, make, ros2
from coopenv.cars.fake.faults import FakeSettings
from coopenv.cars.fake.world import CarWorld
from coopenv.cars.profile import CarProfile, Role
from coopenv.cars.transport.base import Transport
from coopenv.scenario.sensing import Noise
from coopenv.world.random import ODOMETRY_NOISE

TRUTH_RATE, FILTER_RATE = 100.0, 20.0
LEADER_RATE, CONDITION_RATE = 60.0, 5.0
"""Hz: motion capture, own filter; poses of a moving landmark, conditions of a car."""


GRAVITY = 9.81  # m/s^2
FULL = 0.9  # share of the battery that is left
STANDING = {"connected": True, "armed": True, "manual_input": True, "mode": "MANUAL", "system_status": 4}
BATTERY = {
    **{"voltage": 10.5 + 2.1 * FULL, "temperature": 25.0, "current": -1.0, "percentage": FULL},
    **{"charge": 5.0 * FULL, "capacity": 5.0, "design_capacity": 5.0},
    **{"power_supply_status": 2, "power_supply_health": 1, "power_supply_technology": 3, "present": True},
}

Act = Callable[[int, int], None]
"""Called with when it was due, steady clock, and the stamp by the car's clock; ns."""


class SensorPublisher:
    """Publishes messages of a car on a network."""

    def __init__(self, name: str, profile: CarProfile, network: Transport) -> None:
        """Take the car's name, its make, and the network."""
        self.name, self._profile, self._network = name, profile, network

    def send(self, role: Role, stamp: int, frame: str, /, **fields: Any) -> None:
        """Publish a message by its fields, which are those of SVEA's type; a stamp in ns.

        Types without covariances, or without a twist, get what they have room for.
        """
        topic = self._profile.topics[role]
        known = {name: node[1] for name, node in ros2().fielddefs[topic.type][1]}
        for name in fields.keys() & {"pose", "twist"}:
            if name in known and "WithCovariance" not in str(known[name]):
                fields[name] = fields[name][name]
        held = {name: value for name, value in fields.items() if name in known}
        payload = encode(make(topic.type, header=header(stamp, frame), **held))
        name = self._profile.topic_of(self.name, role)
        self._network.publish(name, payload, urgent=topic.urgent, reliable=topic.reliable)


class CarSensors:
    """Odometry and condition of one car. Lasting errors are those that the world has drawn."""

    def __init__(
        self, world: CarWorld, publisher: SensorPublisher, settings: FakeSettings, *, differential: bool
    ) -> None:
        """Put them on the car of a world; `differential`: the wheels measure a turn rate, else 0."""
        self._world, self._publisher, self._differential = world, publisher, differential
        self._settings = settings
        noise = world.scenario.noises[world.vehicle]
        self._wheel_std = deviation(noise.velocity, noise, settings.wheel_rate)  # m/s, of a sample
        self._wheel_turn_std = deviation(noise.angular_velocity, noise, settings.wheel_rate)
        self._gyro_std = deviation(noise.angular_velocity, noise, settings.imu_rate)  # rad/s, a sample of each axis
        self.acts: list[tuple[float, Act]] = [
            (settings.wheel_rate, self._wheel),
            (settings.imu_rate, self._imu),
            (FILTER_RATE, self._odometry),
            (CONDITION_RATE, self._condition),
        ]
        """Rates in Hz, and what is published."""

    def begin(self, rng: np.random.Generator) -> None:
        """Begin an episode: the filter starts at its own origin, noise comes from `rng`."""
        self._rng = rng
        self._pose = np.zeros(3)  # of the filter, x and y in m and the heading in rad, from where the car began
        self._speed, self._turn_rate = 0.0, 0.0  # last samples
        self._since = 0
        self._factor = float(self._world.view("parameter")[0, int(ODOMETRY_NOISE)])

    def _wheel(self, due: int, stamp: int) -> None:
        velocity, turn = self._world.twist
        slip = self._world.view("slip")[0, self._world.vehicle]
        drawn, fixed = self._world.view("odometry_scale")[0, self._world.vehicle], self._settings.wheel_scale
        scale = (1.0 + (drawn if fixed is None else fixed)) * (1.0 + slip[0])
        self._dead_reckon(due)
        noise = self._rng.normal(size=2) * self._factor * (self._wheel_std, self._wheel_turn_std)
        self._speed = float(velocity[0] * scale * math.cos(slip[1]) + noise[0])
        turned = float(turn[2] * scale + noise[1]) if self._differential else 0.0
        covariance = np.diag([self._wheel_std**2, 0.0, 0.0, 0.0, 0.0, self._wheel_turn_std**2])
        twist = {"twist": ((self._speed, 0.0, 0.0), (0.0, 0.0, turned)), "covariance": covariance}
        self._publisher.send(Role.WHEEL, stamp, f"{self._publisher.name}/base_link", twist=twist)

    def _imu(self, due: int, stamp: int) -> None:
        """Publish turn rates, and the weight of a car on a plane; the IMU knows no orientation."""
        bias = self._world.view("gyro_bias")[0, self._world.vehicle].copy()
        if self._settings.gyro_bias is not None:
            bias[2] = self._settings.gyro_bias
        turn = self._world.twist[1] + bias + self._rng.normal(size=3) * self._factor * self._gyro_std
        self._dead_reckon(due)
        self._turn_rate = float(turn[2])
        fields = {"angular_velocity": turn, "linear_acceleration": (0.0, 0.0, GRAVITY)}
        fields["angular_velocity_covariance"] = self._gyro_std**2 * np.eye(3)
        unknown = {"orientation": (0.0, 0.0, 0.0, 1.0), "orientation_covariance": [-1.0, *np.zeros(8)]}
        self._publisher.send(Role.IMU, stamp, f"{self._publisher.name}/imu", **fields, **unknown)

    def _odometry(self, due: int, stamp: int) -> None:
        self._dead_reckon(due)
        x, y, heading = self._pose.tolist()
        turned = (0.0, 0.0, math.sin(heading / 2.0), math.cos(heading / 2.0))
        fields = {
            "pose": {"pose": ((x, y, 0.0), turned)},
            "twist": {"twist": ((self._speed, 0.0, 0.0), (0.0, 0.0, self._turn_rate))},
        }
        name = self._publisher.name
        self._publisher.send(Role.ODOMETRY, stamp, f"{name}/odom", child_frame_id=f"{name}/base_link", **fields)

    def _dead_reckon(self, now: int) -> None:
        """Move the filter's pose to a time by the last samples, held and summed."""
        dt = (now - self._since) * 1e-9 if self._since else 0.0
        self._since = now
        middle = self._pose[2] + 0.5 * dt * self._turn_rate
        way = dt * self._speed
        self._pose += (way * math.cos(middle), way * math.sin(middle), dt * self._turn_rate)

    def _condition(self, _due: int, stamp: int) -> None:
        self._publisher.send(Role.STATE, stamp, "", **STANDING)
        self._publisher.send(Role.REMOTE, stamp, "", rssi=200, channels=[1500] * 8)
        self._publisher.send(Role.BATTERY, stamp, "", **BATTERY)


def deviation(stated: float, noise: Noise, rate: float) -> float:
    """Return the standard deviation of a sample at a rate, Hz, whose density is that of what a scenario states."""
    if not noise.enabled:
        return 0.0
    return stated if isinstance(noise.odometry_rate, str) else stated * math.sqrt(rate / noise.odometry_rate)
