"""Bearings of a frame as measurements: residuals, Jacobians, validity, and pose errors that odometry propagates."""

import math
from typing import Any, NamedTuple, Self

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
    WHOLE,
    adjoint,
    compiled,
    congruent,
    cross_matrix,
    exp_so3,
    exp_translation,
    orthonormalised,
    place,
    product,
    right_jacobian,
    transformed,
)
from coopenv.estimation.poses import IDENTITY, Array, Coordinates, skew
from coopenv.observers.contract import Estimate, Message, Tick

LEFT, RIGHT, INVARIANT = 0, 1, 2


FRAME = types.Tuple((VECTOR, MATRIX, MATRIX, MATRICES, NUMBER))
"""Lever arm (3,), bearings (m, 3), points (m, 3), their covariances (m, 3, 3), and a bearing's variance."""
Frame = tuple[Array, Array, Array, Array, float]


@compiled(MATRIX, VECTOR)
def transition(rotation: Array, translation: Array) -> Array:
    """Return F (6, 6) of a left error over an odometry increment (dR, dp)."""
    F, E = np.zeros((6, 6)), rotation.T
    place(F, 0, 0, E)
    place(F, 3, 3, E)
    place(F, 3, 0, product(E, cross_matrix(-translation)))
    return F


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, MATRIX, VECTOR, VECTOR)
def predicted(
    kind: int, R: Array, p: Array, P: Array, rotation: Array, translation: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Return R (3, 3), p (3,) in m and P (6, 6) after an odometry increment of variances (6,), rad^2 and m^2."""
    R, p = orthonormalised(product(R, rotation)), p + transformed(R, translation)
    Q = np.diag(noise)
    if kind == RIGHT:
        return R, p, P + congruent(adjoint(R, p), Q)
    return R, p, congruent(transition(rotation, translation), P) + Q


@compiled(WHOLE, MATRIX, VECTOR, VECTOR)
def moved(kind: int, R: Array, p: Array, dx: Array) -> tuple[Array, Array]:
    """Return the pose that has an error dx (6,) against one."""
    turn, shift = exp_so3(dx[:3]), dx[3:]
    if kind == RIGHT:
        return product(turn, R), transformed(turn, p) + shift
    if kind == INVARIANT:
        shift = exp_translation(dx[:3], shift)
    return product(R, turn), p + transformed(R, shift)


@compiled(WHOLE, VECTOR)
def recentring(kind: int, dx: Array) -> Array:
    """Return G (6, 6): about the pose moved by dx, an error of dx + d about this one is G d to first order.

    Of the invariant error it is the right Jacobian of SE(3), up to the fourth order.
    """
    G, theta, rho = np.zeros((6, 6)), dx[:3], dx[3:]
    if kind == INVARIANT:
        A = np.zeros((6, 6))
        place(A, 0, 0, cross_matrix(theta))
        place(A, 3, 3, cross_matrix(theta))
        place(A, 3, 0, cross_matrix(rho))
        G = np.eye(6) - A / 5.0
        for n in (4.0, 3.0, 2.0):
            G = np.eye(6) - product(A, G) / n
    elif kind == RIGHT:
        J = right_jacobian(-theta)
        place(G, 0, 0, J)
        place(G, 3, 0, product(cross_matrix(rho), J))
        place(G, 3, 3, np.eye(3))
    else:
        place(G, 0, 0, right_jacobian(theta))
        place(G, 3, 3, exp_so3(theta).T)
    return G


@compiled(WHOLE, MATRIX, VECTOR, VECTOR, MATRIX)
def corrected(kind: int, R: Array, p: Array, dx: Array, P: Array) -> tuple[Array, Array, Array]:
    """Return the pose moved by an error dx, of which P is the covariance about this pose."""
    R, p = moved(kind, R, p, dx)
    return R, p, congruent(recentring(kind, dx), P)


class UncertainPose(NamedTuple):
    """A pose with the covariance of its error."""

    kind: int  # of the error: LEFT, RIGHT, or INVARIANT (xi, which is also the left error to first order)
    R: Array  # (3, 3) body to map
    p: Array  # (3,) map frame, m
    P: Array  # (6, 6)

    @classmethod
    def start(cls, kind: int, R: Array, p: Array, P: Array) -> Self:
        """Return the estimate of a pose with a covariance in LEFT coordinates."""
        R, p, P = (np.array(values, float) for values in (R, p, P))
        return cls(kind, R, p, congruent(adjoint(R, p), P) if kind == RIGHT else P)

    def predicted(self, tick: Tick) -> Self:
        """Return the estimate after the tick's odometry."""
        step = (*increment(tick), tick.noise.odometry(tick.dt))
        return type(self)(self.kind, *predicted(self.kind, self.R, self.p, self.P, *step))

    def moved(self, dx: Array, P: Array) -> Self:
        """Return the estimate moved by an error dx."""
        return type(self)(self.kind, *moved(self.kind, self.R, self.p, dx), P)

    def corrected(self, dx: Array, P: Array) -> Self:
        """Return the estimate moved by an error dx, of which P is the covariance about this one."""
        return type(self)(self.kind, *corrected(self.kind, self.R, self.p, dx, P))

    def point_covariance(self, marker: Array) -> Array:
        """Return the covariance (3, 3) in map axes of a point of the body."""
        if self.kind == RIGHT:
            J = np.concatenate([skew(-self.p - self.R.dot(marker)), IDENTITY], axis=1)
        else:
            J = np.concatenate([self.R.dot(skew(-marker)), self.R], axis=1)
        return np.asarray(J.dot(self.P).dot(J.T))

    def estimate(self, nis: float | None = None, nis_dof: int = 0) -> Estimate:
        """Return the pose with its covariance, and the normalised innovation squared of its correction."""
        coordinates = Coordinates.RIGHT if self.kind == RIGHT else Coordinates.LEFT
        return Estimate(self.R, self.p, self.P, coordinates, nis, nis_dof)


def increment(tick: Tick) -> tuple[Array, Array]:
    """Return the tick's odometry, in the types that compiled functions take."""
    return np.asarray(tick.rotation, float), np.asarray(tick.translation, float)


def measured_message(tick: Tick) -> Message:
    """Return the measurements of a tick as a message: the odometry sample and the bearings."""
    odometry = np.concatenate([tick.angular_velocity, tick.velocity])
    return Message(extra={"odometry": odometry, "bearings": tick.bearings[tick.valid]})


class BearingMeasurements(NamedTuple):
    """The usable bearings of a frame."""

    bearings: Array  # (m, 3) unit vectors, body frame
    positions: Array  # (m, 3) of the points, as known or reported, map frame, m
    covariances: Array  # (m, 3, 3) of the points, m^2, zero for known points and without a reported covariance
    targets: NDArray[np.int64]  # (m,)
    messages: NDArray[Any]  # (m,) `Message`, None for landmarks

    def only(self, kept: NDArray[np.bool_] | slice) -> "BearingMeasurements":
        """Return the bearings of a mask (m,) or of a range."""
        return BearingMeasurements._make(part[kept] for part in self)


class LinearisedBearings(NamedTuple):
    """Linearised bearings."""

    residual: Array  # (m, 2) rad, in the tangent planes
    H: Array  # (m, 2, n) derivative of the measurement by the error
    N: Array  # (m, 2, 2) rad^2, covariance of the residuals given the own pose
    G: Array  # (m, 2, 3) derivative of the measurement by the points, map axes, rad/m
    ahead: NDArray[np.bool_]  # (m,) whether the points are ahead along the bearings, and not behind

    def only(self, kept: NDArray[np.bool_]) -> "LinearisedBearings":
        """Return the bearings of a mask (m,)."""
        return LinearisedBearings._make(part[kept] for part in self)

    def spread(self, P: Array) -> Array:
        """Return (m, 2, 2) the covariances of the innovations, given that of the error (n, n)."""
        return spread(self.H, P, self.N)

    def stacked(self) -> tuple[Array, Array, Array]:
        """Return the residual (2m,), H (2m, n) and N (2m, 2m)."""
        return self.residual.ravel(), self.H.reshape(-1, self.H.shape[-1]), dense(self.N)


def usable_bearings(tick: Tick, weighed: bool = True) -> BearingMeasurements | None:
    """Return the usable bearings of a frame, None without any; `weighed`: with the reported covariances."""
    seen = tick.usable()
    if not seen:
        return None
    covariances = np.zeros((len(seen), 3, 3))
    if weighed:
        for n, (*_, message) in enumerate(seen):
            if message is not None and message.covariance is not None:
                covariances[n] = point_covariance(message)
    targets, bearings, positions, messages = zip(*seen, strict=True)
    return BearingMeasurements(
        np.array(bearings, float), np.array(positions, float), covariances, np.array(targets), np.array(messages)
    )


def point_covariance(message: Message) -> Array:
    """Return the covariance (3, 3) in map axes of a reported position; zero if the message has none."""
    if message.covariance is None or len(message.covariance) == 3 or message.rotation is None:
        return np.zeros((3, 3)) if message.covariance is None else message.covariance[:3, :3]
    R = message.rotation
    return np.asarray(R.dot(message.covariance[3:, 3:]).dot(R.T))


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


def frame_of(tick: Tick, measured: BearingMeasurements) -> Frame:
    """Return the arguments of compiled functions for a frame."""
    return np.asarray(tick.lever_arm, float), *measured[:3], tick.noise.bearing_std**2


def linearised(pose: UncertainPose, tick: Tick, measured: BearingMeasurements) -> LinearisedBearings:
    """Linearise bearings at a pose; the points' covariances are noise, as if independent of the pose."""
    return LinearisedBearings(*linearise(pose.R, pose.p, pose.kind == RIGHT, *frame_of(tick, measured)))


@compiled(MATRIX, VECTOR, FLAG, VECTOR, MATRIX, MATRIX, MATRICES, NUMBER)
def linearise(
    R: Array, p: Array, right: bool, lever_arm: Array, bearings: Array, positions: Array, C: Array, variance: float
) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Return the fields of `LinearisedBearings`; `right`: the error is about the map's axes.

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
    """Return (2m, 2m) the block diagonal of blocks (m, 2, 2)."""
    N = np.zeros((2 * len(blocks), 2 * len(blocks)))
    for n in range(len(blocks)):
        place(N, 2 * n, 2 * n, blocks[n])
    return N


@compiled(MATRICES, MATRIX, MATRICES)
def spread(H: Array, P: Array, N: Array) -> Array:
    """Return (m, 2, 2) H P H^T + N of every bearing."""
    S = N.copy()
    for n in range(len(H)):
        HPH = congruent(H[n], P)
        for i in range(2):
            for j in range(2):
                S[n, i, j] += HPH[i, j]
    return S
