"""Readings of wheels, gyro and the car's own filter: the truth with the scenario's noise and lasting errors."""

import math
from dataclasses import dataclass, replace

import numpy as np

from coopenv.cars.fake.faults import Faults
from coopenv.cars.fake.world import CarWorld
from coopenv.cars.samples import Calibration
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import Array
from coopenv.scenario.sensing import Noise
from coopenv.world.random import ODOMETRY_NOISE

WHEEL_RATE, IMU_RATE, FILTER_RATE = 50.0, 100.0, 20.0
"""Hz"""


class CarSensors:
    """The odometry of one car. Lasting errors are those that the world has drawn."""

    def __init__(self, world: CarWorld, *, differential: bool = True) -> None:
        """Put them on the car of a world; `differential`: the wheels measure a turn rate, else 0."""
        self._differential = differential
        self._world, self._noise = world, world.scenario.noises[world.vehicle]
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
        self._factor = float(self._world.view("parameter")[0, int(ODOMETRY_NOISE)])

    def wheel(self, now: int, rng: np.random.Generator) -> tuple[float, float]:
        """Return the speed, m/s, and the turn rate, rad/s, by the wheels at a time in ns."""
        velocity, turn = self._world.twist
        slip = self._world.view("slip")[0, self._world.vehicle]
        scale = (1.0 + self._world.view("odometry_scale")[0, self._world.vehicle]) * (1.0 + slip[0])
        self._dead_reckon(now)
        self.speed = float(velocity[0] * scale * math.cos(slip[1]) + rng.normal() * self._factor * self.wheel_std)
        turned = float(turn[2] * scale + rng.normal() * self._factor * self.wheel_turn_std)
        return self.speed, turned if self._differential else 0.0

    def gyro(self, now: int, rng: np.random.Generator) -> Array:
        """Return the turn rates about the body's axes, (3,) rad/s."""
        _, turn = self._world.twist
        bias = self._world.view("gyro_bias")[0, self._world.vehicle]
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


MARKER = 0.08  # m, side of a marker
OLDEST = 255  # frames that the camera counts


@dataclass(frozen=True)
class Block:
    """Block of one marker in the camera's image, pixels."""

    signature: int
    x: int
    y: int
    width: int
    height: int
    index: int = 0  # of the tracked block
    age: int = 1  # frames in a row


class Pixy:
    """The camera of one car."""

    def __init__(
        self,
        world: CarWorld,
        calibration: Calibration,
        markers: dict[int, int],
        faults: Faults,
        numbers: tuple[int, int],
    ) -> None:
        """Put it on the car.

        Args:
            world: what it looks at.
            calibration: of its lens.
            markers: numbers of markers by the agent that carries them.
            faults: that it may have.
            numbers: smallest and largest marker that it identifies.
        """
        self._world, self._markers, self._faults = world, markers, faults
        self._numbers = range(numbers[0], numbers[1] + 1)
        self.calibration = calibration
        """Of its lens."""
        self._ages: dict[int, int] = {}
        self._frames = 0

    def begin(self) -> None:
        """Begin an episode: frames count from here."""
        self._ages, self._frames = {}, 0

    def frame(self, now: int, rng: np.random.Generator) -> list[Block]:
        """Take a frame at a time in ns, the largest block first."""
        self._frames += 1
        seen = {agent: ray for agent, ray in self._world.look(self._frames).items() if agent in self._markers}
        self._ages = {agent: min(self._ages.get(agent, 0) + 1, OLDEST) for agent in seen}
        blocks = self._blocks(seen) if seen else []
        blocks.sort(key=lambda block: -block.width * block.height)
        return self._with_faults(blocks, now, rng)

    def _blocks(self, seen: dict[int, Array]) -> list[Block]:
        c, rays = self.calibration, np.array([*seen.values()])
        flat = distort(rays[:, :2] / rays[:, 2:], c.distortion)
        pixels = np.rint(flat * c.focal_length + c.principal_point).clip(0, np.array(c.image_size) - 1)
        blocks = []
        for agent, (x, y) in zip(seen, pixels.astype(int).tolist(), strict=True):
            number, near = self._markers[agent], MARKER / max(self._world.distance(agent), MARKER)
            width, height = (max(1, round(f * near)) for f in c.focal_length)
            blocks.append(Block(number, x, y, width, height, index=number - 1, age=self._ages[agent]))
        return blocks

    def _with_faults(self, blocks: list[Block], now: int, rng: np.random.Generator) -> list[Block]:
        faults, (width, height) = self._faults, self.calibration.image_size
        if faults.value("swapped_signatures", now):
            numbers = [block.signature for block in blocks]
            blocks = [replace(b, signature=n) for b, n in zip(blocks, reversed(numbers), strict=True)]
        if share := faults.value("duplicate_blocks", now):
            doubled = [block for block in blocks if rng.random() < share]
            blocks = blocks + [
                replace(b, x=min(b.x + 3, width - 1), width=max(1, b.width // 2), height=max(1, b.height // 2), age=1)
                for b in doubled
            ]
        if rate := faults.value("false_blocks", now):
            for _ in range(rng.poisson(rate / self._world.scenario.rates.camera)):
                x, y = int(rng.integers(width)), int(rng.integers(height))
                blocks = [*blocks, Block(int(rng.choice(self._numbers)), x, y, 2, 2)]
        return blocks


def bearings_of(blocks: list[Block], calibration: Calibration) -> Array:
    """Return (m, 3) unit vectors as the authors compute them: from the target to the camera, distortion not removed."""
    pixels = np.array([(block.x, block.y) for block in blocks], dtype=np.float64).reshape(-1, 2)
    flat = (np.array(calibration.principal_point) - pixels) / calibration.focal_length
    b = np.concatenate([flat, -np.ones((len(blocks), 1))], axis=-1)
    unit: Array = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return unit
