"""Observers `robust` fed by hand: what a vehicle knows, the ticks that it gets, and bearings from poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.observers import Message, Received, Setup, Tick
from coopenv.observers.contract import Gains, SensorNoise
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust.observer import ROBUST


class OpenRobust(KernelObserver):
    """One vehicle's observer whose belief can be read."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(ROBUST, setup)

    @property
    def members(self) -> np.ndarray:
        """Records of the members: the vehicle itself, its calibration states, other vehicles."""
        return self.memory.member[: self.memory.belief["members"]]

    @property
    def others(self) -> np.ndarray:
        """Records of the members that are other vehicles."""
        return self.members[self.memory.belief["first_sender"] :]

    @property
    def member_numbers(self) -> list[int]:
        """The members, the vehicle itself first."""
        return [self.setup.vehicle, *self.others["vehicle"].tolist()]

    @property
    def P(self) -> np.ndarray:
        """(6n, 6n) joint covariance of n members."""
        n = len(self.members)
        return self.memory.P[:n, :n].swapaxes(1, 2).reshape(6 * n, 6 * n)


Pose = tuple[np.ndarray, np.ndarray]

LANDMARKS = np.array([[6.0, 1.0, 2.0], [2.0, 7.0, -1.0], [-5.0, 3.0, 1.5], [1.0, -6.0, 2.5], [4.0, -4.0, 0.5]])
LEVER_ARM, MARKER = np.array([0.3, 0.1, 0.5]), np.array([0.2, -0.1, 0.6])
VEHICLES = 3
TARGETS = np.arange(len(LANDMARKS) + VEHICLES)
PERIOD = 1.0 / 60.0
NOISE = SensorNoise(velocity=0.1, angular_velocity=0.01, odometry_period=PERIOD, bearing=0.003)
STILL: Pose = (np.eye(3), np.zeros(3))
BIAS, WALK = 1e-3, 1e-4
"""rad/s, of the gyro where no larger one is declared; and its walk in a second."""
CALIBRATION = np.diag([BIAS**2] * 3 + [1e-14] * 3)
"""The covariance of the calibration state of odometry and frames: bias, scale, focal length and latency."""


def known(vehicle: int = 0, noise: SensorNoise = NOISE) -> Setup:
    """Return what a vehicle knows that may see all landmarks and all other vehicles."""
    names = tuple(f"target_{n}" for n in TARGETS)
    targets = np.delete(TARGETS, len(LANDMARKS) + vehicle)
    gains = Gains(1.0, np.ones(len(TARGETS)), (1.0, 1.0), (1.0, 1.0), 1.0)
    L = len(LANDMARKS)
    return Setup(vehicle, f"vehicle_{vehicle}", names, L, targets, LEVER_ARM, MARKER, noise, gains)


def started(pose: Pose, P: np.ndarray, vehicle: int = 0, noise: SensorNoise = NOISE) -> OpenRobust:
    """Return an observer that has started at a pose with a covariance (6, 6) of left errors."""
    observer = OpenRobust(known(vehicle, noise))
    observer.reset(pose, P)
    return observer


def tick(
    observer: OpenRobust,
    index: int,
    step: Pose = STILL,
    bearings: Mapping[int, np.ndarray] | None = None,
    messages: Mapping[int, tuple[Message, float]] | None = None,
    dt: float = PERIOD,
) -> Tick:
    """Return the tick of a number.

    Args:
        observer: which it is for.
        index: its number, from 1 on.
        step: rotation and translation of the odometry.
        bearings: by target, unit vectors in the body.
        messages: by vehicle, with their age in s.
        dt: s since the last tick, as for all ticks before.
    """
    setup, seen = observer.setup, bearings or {}
    rows = np.array([seen.get(int(target), np.full(3, np.nan)) for target in setup.targets])
    heard = {setup.landmarks + vehicle: Received(*received) for vehicle, received in (messages or {}).items()}
    turn, way = Rotation.from_matrix(step[0]).as_rotvec(), step[1]
    return Tick(
        index=index,
        time=index * dt,
        dt=dt,
        rotation=step[0],
        translation=way,
        velocity=way / dt,
        angular_velocity=turn / dt,
        targets=setup.targets,
        bearings=rows,
        valid=np.isfinite(rows).all(axis=1),
        landmarks=LANDMARKS,
        messages=heard,
        lever_arm=setup.lever_arm,
        noise=setup.noise,
    )


def direction(pose: Pose, point: np.ndarray) -> np.ndarray:
    """Return the direction (3,) from the camera to a point of the map, in the body."""
    line = pose[0].T @ (point - pose[1]) - LEVER_ARM
    return np.asarray(line / np.linalg.norm(line))


def measured(pose: Pose, point: np.ndarray, rng: np.random.Generator, std: float = NOISE.bearing) -> np.ndarray:
    """Return a bearing with noise of a standard deviation per tangent axis, rad."""
    b = direction(pose, point)
    across = rng.normal(0.0, std, 3)
    b = b + across - b * (b @ across)
    return np.asarray(b / np.linalg.norm(b))


def displaced(pose: Pose, error: np.ndarray) -> Pose:
    """Return the pose that has a left error (6,) against one: rotation vector and translation, both in the body."""
    return pose[0] @ Rotation.from_rotvec(error[:3]).as_matrix(), pose[1] + pose[0] @ error[3:]


def left_error(pose: Pose, other: Pose) -> np.ndarray:
    """Return the left error (6,) of another pose against one."""
    turn = Rotation.from_matrix(pose[0].T @ other[0]).as_rotvec()
    return np.concatenate([turn, pose[0].T @ (other[1] - pose[1])])


def pose_of(observer: OpenRobust, n: int = 0) -> Pose:
    """Return where a member of the belief is, the vehicle itself first."""
    pose = observer.members["pose"][n]
    return pose["R"].copy(), pose["p"].copy()


def covariance(rng: np.random.Generator, angle: float, length: float) -> np.ndarray:
    """Return a covariance (6, 6) of correlated errors of these standard deviations or so, rad and m."""
    A = rng.normal(size=(6, 6)) + np.eye(6)
    C = A @ A.T
    scale = np.repeat([angle, length], 3) / np.sqrt(C.diagonal())
    return np.asarray(scale[:, None] * C * scale)


def predicted(P: np.ndarray, dt: float = PERIOD) -> np.ndarray:
    """Return the covariance (12, 12) of own and calibration errors after the first tick of a vehicle that stands."""
    calibration = CALIBRATION + np.diag([WALK**2 * dt] * 3 + [0.0] * 3)
    F = np.eye(12)
    F[:3, 6:9] = -dt * np.eye(3)
    start = np.zeros((12, 12))
    start[:6, :6], start[6:, 6:] = P + np.diag(NOISE.odometry(dt)), calibration
    return np.asarray(F @ start @ F.T)


def drawn(rng: np.random.Generator, pose: Pose, P: np.ndarray) -> Pose:
    """Return a true pose whose left error against an estimate has a covariance."""
    return displaced(pose, np.linalg.cholesky(P) @ rng.normal(size=6))
