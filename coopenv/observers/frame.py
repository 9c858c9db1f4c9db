"""The usable measurements of a frame, of the camera and of other sensors, and their linearisation.

Bearings alone, the usual case, are linearised by compiled functions. Measurements of other sensors are linearised by
their kinds (`coopenv.measurements`). A measurement has as many rows as the longest one of the frame. A row that was not
measured has residual 0, derivative 0 and noise 1, and so counts nothing.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from coopenv.estimation.compiled import (
    FLAG,
    MATRICES,
    MATRIX,
    NUMBER,
    ROW,
    VECTOR,
    adjoint,
    compiled,
    congruent,
    place,
    transformed,
)
from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import Placed
from coopenv.measurements.sensor import MAP, LinearRows
from coopenv.observers.contract import Message, Tick
from coopenv.observers.uncertain_pose import RIGHT, UncertainPose

FRAME = types.Tuple((VECTOR, MATRIX, MATRIX, MATRICES, NUMBER))
"""Lever arm (3,), bearings (m, 3), points (m, 3), their covariances (m, 3, 3), and a bearing's variance."""
Frame = tuple[Array, Array, Array, Array, float]

CAMERA = -1  # in place of the number of a sensor
BEARING_ROWS, MOST_VALUES = 2, 6
UNKNOWN_ANGLE = 0.5  # rad, a standard deviation from which on a sensor does not measure an angle


def measured_message(tick: Tick) -> Message:
    """Return the measurements of a tick as a message: the odometry sample, the bearings, and other readings."""
    odometry = np.concatenate([tick.angular_velocity, tick.velocity])
    extra = {"odometry": odometry, "bearings": tick.bearings[tick.valid]}
    return Message(extra=extra | {reading.sensor.name: reading.values[reading.valid] for reading in tick.readings})


class OtherMeasurements(NamedTuple):
    """Entries of the measurements of a frame beside bearings, m of each; those of the camera are not read."""

    sensor: NDArray[np.int64]  # (m,) its number among the vehicle's sensors, or CAMERA
    values: Array  # (m, MOST_VALUES)
    rotation: Array  # (m, 3, 3) of the targets as known or reported, NaN where not
    velocity: Array  # (m, 3) likewise, map, m/s
    turns: Array  # (m, 6, 3) covariance of the pose, about own axes and in map axes, with the turn
    curvature: Array  # (m, MOST_VALUES) variances of second-order errors of the rows


class UsableMeasurements(NamedTuple):
    """The usable measurements of a frame."""

    bearings: Array  # (m, 3) unit vectors, body frame
    positions: Array  # (m, 3) of the points, as known or reported, map frame, m
    covariances: Array  # (m, 3, 3) of the points, m^2, zero for known points and without a reported covariance
    targets: NDArray[np.int64]  # (m,)
    messages: NDArray[Any]  # (m,) `Message`, None for landmarks
    others: OtherMeasurements | None = None  # None: all are bearings of the camera

    def only(self, kept: NDArray[Any] | slice) -> "UsableMeasurements":
        """Return the measurements of a mask (m,), of numbers or of a range."""
        others = None if self.others is None else OtherMeasurements._make(part[kept] for part in self.others)
        parts: tuple[NDArray[Any], ...] = self[:-1]
        return UsableMeasurements._make([*(part[kept] for part in parts), others])

    def of_camera(self) -> "UsableMeasurements":
        """Return the bearings of the camera."""
        return self if self.others is None else self.only(self.others.sensor == CAMERA)._replace(others=None)

    def exact(self) -> "UsableMeasurements":
        """Return the measurements as if the targets were known exactly."""
        others = self.others and self.others._replace(turns=np.zeros_like(self.others.turns))
        return self._replace(covariances=np.zeros_like(self.covariances), others=others)

    def inflated(self, factor: float) -> "UsableMeasurements":
        """Return the measurements with a factor on the covariances of their targets."""
        others = self.others and self.others._replace(turns=self.others.turns * factor)
        return self._replace(covariances=self.covariances * factor, others=others)


