"""The Pixy2 of a fake car: blocks in whole pixels, and the bearings that the authors compute of them."""

from dataclasses import dataclass, replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.fake.faults import Faults
from coopenv.fake.world import Room
from coopenv.scenario.sensing import Camera
from coopenv.svea.deployment import MARKERS
from coopenv.svea.lens import distort
from coopenv.svea.samples import Calibration

MARKER = 0.08  # m, side of a marker
OLDEST = 255  # frames that the camera counts


@dataclass(frozen=True)
class Block:
    """What the camera says of one marker, pixels."""

    signature: int
    x: int
    y: int
    width: int
    height: int
    index: int = 0  # of the tracked block
    age: int = 1  # frames in a row


class Pixy:
    """The camera of one car."""

    def __init__(self, room: Room, calibration: Calibration, markers: dict[int, int], faults: Faults) -> None:
        """Put it on the car.

        Args:
            room: what it looks at.
            calibration: of its lens.
            markers: numbers of markers by the agent that carries them.
            faults: that it may have.
        """
        self._room, self._markers, self._faults = room, markers, faults
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
        seen = {agent: ray for agent, ray in self._room.look(self._frames).items() if agent in self._markers}
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
            number, near = self._markers[agent], MARKER / max(self._room.distance(agent), MARKER)
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
            for _ in range(rng.poisson(rate / self._room.scenario.rates.camera)):
                x, y = int(rng.integers(width)), int(rng.integers(height))
                blocks = [*blocks, Block(int(rng.choice(MARKERS)), x, y, 2, 2)]
        return blocks


def calibration_of(camera: Camera) -> Calibration:
    """Return the intrinsics of a camera of the scenario."""
    return Calibration(camera.image_size, camera.focal_length, camera.principal_point, camera.distortion)


def bearings_of(blocks: list[Block], calibration: Calibration) -> Array:
    """Return (m, 3) unit vectors as the authors compute them: from the target to the camera, distortion not removed."""
    pixels = np.array([(block.x, block.y) for block in blocks], dtype=np.float64).reshape(-1, 2)
    flat = (np.array(calibration.principal_point) - pixels) / calibration.focal_length
    b = np.concatenate([flat, -np.ones((len(blocks), 1))], axis=-1)
    unit: Array = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return unit
