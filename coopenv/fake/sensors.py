"""What wheels, gyro and the car's own filter read: the truth with the scenario's noise and lasting errors."""

import math

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.fake.world import Room
from coopenv.scenario.sensing import Noise
from coopenv.world.parameters import ODOMETRY_NOISE

WHEEL_RATE, IMU_RATE, FILTER_RATE = 50.0, 100.0, 20.0
"""Hz"""


class Sensors:
    """The odometry of one car. Lasting errors are those that the room has drawn."""

    def __init__(self, room: Room, *, differential: bool = True) -> None:
        """Put them on the car of a room; `differential`: the wheels tell a turn rate, else 0."""
        self._differential = differential
        self._room, self._noise = room, room.scenario.noises[room.vehicle]
        self.wheel_std = deviation(self._noise.velocity, self._noise, WHEEL_RATE)
        """m/s, of a sample."""
        self.wheel_turn_std = deviation(self._noise.angular_velocity, self._noise, WHEEL_RATE)
        self.gyro_std = deviation(self._noise.angular_velocity, self._noise, IMU_RATE)
        """rad/s, of a sample of each axis."""
        self.begin()

    def begin(self) -> None:
        """Begin an episode: the filter starts at its own origin."""
        self.pose = np.zeros(3)
        """Of the filter, x and y in m and the heading in rad, from where the car began."""
        self.speed, self.turn_rate = 0.0, 0.0  # last samples
        self._since = 0
        self._factor = float(self._room.view("parameter")[0, int(ODOMETRY_NOISE)])

    def wheel(self, now: int, rng: np.random.Generator) -> tuple[float, float]:
        """Return the speed, m/s, and the turn rate, rad/s, by the wheels at a time in ns."""
        velocity, turn = self._room.twist
        slip = self._room.view("slip")[0, self._room.vehicle]
        scale = (1.0 + self._room.view("odometry_scale")[0, self._room.vehicle]) * (1.0 + slip[0])
        self._dead_reckon(now)
        self.speed = float(velocity[0] * scale * math.cos(slip[1]) + rng.normal() * self._factor * self.wheel_std)
        turned = float(turn[2] * scale + rng.normal() * self._factor * self.wheel_turn_std)
        return self.speed, turned if self._differential else 0.0

    def gyro(self, now: int, rng: np.random.Generator) -> Array:
        """Return the turn rates about the body's axes, (3,) rad/s."""
        _, turn = self._room.twist
        bias = self._room.view("gyro_bias")[0, self._room.vehicle]
        read: Array = turn + bias + rng.normal(size=3) * self._factor * self.gyro_std
        self._dead_reckon(now)
        self.turn_rate = float(read[2])
        return read

    def filtered(self, now: int) -> tuple[Array, float, float]:
        """Return pose, speed and turn rate as the car's own filter has them: the last samples, held and summed."""
        self._dead_reckon(now)
        return self.pose.copy(), self.speed, self.turn_rate

    def _dead_reckon(self, now: int) -> None:
        dt = (now - self._since) * 1e-9 if self._since else 0.0
        self._since = now
        middle = self.pose[2] + 0.5 * dt * self.turn_rate
        way = dt * self.speed
        self.pose += (way * math.cos(middle), way * math.sin(middle), dt * self.turn_rate)


def deviation(stated: float, noise: Noise, rate: float) -> float:
    """Return the standard deviation of a sample at a rate, Hz, whose density is that of what a scenario states."""
    if not noise.enabled:
        return 0.0
    return stated if isinstance(noise.odometry_rate, str) else stated * math.sqrt(rate / noise.odometry_rate)