class LinearMeasurements(NamedTuple):
    """Linearised measurements, each with r rows."""

    residual: Array  # (m, r); of bearings rad, in the tangent planes
    H: Array  # (m, r, n) derivative of the measurement by the error
    N: Array  # (m, r, r) covariance of the residuals given the own pose
    G: Array  # (m, r, 3) derivative of the measurement by the points, map axes
    ahead: NDArray[np.bool_]  # (m,) whether the points are ahead along the bearings, and not behind
    turn: Array | None = None  # (m, r, 3) derivative by a turn of the target about its own axes; None: it is zero
    used: NDArray[np.bool_] | None = None  # (m, r) rows that were measured; None: all
    angles: NDArray[np.bool_] | None = None  # (m, r) rows that measure an angle; None: all
    common: Array | None = None  # (m, m, r, r) covariance of the residuals of two measurements of one target, or None

    def only(self, kept: NDArray[np.bool_]) -> "LinearMeasurements":
        """Return the measurements of a mask (m,)."""
        common = None if self.common is None else self.common[np.ix_(kept, kept)]
        return LinearMeasurements._make(None if part is None else part[kept] for part in self)._replace(common=common)

    def spread(self, P: Array) -> Array:
        """Return (m, r, r) the covariances of the innovations, given that of the error (n, n)."""
        return spread(self.H, P, self.N)

    def noise(self) -> Array:
        """Return the covariance (rm, rm) of the residuals given the own pose."""
        N = dense(self.N)
        if self.common is not None:
            N += self.common.transpose(0, 2, 1, 3).reshape(N.shape)
        return N

    def stacked(self) -> tuple[Array, Array, Array]:
        """Return the residual (rm,), H (rm, n) and N (rm, rm)."""
        return self.residual.ravel(), self.H.reshape(-1, self.H.shape[-1]), self.noise()

    @property
    def dof(self) -> int:
        """Number of rows that were measured."""
        return self.residual.size if self.used is None else int(self.used.sum())


def usable_measurements(tick: Tick, weighed: bool = True) -> UsableMeasurements | None:
    """Return the usable measurements of a frame, None without any; `weighed`: with the reported covariances."""
    seen = tick.usable()
    others = [*_other_measurements(tick, weighed)] if tick.readings else []
    if not (seen or others):
        return None
    covariances = np.zeros((len(seen), 3, 3))
    if weighed:
        for n, (*_, message) in enumerate(seen):
            if message is not None and message.covariance is not None:
                covariances[n] = point_covariance(message)
    targets, bearings, positions, messages = zip(*seen, strict=True) if seen else ((), (), (), ())
    bearings_alone = UsableMeasurements(
        np.array(bearings, float).reshape(-1, 3),
        np.array(positions, float).reshape(-1, 3),
        covariances,
        np.array(targets, np.int64),
        np.array(messages, object),
    )
    return _joined(bearings_alone, others) if others else bearings_alone


def _other_measurements(tick: Tick, weighed: bool) -> Iterator[tuple[Any, ...]]:
    """Yield target, position, covariance, message, and the entries of `OtherMeasurements` of every usable reading."""
    for number, (sensor, values, _) in enumerate(tick.readings):
        for n in np.flatnonzero(np.isfinite(values).all(axis=-1)).tolist():
            target, position, message = int(sensor.targets[n]), np.zeros(3), None
            rotation, velocity, C = np.eye(3), np.zeros(3), np.zeros((6, 6))
            if target >= len(tick.landmarks):
                received = tick.messages.get(target)
                if received is None or received.message.position is None:
                    continue
                message = received.message
                position, rotation, velocity, C = _reported(message, weighed)
            elif target != MAP:
                position = tick.landmarks[target]
                rotation = np.eye(3) if tick.landmark_rotation is None else tick.landmark_rotation[target]
                velocity = np.where(np.isfinite(rotation).all(), np.zeros(3), np.nan)
            padded = np.pad(values[n], (0, MOST_VALUES - len(values[n])), constant_values=np.nan)
            entries = number, padded, rotation, velocity, C[:, :3], np.zeros(MOST_VALUES)
            yield target, position, C[3:, 3:], message, entries


