"""Every stream of a car once, as arrays on one clock: of a bag, or of a window of live messages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.backend.binding import Binding, marker_places
from coopenv.cars.bags.clocks import CAMERAS, SampledSignal
from coopenv.cars.messages.readings import CarPose, Sample, Twist, sightings_of, tracks_of, yaw_of
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction
from coopenv.estimation.poses import Array

TURNING = (Role.IMU, Role.ODOMETRY, Role.WHEEL)
"""Roles of turn rates, the first of which counts."""
MOVING = (Role.WHEEL, Role.ODOMETRY)
"""Roles of velocities, the first of which counts."""
Planar = NDArray[np.complex128]
SMOOTH = 0.2  # s over which motion capture is differentiated


@dataclass(frozen=True, kw_only=True)
class CarSight:
    """Sights of standing landmarks by the camera of one car; times in s since a common start."""

    name: str
    vehicle: int
    time: Array  # (m,)
    target: NDArray[np.int64]  # (m,) landmark
    ray: Array  # (m, 3) unit vectors, optical frame
    lens: Calibration | None  # None: bearings without pixels
    mounting: Array  # (3, 3) from the camera to the body
    lever: Array  # (3,) of the camera in the body, m
    height: float  # of the body's origin, m


@dataclass(frozen=True, kw_only=True)
class CarStreams(CarSight):
    """All streams of one car; planar vectors are complex numbers x + iy."""

    topics: Mapping[Role, str]
    samples: Sequence[Sample]
    tracks: Mapping[str, Any]
    """As of `tracks_of`."""
    turning: Array
    """(n, 3) turn rates about the axes of the body at `gyro_time`, rad/s."""
    pose_time: Array
    pose: Planar
    """Poses of the messages that hold the twists, in a frame of their own; none in most bags."""
    pose_yaw: Array
    places: Array
    """(L, 3) of the standing landmarks' markers, m."""
    names: tuple[str, ...]
    """(L,) of the standing landmarks."""
    numbers: Mapping[int, int]
    """Numbers of the markers by landmark."""
    wheelbase: float
    scale_noise: float
    """Standard deviation of the scale of velocities, as the environment draws it."""
    noise: Mapping[str, float]
    """Declared deviations of turn rates ("gyro"), rad/s, and velocities ("wheel"), m/s, at the next rate, Hz."""
    odometry_rate: float

    def topic(self, roles: Sequence[Role]) -> str:
        """Return the topic of the first of some roles that the car has."""
        return next((self.topics[role] for role in roles if role in self.topics), roles[0].value)

    def is_of(self, times: str, role: Role) -> bool:
        """Return whether the times of a track are those of messages of a role, and at least two."""
        return len(self.tracks[times]) > 1 and next((r for r in ROLES_OF[times] if r in self.topics), None) is role

    @property
    def sightings_in_plane(self) -> tuple[Array, Array, Array]:
        """Times (n,), s, azimuths (n,), rad, in the body frame and positions (n, 2) of standing landmarks."""
        body = self.ray @ self.mounting.T
        return self.time, np.arctan2(body[:, 1], body[:, 0]), self.places[self.target, :2]

    @cached_property
    def truth_signals(self) -> tuple[SampledSignal, SampledSignal] | None:
        """Place (x, y) and heading by motion capture; None: there is too little."""
        time, place, yaw = (self.tracks[name] for name in ("truth_time", "truth", "truth_yaw"))
        if len(time) < 2:
            return None
        return SampledSignal(time, place), SampledSignal(time, np.unwrap(yaw))

    @property
    def own_signals(self) -> tuple[SampledSignal, SampledSignal] | None:
        """Place and heading by the poses of the odometry's own messages; None: it has none, or they never change."""
        if len(self.pose_time) < 2 or np.ptp(np.abs(self.pose - self.pose[0])) == 0.0:
            return None
        return SampledSignal(self.pose_time, self.pose), SampledSignal(self.pose_time, self.pose_yaw)

    def with_tracks(self, **tracks: Any) -> Self:
        """Return the streams with other tracks."""
        return replace(self, tracks={**self.tracks, **tracks})

    def with_turning(self, matrix: Array) -> Self:
        """Return the streams with turn rates times a matrix (3, 3)."""
        turning = self.turning @ matrix.T
        return replace(self.with_tracks(gyro=turning[:, 2]), turning=turning)

    def following_truth(self, kind: str, begin: float = -np.inf, end: float = np.inf) -> Self:
        """Return the streams with turn rates ("gyro") or velocities ("wheel") of motion capture from a time to one."""
        time, signals = self.tracks[f"{kind}_time"], self.truth_signals
        inside = (time >= begin) & (time <= end)
        if signals is None or not inside.any():
            return self
        half, values = 0.5 * SMOOTH, self.tracks[kind].copy()
        rates = [signal.over(time[inside] - half, time[inside] + half) / SMOOTH for signal in signals]
        if kind == "wheel":
            yaw = signals[1].over(time[inside], time[inside], level=True)[:, 0]
            moved = (rates[0][:, 0] + 1j * rates[0][:, 1]) * np.exp(-1j * yaw)
        else:
            moved = rates[1][:, 0]
        values[inside] = np.where(np.isfinite(moved), moved, 0.0)
        if kind == "wheel":
            return self.with_tracks(wheel=values)
        turning = self.turning.copy()
        turning[:, 2] = values
        return replace(self.with_tracks(gyro=values), turning=turning)

    def with_poses(self, pose: Array) -> Self:
        """Return the streams with other poses (n, 3, 4) of motion capture: rotations beside positions."""
        place, yaw = pose[:, 0, 3] + 1j * pose[:, 1, 3], np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
        return self.with_tracks(truth_pose=pose, truth=place, truth_yaw=yaw)

    def with_truth_of(self, rows: Any) -> Self:
        """Return the streams with some messages of motion capture, by an index of them."""
        return self.with_tracks(**{name: self.tracks[name][rows] for name in OF_TRUTH if name in self.tracks})

    def shifted(self, role: Role, seconds: float) -> Self:
        """Return the streams with a time added to the stamps of a role."""
        if role in CAMERAS:
            return replace(self, time=self.time + seconds)
        return self.with_tracks(**{n: self.tracks[n] + seconds for n in ROLES_OF if self.is_of(n, role)})


OF_TRUTH = ("truth_time", "truth", "truth_yaw", "truth_pose")
"""Tracks of motion capture."""
ROLES_OF = {"wheel_time": MOVING, "gyro_time": TURNING, "truth_time": (Role.TRUTH,)}
"""Roles of the times of tracks."""


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
        vehicle, scenario = self.binding.cars[name], self.binding.scenario
        camera, begin = scenario.cameras[vehicle], scenario.vehicles[vehicle].initial_pose
        noise = scenario.noises[vehicle]
        return CarStreams(
            name=name,
            vehicle=vehicle,
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
            mounting=camera.to_body(),
            lever=np.array(camera.position),
            height=begin.position[2] if begin is not None and begin.position is not None else 0.0,
            places=self.places,
            names=tuple(scenario.landmarks[i].name for i in standing),
            numbers={standing.index(t): n for n, t in self.binding.targets.items() if t in standing},
            wheelbase=scenario.limits[vehicle].wheelbase,
            scale_noise=noise.odometry_scale,
            noise={"gyro": noise.angular_velocity, "wheel": noise.velocity},
            odometry_rate=scenario.rates.odometry if noise.odometry_rate == "sample" else noise.odometry_rate,
        )
