"""Every stream of a car once, as arrays on one clock: of a bag, or of a window of live messages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.backend.binding import Binding, marker_places
from coopenv.cars.bags.clocks import CAMERAS
from coopenv.cars.messages.readings import CarPose, Sample, Twist, sightings_of, tracks_of, yaw_of
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction
from coopenv.estimation.poses import Array

TURNING = (Role.IMU, Role.ODOMETRY, Role.WHEEL)
"""Roles of turn rates, the first of which counts."""
MOVING = (Role.WHEEL, Role.ODOMETRY)
"""Roles of velocities, the first of which counts."""


@dataclass(frozen=True)
class CarStreams:
    """The streams of one car; times in s since a common start, planar vectors as complex numbers x + iy."""

    name: str
    vehicle: int
    topics: Mapping[Role, str]
    samples: Sequence[Sample]
    tracks: Mapping[str, Any]
    """As of `tracks_of`."""
    turning: Array
    """(n, 3) turn rates about the axes of the body at `gyro_time`, rad/s."""
    pose_time: Array
    pose: NDArray[np.complex128]
    """Poses of the messages that hold the twists, in a frame of their own; none in most bags."""
    pose_yaw: Array
    time: Array
    """(m,) of sightings of standing landmarks."""
    target: NDArray[np.int64]
    ray: Array
    """(m, 3) unit vectors in the optical frame."""
    lens: Calibration | None

    def topic(self, roles: Sequence[Role]) -> str:
        """Return the topic of the first of some roles that the car has."""
        return next((self.topics[role] for role in roles if role in self.topics), roles[0].value)


@dataclass(frozen=True)
class Streams:
    """Samples of cars on one clock: of a whole bag, or the last ones of live cars."""

    samples: Sequence[Sample]
    binding: Binding
    topics: Mapping[tuple[str, Role], str]
    lenses: Mapping[str, Calibration] = field(default_factory=dict)
    corrections: Mapping[str, Correction] = field(default_factory=dict)
    added: Mapping[tuple[str, Role], tuple[str, float]] = field(default_factory=dict)
    """By car and role: the topic, and s that were added to its stamps."""

    @property
    def standing(self) -> list[int]:
        """Indices of the landmarks that stand."""
        led = self.binding.leaders.values()
        marks = self.binding.scenario.landmarks
        return [i for i, mark in enumerate(marks) if mark.motion.kind == "static" and i not in led]

    @property
    def places(self) -> Array:
        """Positions (L, 3) of the standing landmarks' markers, m."""
        return marker_places(self.binding.scenario.landmarks)[self.standing]

    def car(self, name: str) -> CarStreams:
        """Return the streams of a car."""
        own = [sample for sample in self.samples if sample.car == name]
        start, standing = self.samples[0].stamp if self.samples else 0, self.standing
        number = {m: standing.index(target) for m, target in self.binding.targets.items() if target in standing}
        time, target, ray = sightings_of([s for s in own if s.role in CAMERAS], start, number)
        twists = [s for s in own if isinstance(s.value, Twist)]
        turning = [s.value.angular for s in twists if s.value.angular is not None]  # type: ignore[union-attr]
        poses = [(s.stamp, p) for s in twists if isinstance(p := s.value.pose, CarPose) and p.rotation is not None]  # type: ignore[union-attr]
        return CarStreams(
            name=name,
            vehicle=self.binding.cars[name],
            topics={role: topic for (car, role), topic in self.topics.items() if car == name},
            samples=own,
            tracks=tracks_of(own, start),
            turning=np.array(turning, dtype=np.float64).reshape(-1, 3),
            pose_time=np.array([1e-9 * (stamp - start) for stamp, _ in poses]),
            pose=np.array([complex(*pose.position[:2]) for _, pose in poses]),
            pose_yaw=np.unwrap([yaw_of(pose.rotation) for _, pose in poses if pose.rotation is not None]),
            time=time,
            target=target,
            ray=ray,
            lens=self.lenses.get(name),
        )