def _reported(message: Message, weighed: bool) -> tuple[Array, Array, Array, Array]:
    """Return position, rotation, velocity and covariance (6, 6) as reported; NaN for what the message does not have."""
    unknown, R, C = np.full((3, 3), np.nan), message.rotation, np.zeros((6, 6))
    velocity = np.asarray(message.extra.get("velocity", unknown[0]), float)
    if weighed and message.covariance is not None:
        if len(message.covariance) == 6 and R is not None:
            turned = np.kron(np.eye(2), np.eye(3))
            turned[3:, 3:] = R
            C = turned @ message.covariance @ turned.T
        else:
            C[3:, 3:] = point_covariance(message)
    assert message.position is not None
    return message.position, unknown if R is None else R, velocity if velocity.shape == (3,) else unknown[0], C


def _joined(bearings: UsableMeasurements, others: list[tuple[Any, ...]]) -> UsableMeasurements:
    """Return the bearings of a camera followed by the measurements of other sensors."""
    targets, positions, covariances, messages, entries = zip(*others, strict=True)
    count, m = len(bearings.targets), len(bearings.targets) + len(others)
    of_camera = CAMERA, np.full(MOST_VALUES, np.nan), np.eye(3), np.zeros(3), np.zeros((6, 3)), np.zeros(MOST_VALUES)
    parts = [np.array(part) for part in zip(*[of_camera] * count, *entries, strict=True)]
    named = np.empty(len(others), object)
    named[:] = messages
    return UsableMeasurements(
        np.concatenate([bearings.bearings, np.full((m - count, 3), np.nan)]),
        np.concatenate([bearings.positions, np.array(positions, float)]),
        np.concatenate([bearings.covariances, np.array(covariances, float)]),
        np.concatenate([bearings.targets, np.array(targets, np.int64)]),
        np.concatenate([bearings.messages, named]),
        OtherMeasurements(*parts),
    )


def point_covariance(message: Message) -> Array:
    """Return the covariance (3, 3) in map axes of a reported position; zero if the message has none."""
    if message.covariance is None or len(message.covariance) == 3 or message.rotation is None:
        return np.zeros((3, 3)) if message.covariance is None else message.covariance[:3, :3]
    R = message.rotation
    return np.asarray(R.dot(message.covariance[3:, 3:]).dot(R.T))


def frame_of(tick: Tick, measured: UsableMeasurements) -> Frame:
    """Return the arguments of compiled functions for a frame of bearings."""
    return np.asarray(tick.lever_arm, float), *measured[:3], tick.noise.bearing_std**2


def linearised(pose: UncertainPose, tick: Tick, measured: UsableMeasurements) -> LinearMeasurements:
    """Linearise measurements at a pose; the points' covariances are noise, as if independent of the pose."""
    if measured.others is None:
        return LinearMeasurements(*linearise(pose.R, pose.p, pose.kind == RIGHT, *frame_of(tick, measured)))
    kinds = {number: tick.readings[number].sensor.kind for number in {*measured.others.sensor.tolist()} - {CAMERA}}
    r = max([BEARING_ROWS, *(kind.rows for kind in kinds.values())])
    m = len(measured.targets)
    linear = LinearMeasurements(
        np.zeros((m, r)),
        np.zeros((m, r, 6)),
        np.tile(np.eye(r), (m, 1, 1)),
        np.zeros((m, r, 3)),
        np.ones(m, np.bool_),
        np.zeros((m, r, 3)),
        np.zeros((m, r), np.bool_),
        np.zeros((m, r), np.bool_),
    )
    _put_bearings(linear, pose, tick, measured)
    for number, kind in kinds.items():
        rows = np.flatnonzero(measured.others.sensor == number)
        _put(linear, rows, rows_of(pose, tick, measured.only(rows), number), pose, measured)
        angles = np.equal(kind.units, "rad") & (tick.readings[number].sensor.std < UNKNOWN_ANGLE)
        linear.angles[rows, : kind.rows] = angles  # type: ignore[index]
    return linear._replace(common=_common(linear, measured))


