"""Worlds whose truth somebody else moves: poses come from a program on the host, sensing and radio are the world's."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from coopenv.backends.moved_kernels import MOVED, moved_struct
from coopenv.backends.simulated import SimulatedWorld
from coopenv.base.errors import CoopenvError
from coopenv.estimation.arrays import Array
from coopenv.world.launch import PerWorld
from coopenv.world.records import allocate, fields


@dataclass(frozen=True)
class Poses:
    """Where N vehicles and Z other bodies are on the plane, map frame; of an absent body nothing but `half` counts."""

    xy: Array  # (N, 2) m
    heading: Array  # (N,) rad, from x towards y
    speed: Array  # (N,) m/s
    steering: Array  # (N,) rad, positive to the left
    crashed: Array  # (N,) bool, who has touched something
    left: Array  # (N,) bool, who has left the road for good
    traffic_position: Array  # (Z, 3) centres of boxes, m
    traffic_heading: Array  # (Z,) rad
    traffic_half: Array  # (Z, 3) half of their edges, m; zero: absent


class MovedWorld(SimulatedWorld):
    """Worlds on the CPU whose vehicles stand where `place` and `move` put them; all else is as in the simulation."""

    source = MOVED

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Build the arrays; arguments and errors as for `World`, and CoopenvError: not on the CPU."""
        super().__init__(*arguments, **options)
        if self.device != "cpu":
            raise CoopenvError(f"device '{self.device}': these worlds are moved on the host, use device='cpu'")

    def _build_record(self) -> Any:
        struct, model = moved_struct(self.precision), self.model
        record = allocate(struct, {"W": self.worlds, "N": model.vehicles, "Z": model.traffic}, self.device)
        self._moved = {name: getattr(record, name).numpy() for name in fields(struct)}
        self._xy, self._heading = np.zeros((self.worlds, model.vehicles, 2)), np.zeros((self.worlds, model.vehicles))
        return PerWorld(record)

    def place(self, world: int, poses: Poses) -> None:
        """Put the vehicles of one world where an episode begins, before it is reset."""
        self._put(world, poses, np.zeros_like(poses.xy), np.zeros_like(poses.heading))

    def move(self, world: int, poses: Poses) -> None:
        """Put the vehicles of one world where they are at the next tick, before it is advanced.

        The odometry measures the twist that leads there from the last pose when it is held over the tick.
        """
        turned = (poses.heading - self._heading[world] + np.pi) % (2.0 * np.pi) - np.pi
        c, s = np.cos(self._heading[world]), np.sin(self._heading[world])
        dx, dy = (poses.xy - self._xy[world]).T
        forward, left = c * dx + s * dy, c * dy - s * dx
        # rho of Log in SE(2): V(turned)^-1 times the way in the body frame
        half = turned / 2.0
        a = np.where(np.abs(half) < 1e-6, 1.0, half / np.tan(np.where(half == 0.0, 1.0, half)))
        way = np.stack([a * forward + half * left, a * left - half * forward], axis=-1)
        rate = self.scenario.rates.camera
        self._put(world, poses, way * rate, turned * rate)

    def _put(self, world: int, poses: Poses, velocity: Array, yaw_rate: Array) -> None:
        row = {name: values[world] for name, values in self._moved.items()}
        self.remember(world, poses)
        row["rotation"][...] = _about_z(poses.heading)
        row["position"][..., :2] = poses.xy
        row["velocity"][..., :2], row["angular_velocity"][..., 2] = velocity, yaw_rate
        row["traffic_rotation"][...] = _about_z(poses.traffic_heading)
        for name in ("speed", "steering", "crashed", "left", "traffic_position", "traffic_half"):
            row[name][...] = getattr(poses, name)

    def remember(self, world: int, poses: Poses) -> None:
        """Take poses for the last ones, of a world that is about to be restored."""
        self._xy[world], self._heading[world] = poses.xy, poses.heading

    def advance(self, ticks: int) -> None:
        """Run camera ticks, see `World.advance`; `fetch` moves the vehicles to each."""
        self.decide()
        for _ in range(ticks):
            self.fetch()
            super().advance(1)


def _about_z(heading: Array) -> Array:
    """Return the rotations (n, 3, 3) by headings (n,) rad."""
    R = np.zeros((len(heading), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(heading)
    R[:, 1, 0] = np.sin(heading)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R
