"""A backend that is nothing but a Python generator of ticks: three cars with motion and sensors of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from coopenv.observers.sensed import Sensed, Truth
from coopenv.scenario import Scenario
from coopenv.sources.base import Capabilities, Command, TickGenerator, TickStream
from tests.helpers.builders import landmark, scenario, vehicle

CAMERA, DECISION = 30.0, 10.0
WHEELBASE, MAX_SPEED, MAX_STEERING = 0.3, 1.2, 0.5
STARTS = ((0.0, 0.0, 0.0), (-2.0, 0.5, 0.2), (-1.0, -2.0, 1.2))
"""(x m, y m, yaw rad)"""
TARGETS = ((4.0, 2.0, 1.0), (5.0, -2.0, 0.5), (-4.0, 3.0, 2.0), (0.0, 5.0, 1.5), (-3.0, -5.0, 0.8), (3.0, -5.0, 1.4))
SIGMA_SPEED, SIGMA_BEARING = 0.02, 0.002


def fleet_scenario(observer: str = "riccati", **sections: Any) -> Scenario:
    """Return who is there; how they move and sense is the generator's business."""
    believed = {"position_radius": 0.4, "orientation_angle": 0.2}
    goal = {"position": [2.5, 0.0, 0.0], "radius": 0.4}
    cars: list[dict[str, Any]] = [
        vehicle((x, y, 0.0), yaw, motion={"kind": "driven"}, initial_estimate=believed, body={"size": [0.5, 0.3, 0.2]})
        for x, y, yaw in STARTS
    ]
    cars[0]["goal"] = goal
    defaults: dict[str, Any] = {
        "horizon": 4.0,
        "landmarks": [landmark(f"L{n}", place) for n, place in enumerate(TARGETS)],
        "topology": {"mode": "sensed"},
        "rates": {"camera": CAMERA, "odometry": CAMERA, "decision": DECISION},
        "dynamics": {"wheelbase": WHEELBASE, "max_speed": MAX_SPEED, "max_steering": MAX_STEERING},
        "noise": {"velocity": SIGMA_SPEED, "bearing": {"model": "isotropic", "scale": SIGMA_BEARING}},
        "observer": {"name": observer},
        "termination": {"collision": False},
    }
    return scenario(cars, **{**defaults, **sections})


class Fleet(TickGenerator):
    """Cars whose ticks come late, are missing or empty now and then, the same ones in every episode."""

    def __init__(
        self, observer: str = "riccati", truth: bool = True, ticks: int | None = None, **sections: Any
    ) -> None:
        """Say whether poses are known, and after how many ticks the source ends."""
        made = fleet_scenario(observer, **sections)
        super().__init__(made, Capabilities(truth=truth, driven=True, real_time=False, ticks=ticks, batched=False))
        self.commands: list[Command] = []
        self.reasons: list[str] = []
        self._seed, self._number = 0, 0

    def missing(self, k: int) -> np.ndarray:
        return np.array([k > 0 and (7 * k + 3 * i) % 23 == 5 for i in range(3)])

    def late(self, k: int) -> np.ndarray:
        return np.array([(5 * k + i) % 19 == 3 for i in range(3)]) & ~self.missing(k)

    def empty(self, k: int) -> np.ndarray:
        return np.array([(k + 4 * i) % 17 == 8 for i in range(3)]) & ~self.missing(k)

    def stop(self, reason: str) -> None:
        self.reasons.append(reason)
        super().stop(reason)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        self._seed, self._number = (self._seed, self._number + 1) if seed is None else (seed, 0)
        rng = np.random.default_rng([self._seed, self._number])
        pose, speed = np.array(STARTS), np.zeros(3)
        command = yield self.tick(0, pose, pose, speed, rng)
        k = 0
        while self.capabilities.ticks is None or k + 1 < self.capabilities.ticks:
            k += 1
            self.commands.append(command)
            before, dt = pose.copy(), 1.0 / CAMERA
            speed = speed + np.clip(command.speed - speed, -command.acceleration * dt, command.acceleration * dt)
            turn = speed * np.tan(command.steering) / WHEELBASE * dt
            heading = pose[:, 2] + turn / 2
            pose = pose + np.stack([speed * dt * np.cos(heading), speed * dt * np.sin(heading), turn], axis=-1)
            command = yield self.tick(k, before, pose, speed, rng)

    def tick(self, k: int, before: np.ndarray, pose: np.ndarray, speed: np.ndarray, rng: np.random.Generator) -> Sensed:
        """Measure: bearings to everything in front, odometry of the way from one pose to the next."""
        (R0, p0), (R, p), dt = _poses(before), _poses(pose), 1.0 / CAMERA
        slip = rng.normal(0.0, SIGMA_SPEED, (3, 1)) * [1.0, 0.0, 0.0]
        step = (np.swapaxes(R0, 1, 2) @ (p - p0)[..., None])[..., 0]
        places = np.concatenate([TARGETS, p])
        rays = (places[None] - p[:, None]) @ R  # in the body
        bearings = rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-9)
        bearings = bearings + rng.normal(0.0, SIGMA_BEARING, bearings.shape)
        bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
        seen = (rays[..., 0] > -0.5) & (np.linalg.norm(rays, axis=-1) > 0.1) & ~self.empty(k)[:, None]
        gone = self.missing(k)
        return Sensed(
            index=k,
            dt=dt,
            rotation=np.where(gone[:, None, None], np.nan, np.swapaxes(R0, 1, 2) @ R),
            translation=np.where(gone[:, None], np.nan, step + slip * dt),
            velocity=speed[:, None] * [1.0, 0.0, 0.0] + slip,
            angular_velocity=(pose - before)[:, 2:] / dt * [0.0, 0.0, 1.0],
            bearings=np.where(seen[..., None], bearings, np.nan),
            visible=seen,
            landmarks=np.array(TARGETS),
            missing=gone,
            late=self.late(k),
            truth=Truth(R, p) if self.capabilities.truth else None,
        )


def _poses(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (3, 3, 3) and positions (3, 3) of rows (x, y, yaw)."""
    c, s, o, one = np.cos(pose[:, 2]), np.sin(pose[:, 2]), np.zeros(3), np.ones(3)
    R = np.array([[c, -s, o], [s, c, o], [o, o, one]]).transpose(2, 0, 1)
    return R, np.column_stack([pose[:, :2], o])