def rows_of(pose: UncertainPose, tick: Tick, measured: UsableMeasurements, number: int) -> LinearRows:
    """Return the linearised measurements of one sensor, all of a frame's that are its own."""
    sensor, others = tick.readings[number].sensor, measured.others
    assert others is not None
    own = sensor.placed(pose.R, pose.p, tick.velocity, tick.angular_velocity, tick.landmarks_by_name)
    target = Placed(measured.positions, others.rotation, others.velocity, np.zeros_like(others.velocity))
    return sensor.linearised(pose.R, own.repeated(len(measured.targets)), target, others.values[:, : sensor.kind.size])


def _put_bearings(linear: LinearMeasurements, pose: UncertainPose, tick: Tick, measured: UsableMeasurements) -> None:
    bearings = measured.of_camera()
    if count := len(bearings.targets):
        of = linearised(pose, tick, bearings)
        rows, two = slice(0, count), slice(0, BEARING_ROWS)
        linear.residual[rows, two], linear.H[rows, two], linear.G[rows, two] = of.residual, of.H, of.G
        linear.N[rows, two, two], linear.ahead[rows] = of.N, of.ahead
        linear.used[rows, two] = linear.angles[rows, two] = True  # type: ignore[index]


def _put(
    linear: LinearMeasurements, rows: Any, found: LinearRows, pose: UncertainPose, measured: UsableMeasurements
) -> None:
    """Write the rows of one sensor; an uncertain pose of the target adds to the noise."""
    r = slice(0, found.residual.shape[1])
    by_own = found.by_own @ np.linalg.inv(adjoint(pose.R, pose.p)) if pose.kind == RIGHT else found.by_own
    assert measured.others is not None
    C, variances = pose_covariances(measured)[rows], found.noise + measured.others.curvature[rows, r]
    linear.residual[rows, r], linear.H[rows, r], linear.used[rows, r] = found.residual, by_own, found.used  # type: ignore[index]
    linear.turn[rows, r], linear.G[rows, r] = found.by_target[..., :3], found.by_target[..., 3:]  # type: ignore[index]
    diagonal = variances[..., None] * np.eye(found.noise.shape[1])
    linear.N[rows, r, r] = diagonal + found.by_target @ C @ np.swapaxes(found.by_target, -1, -2)


def pose_covariances(measured: UsableMeasurements) -> Array:
    """Return the covariances (m, 6, 6) of the targets: a turn about own axes, rad, and the position in map axes, m."""
    assert measured.others is not None
    C = np.zeros((len(measured.targets), 6, 6))
    C[:, :, :3] = measured.others.turns
    C[:, :3, 3:] = np.swapaxes(measured.others.turns[:, 3:], -1, -2)
    C[:, 3:, 3:] = measured.covariances
    return C


def _common(linear: LinearMeasurements, measured: UsableMeasurements) -> Array | None:
    """Return the covariances (m, m, r, r) by which an uncertain target couples its measurements; None without any."""
    C = pose_covariances(measured)
    uncertain = np.asarray(C.any(axis=(1, 2)))
    other = ~np.eye(len(C), dtype=bool) & uncertain[:, None]
    same = other & np.equal(measured.targets[:, None], measured.targets)
    if not same.any():
        return None
    assert linear.turn is not None
    by_target = np.concatenate([linear.turn, linear.G], axis=-1)
    return np.asarray(np.einsum("nra,nab,msb->nmrs", by_target, C, by_target) * same[..., None, None])


