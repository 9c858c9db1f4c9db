"""The interface of an observer: one class in NumPy for one vehicle, its inputs and outputs.

Frames: positions in the map frame, rotations from body to map, bearings as unit vectors from the camera to the target
in the BODY frame (the paper's g_ij is the negative).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite
from operator import index
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.sections import LARGEST
from coopenv.estimation.poses import Array, Coordinates
from coopenv.estimation.validity import MAX_BEND, MOST_LOPSIDED, are_rotations
from coopenv.measurements.kinds import Landmarks
from coopenv.measurements.sensor import Reading, Sensor

BYTES_PER_NUMBER = 8
MIN_BEARING_STD = 1e-4  # rad; noise-free scenarios would leave a Kalman filter with a singular innovation


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations at the scenario's rates."""

    velocity: float  # m/s, of each component of an odometry sample
    angular_velocity: float  # rad/s, of each component of an odometry sample
    odometry_period: float  # s, for which a sample is held
    bearing: float
    """rad, of each tangent axis of a bearing. For the paper's noise model this is the standard deviation on the image
    plane, which is reached on the optical axis only and is an upper bound elsewhere."""
    image_axis: tuple[float, float, float] | None = None
    """Axis of that image plane, unit vector in the body frame; None: the noise is in the tangent plane."""
    odometry_scale: float = 0.0
    """From here on lasting errors, standard deviations, see `[noise]` and `[camera]`; walks per square root of s."""
    odometry_scale_walk: float = 0.0  # per square root of a second
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad/s, body axes
    gyro_bias_walk: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad/s per square root of a second, body axes
    slip: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    """Slips per second, their mean duration in s, the largest share that wheels read too much, and the largest side
    slip angle in rad."""
    camera_orientation: float = 0.0  # rad per axis, of the camera's mounting
    camera_position: float = 0.0  # m per axis
    focal_length: float = 0.0  # relative
    clock_offset: float = 0.0  # s, of the vehicle's clock, by which its messages are dated
    turn_scale: float = 0.0
    """From here on lasting errors of odometry that is the commands of a vehicle: of the rate of turn, relative."""
    curvature: float = 0.0  # rad/m, by which the vehicle turns while it is to drive straight
    turning_loss: float = 0.0  # s/rad, the share of its speed that the vehicle loses per rate of turn
    odometry_lead: float = 0.0  # s, by which odometry is ahead of the motion
    velocity_by_speed: float = 0.0  # m/s per m/s
    angular_velocity_by: tuple[float, float] = (0.0, 0.0)  # rad/s per m/s, and rad/s per rad/s
    """Additional noise of a moving vehicle's odometry samples, proportional to its motion."""
    latency: float = 0.0
    """From here on errors of the camera: by how much frames are older than stated, s, a constant of the vehicle."""
    latency_jitter: float = 0.0  # s, likewise, drawn for every frame
    camera_orientation_walk: float = 0.0  # rad per axis per square root of a second, of the camera's mounting

    def moving(self, velocity: Array, angular_velocity: Array) -> "SensorNoise":
        """Return the noise of a sample at a velocity (3,) in m/s and an angular velocity (3,) in rad/s."""
        by_speed, by_turning = self.angular_velocity_by
        if not (self.velocity_by_speed or by_speed or by_turning):
            return self
        speed, rate = float(np.linalg.norm(velocity)), float(np.linalg.norm(angular_velocity))
        return replace(
            self,
            velocity=self.velocity + self.velocity_by_speed * speed,
            angular_velocity=self.angular_velocity + by_speed * speed + by_turning * rate,
        )

    def odometry(self, dt: float) -> Array:
        """Return the variances (6,) of (rotation, translation) of the increment over dt.

        The noise is taken as white of density sigma^2 times the period; exact where both rates are equal.
        """
        scale = self.odometry_period * dt
        turn, step = self.angular_velocity**2 * scale, self.velocity**2 * scale
        return np.array([turn, turn, turn, step, step, step], float)

    def bearing_information(self, bearings: Array) -> Array:
        """Return the information matrices (m, 3, 3), 1/rad^2, of unit bearings (m, 3), body frame, about themselves.

        On the image plane across an axis the coordinates of u are those of u / (u . axis), so that a deviation there
        counts |u . axis| times across u, and once more where it lies in the plane of u and the axis.
        """
        u = np.asarray(bearings, dtype=np.float64)
        across = np.eye(3) - u[:, :, None] * u[:, None, :]
        if self.image_axis is None:
            return across / self.bearing_std**2
        axis = np.array(self.image_axis)
        plane = np.linalg.svd(axis[None])[2][1:].T  # (3, 2) two axes of the image plane
        J = np.abs(u @ axis)[:, None, None] * (across @ plane)
        covariance = self.bearing**2 * J @ np.swapaxes(J, 1, 2) + MIN_BEARING_STD**2 * across
        return np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)

    @property
    def bearing_std(self) -> float:
        """The bearing's standard deviation, but at least `MIN_BEARING_STD`, rad."""
        return max(self.bearing, MIN_BEARING_STD)