@compiled(NUMBER, NUMBER, NUMBER)
def across(x: float, y: float, z: float) -> Array:
    """Return (2, 3) orthonormal rows across a unit vector.

    Source: Duff et al., Building an orthonormal basis, revisited, Journal of Computer Graphics Techniques 6(1), 2017.
    """
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    c = x * y * a
    return np.array([[1.0 + sign * x * x * a, sign * c, -sign * x], [c, sign + y * y * a, -y]])


@compiled(ROW, VECTOR, VECTOR, NUMBER)
def put_derivative(row: Array, u: Array, about: Array, factor: float) -> None:
    """Write (u x about, -u) times a factor into a row (6,)."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        row[k] = (u[i] * about[j] - u[j] * about[i]) * factor
        row[k + 3] = -u[k] * factor


@compiled(MATRIX, VECTOR, FLAG, VECTOR, MATRIX, MATRIX, MATRICES, NUMBER)
def linearise(
    R: Array, p: Array, right: bool, lever_arm: Array, bearings: Array, positions: Array, C: Array, variance: float
) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Return the first fields of `LinearMeasurements`; `right`: the error is about the map's axes.

    With the rows j of J, and g = R j, the derivative by a left error is (j x a, -j), by a right one (g x z, -g).
    """
    m = len(bearings)
    residual, H, N, G = np.empty((m, 2)), np.empty((m, 2, 6)), np.empty((m, 2, 2)), np.empty((m, 2, 3))
    ahead = np.empty(m, np.bool_)
    for n in range(m):
        z = positions[n]
        a = transformed(R.T, z - p)
        d = a - lever_arm
        distance = max(math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-9)
        B = across(d[0] / distance, d[1] / distance, d[2] / distance)
        for r in range(2):
            residual[n, r] = B[r, 0] * bearings[n, 0] + B[r, 1] * bearings[n, 1] + B[r, 2] * bearings[n, 2]
            for k in range(3):
                G[n, r, k] = (R[k, 0] * B[r, 0] + R[k, 1] * B[r, 1] + R[k, 2] * B[r, 2]) / distance
            if right:
                put_derivative(H[n, r], G[n, r], z, 1.0)
            else:
                put_derivative(H[n, r], B[r], a, 1.0 / distance)
        place(N[n], 0, 0, congruent(G[n], C[n]))
        N[n, 0, 0] += variance
        N[n, 1, 1] += variance
        ahead[n] = d[0] * bearings[n, 0] + d[1] * bearings[n, 1] + d[2] * bearings[n, 2] > 0.0
    return residual, H, N, G, ahead


@compiled(MATRIX, MATRICES)
def normalised(residual: Array, S: Array) -> Array:
    """Return (m,) r^T S^-1 r of residuals (m, 2)."""
    result = np.empty(len(residual))
    for n in range(len(residual)):
        x, y = residual[n]
        a, b, d = S[n, 0, 0], S[n, 0, 1], S[n, 1, 1]
        result[n] = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
    return result


@compiled(MATRICES)
def dense(blocks: Array) -> Array:
    """Return (rm, rm) the block diagonal of blocks (m, r, r)."""
    r = blocks.shape[1]
    N = np.zeros((r * len(blocks), r * len(blocks)))
    for n in range(len(blocks)):
        place(N, r * n, r * n, blocks[n])
    return N


@compiled(MATRICES, MATRIX, MATRICES)
def spread(H: Array, P: Array, N: Array) -> Array:
    """Return (m, r, r) H P H^T + N of every measurement."""
    S, r = N.copy(), N.shape[1]
    for n in range(len(H)):
        HPH = congruent(H[n], P)
        for i in range(r):
            for j in range(r):
                S[n, i, j] += HPH[i, j]
    return S