@dataclass(frozen=True)
class Gains:
    """The scenario's gains for the Riccati observer of one vehicle."""

    k: float  # gain k_i, above 0.5
    q: Array  # (T,) weights q_ij of bearings, per target
    V: tuple[float, float]  # V = diag(V[0] I3, V[1] I3) over (2 lambda, p)
    P0: tuple[float, float]  # P(0) = diag(P0[0] I3, P0[1] I3)
    max_turn: float  # rad, by which the attitude turns within a tick until the correction is linearised anew


@dataclass(frozen=True)
class Setup:
    """The initial data of one vehicle. Targets are landmarks first, then vehicles."""

    vehicle: int  # its index, 0 is the first
    name: str  # of the vehicle
    target_names: tuple[str, ...]  # (T,)
    landmarks: int  # how many of the targets are landmarks; vehicle j is target `landmarks + j`
    targets: NDArray[np.int64]  # (m,) its neighbours
    lever_arm: Array  # (3,) the camera's place in the body, m
    marker: Array  # (3,) the point of this vehicle that others' cameras measure, in its body, m
    noise: SensorNoise  # standard deviations of what this vehicle senses
    gains: Gains  # of the Riccati observer
    optical_axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Unit vector of the camera in the body frame, from which a wrong focal length moves bearings away."""
    sensors: tuple[Sensor, ...] = ()  # beside the camera
    landmark_rotation: Array | None = None
    """(L, 3, 3) of the landmarks on the map, NaN for those that move; None: no sensor measures an orientation."""
    landmark_std: tuple[float, ...] = ()
    """(L,) accuracy of the map: standard deviations of the landmarks' positions per axis, m, the same error for all
    vehicles; empty: exact."""


@dataclass(frozen=True)
class ObserverInit:
    """The setups of all observers, and the properties of the radio."""

    setups: tuple[Setup, ...]  # one per vehicle
    order: tuple[int, ...]  # vehicles in the order in which they estimate: leaders first
    dt: float  # s
    period: int  # ticks between messages
    staleness: float  # s
    flight: int  # ticks that a message may be under way
    start_covariance: Array  # (N, 6, 6) LEFT coordinates


@dataclass(frozen=True)
class Message:
    """A broadcast; an observer sets the fields that it sends, and `size_bytes` counts them.

    `position` is that of the sender's marker, which cameras measure, and `covariance` is the 3x3 covariance of that
    point, both in the map frame. `extra` holds anything else, as arrays.
    """

    position: Array | None = None  # (3,) of the sender's marker, map, m
    rotation: Array | None = None  # (3, 3) body to map
    covariance: Array | None = None  # (3, 3) of `position`, map, m^2
    extra: Mapping[str, Array] = field(default_factory=dict)  # by name, whatever the observer sends beside

    @property
    def size_bytes(self) -> int:
        """Payload: a rotation travels as a quaternion of 4 times 8 bytes, a covariance as its triangle.

        Numbers count as wide as their array holds them, so that a sender saves bytes with a narrower dtype.
        """
        size = sum(np.asarray(a).nbytes for a in self.extra.values())
        if self.position is not None:
            size += np.asarray(self.position).nbytes
        if self.rotation is not None:
            size += 4 * BYTES_PER_NUMBER
        if self.covariance is not None:
            n = len(self.covariance)
            size += n * (n + 1) // 2 * np.asarray(self.covariance).itemsize
        return size


@dataclass(frozen=True)
class Received:
    """A neighbour's latest message that arrived and is not stale."""

    message: Message  # as it was sent
    age: float  # s since it was sent


@dataclass(frozen=True)
class Tick:
    """The measurements and received messages of one vehicle at one camera frame."""

    index: int  # number of the camera frame, 0 at the start
    time: float  # s since the start
    dt: float  # s since the last tick
    rotation: Array  # (3, 3) odometry dR over the tick: R <- R dR
    translation: Array  # (3,) odometry dp over the tick, in the body frame at its start: p <- p + R dp, m
    velocity: Array  # (3,) last odometry sample, body frame, m/s
    angular_velocity: Array  # (3,) last odometry sample, body frame, rad/s
    targets: NDArray[np.int64]  # (m,) indices of the neighbours: landmarks first, then vehicles
    bearings: Array  # (m, 3) unit vectors camera -> target in the body frame; NaN where not valid
    valid: NDArray[np.bool_]  # (m,) whether the target was measured in this frame
    landmarks: Array  # (L, 3) known positions of the landmarks now, map frame, m
    messages: Mapping[int, Received]  # by target index
    lever_arm: Array  # (3,) the camera's place in the body, m
    noise: SensorNoise  # standard deviations, those of the setup at the velocity of this tick
    due: bool = True  # whether the scenario's observer rate (`rates.observer`) asks for a correction at this frame
    readings: tuple[Reading, ...] = ()  # of the sensors beside the camera, in the order of `Setup.sensors`
    landmark_rotation: Array | None = None  # as in `Setup`
    landmark_names: tuple[str, ...] = ()  # (L,) of the landmarks, or empty
    bearing_age: float = 0.0  # s since the frame was exposed

    @cached_property
    def landmarks_by_name(self) -> Landmarks:
        """Positions (3,) of the landmarks that have names, map frame, m."""
        return Landmarks(zip(self.landmark_names, self.landmarks, strict=False))

    def usable(self) -> list[tuple[int, Array, Array, Message | None]]:
        """Return (target, bearing, position, message) of every measured target with a known or received position.

        The message is None for a landmark.
        """
        result: list[tuple[int, Array, Array, Message | None]] = []
        targets, landmarks = self.targets.tolist(), len(self.landmarks)
        for n in self.valid.nonzero()[0].tolist():
            target = targets[n]
            if target < landmarks:
                result.append((target, self.bearings[n], self.landmarks[target], None))
            elif (received := self.messages.get(target)) is not None and received.message.position is not None:
                result.append((target, self.bearings[n], received.message.position, received.message))
        return result


@dataclass(frozen=True)
class Estimate:
    """The estimated pose of a vehicle with its covariance."""

    rotation: Array  # (3, 3) body to map
    position: Array
    """(3,) of the body's origin in the MAP frame, m (the paper's pbar; its p_i is rotation.T @ position)."""
    covariance: Array | None = None
    """(6, 6) over the error in `coordinates`, rad and m; None: the observer states none."""
    coordinates: Coordinates = Coordinates.LEFT  # of the error that the covariance is about
    nis: float | None = None
    """Normalised innovation squared r^T S^-1 r of this tick's correction; None: there was none, or it is not stated."""
    nis_dof: int = 0  # its degrees of freedom: two per bearing used
    protection_level: tuple[float, float] | None = None
    """Bounds of the horizontal error, m, and of the angle, rad, with one faulty source; infinite: unknown, None: not
    given."""


@runtime_checkable
class Observer(Protocol):
    """One vehicle's estimator. It is built as `factory(setup)`."""

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose (rotation (3, 3), map position (3,)) with a covariance (6, 6) in LEFT coordinates."""

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick."""

    def message(self) -> Message:
        """Return the message to broadcast now; called after `update` (or `reset`) when a message is due."""


@runtime_checkable
class JointObserver(Protocol):
    """An estimator of all vehicles at once with all measurements: a reference, not deployable.

    Its class has `joint = True`, and it is built as `factory(setups)`, one setup per vehicle.
    """

    joint: bool  # True

    def reset(self, initial_poses: Sequence[tuple[Array, Array]], initial_covariances: Sequence[Array]) -> None:
        """Start at one pose and covariance per vehicle, as for `Observer`."""

    def update(self, ticks: Sequence[Tick]) -> list[Estimate]:
        """Take one camera tick of every vehicle; received messages in it are empty."""

    def messages(self) -> list[Message]:
        """Return the message of each vehicle for this tick."""


Factory = Any  # builds an `Observer` from a `Setup`, or a `JointObserver` from a sequence of them


def sealed(view: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view."""
    view.setflags(write=False)
    return view


MOST_NEGATIVE = 1e-9  # how far below zero an eigenvalue of P may lie, relative to the largest one

FARTHEST = 1e8  # m, of a plausible position: the earth is smaller
LEAST_VARIANCE, LARGEST_VARIANCE = 1e-16, 1e12  # rad^2 and m^2, of a plausible covariance

POSITION, ROTATION, COVARIANCE = (3,), (3, 3), (6, 6)
SENT_COVARIANCES = (ROTATION, COVARIANCE)  # shapes: of the marker's position, or of the whole pose
IDENTITY = np.eye(3)


def check_estimate(estimate: Estimate) -> None:
    """Refuse an invalid estimate with a CoopenvError that names the field and the reason."""
    if not isinstance(estimate, Estimate):
        raise CoopenvError(f"update returned {shown(estimate)}, expected an Estimate")
    _check_rotation(_checked_array("rotation", estimate.rotation, LARGEST, ROTATION))
    _checked_array("position", estimate.position, LARGEST, POSITION)
    if not isinstance(estimate.coordinates, Coordinates):
        raise CoopenvError(f"coordinates are {shown(estimate.coordinates)}, not a member of Coordinates")
    if estimate.covariance is not None:
        _check_covariance(_checked_array("covariance", estimate.covariance, LARGEST**2, COVARIANCE))
    if estimate.nis is not None and not (isfinite(estimate.nis) and index(estimate.nis_dof) >= 0):
        raise CoopenvError("nis is not finite, or nis_dof negative")
    if estimate.protection_level is not None:
        level = np.array(estimate.protection_level)
        if level.shape != (2,) or level.dtype.kind not in "fiu" or not (level >= 0.0).all():
            raise CoopenvError("protection_level is not two numbers from 0 to infinity")


def check_message(message: Message) -> None:
    """Refuse an invalid message with a CoopenvError; of `extra` only the kind of the arrays is checked."""
    _check_pose(message)
    for name, value in message.extra.items():
        _checked_numbers(name, value)


def check_received(message: Message) -> None:
    """Refuse a message that a receiver cannot use with a CoopenvError: its sender may be faulty or hostile.

    In addition to `check_message`: a matrix that is no rotation, a covariance that is not positive definite or not of a
    plausible size, and numbers that are not finite.
    """
    position, R, P = _check_pose(message)
    if position is not None and np.abs(position).max() > FARTHEST:
        raise CoopenvError(f"message: position beyond {FARTHEST:g} m")
    if R is not None:
        _check_rotation(R)
    if P is not None:
        _check_covariance(P)
        if P.diagonal().max() > LARGEST_VARIANCE or not is_definite(P, LEAST_VARIANCE, LARGEST_VARIANCE):
            raise CoopenvError("message: covariance is not positive definite, or not plausible")
    for name, value in message.extra.items():
        numbers = _checked_numbers(name, value)  # a sum of squares is faster, but may overflow
        if (
            numbers.dtype.kind in "fc"
            and not isfinite(abs(np.vdot(numbers, numbers)))
            and not np.isfinite(numbers).all()
        ):
            raise CoopenvError(f"message: extra '{name}' is not finite")


def _check_pose(message: Message) -> tuple[Array | None, Array | None, Array | None]:
    """Return position, rotation and covariance in float64; refuse other shapes, and numbers that are too large."""
    p, R, P = message.position, message.rotation, message.covariance
    return (
        None if p is None else _checked_array("message: position", p, LARGEST, POSITION),
        None if R is None else _checked_array("message: rotation", R, LARGEST, ROTATION),
        None if P is None else _checked_array("message: covariance", P, LARGEST**2, *SENT_COVARIANCES),
    )


def _checked_numbers(name: str, value: ArrayLike) -> NDArray[Any]:
    """Return an array of a message; refuse other kinds than numbers."""
    array = np.asarray(value)
    if array.dtype.kind not in "biufc":
        raise CoopenvError(f"message: extra '{name}' is no array of numbers")
    return array


def is_definite(P: Array, least: float, largest: float) -> bool:
    """Return whether P (n, n) is symmetric and positive definite with variances from `least` to `largest`."""
    variances = P.diagonal()
    return bool(variances.min() >= least and variances.max() <= largest and _is_symmetric(P) and dpotrf(P)[1] == 0)


def _is_symmetric(P: Array) -> bool:
    lopsided = P - P.T
    return bool(np.vdot(lopsided, lopsided) <= MOST_LOPSIDED**2 * np.vdot(P, P))


def _checked_array(name: str, value: ArrayLike, largest: float, *shapes: tuple[int, ...]) -> Array:
    """Return an array in float64; refuse other kinds and shapes, and numbers beyond `largest`."""
    array = np.asarray(value)
    kind = array.dtype.kind
    if kind == "c":
        raise CoopenvError(f"{name} is complex")
    if array.shape in shapes and kind in "iuf":
        numbers = np.asarray(array, np.float64)
        # the sum of squares is faster, but may exceed the bound of its terms
        if np.vdot(numbers, numbers) <= largest * largest or (np.abs(numbers) <= largest).all():
            return numbers
    shape = " or ".join(map(str, shapes))
    raise CoopenvError(f"{name} is not a finite array of shape {shape} with numbers up to {largest:g}")


def _check_rotation(R: Array) -> None:
    bend = R.T.dot(R) - IDENTITY
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0.0 and np.vdot(bend, bend) <= MAX_BEND**2:
        return  # sufficient, and fast
    if not are_rotations(R):
        raise CoopenvError("rotation is a reflection" if are_rotations(-R) else "rotation is not orthogonal")


def _check_covariance(P: Array) -> None:
    if not _is_symmetric(P):
        raise CoopenvError("covariance is not symmetric")
    if dpotrf(P)[1] == 0 or dpotrf(P + MOST_NEGATIVE * P.diagonal().max() * np.eye(len(P)))[1] == 0:
        return  # the second condition is for singular matrices, as of a known height
    eigenvalues = np.linalg.eigvalsh(P)
    if eigenvalues[0] < -MOST_NEGATIVE * eigenvalues[-1]:
        raise CoopenvError("covariance is not positive semidefinite")
