"""A pose with the covariance of its error: kinds of errors, and their propagation by odometry and corrections."""

from typing import NamedTuple, Self

import numpy as np

from coopenv.estimation.compiled import (
    MATRIX,
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
from coopenv.observers.contract import Estimate, Tick

LEFT, RIGHT, INVARIANT = 0, 1, 2


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

    def point_derivative(self, marker: Array) -> Array:
        """Return the derivative (3, 6) of a point of the body in map axes by the error."""
        if self.kind == RIGHT:
            return np.concatenate([skew(-self.p - self.R.dot(marker)), IDENTITY], axis=1)
        return np.concatenate([self.R.dot(skew(-marker)), self.R], axis=1)

    def point_covariance(self, marker: Array) -> Array:
        """Return the covariance (3, 3) in map axes of a point of the body."""
        J = self.point_derivative(marker)
        return np.asarray(J.dot(self.P).dot(J.T))

    def marker_covariance(self, marker: Array) -> Array:
        """Return the covariance (6, 6) of the left error of the pose of a point of the body."""
        to_marker = adjoint(np.eye(3), -marker)
        if self.kind == RIGHT:
            to_marker = to_marker @ np.linalg.inv(adjoint(self.R, self.p))
        return congruent(to_marker, self.P)

    def estimate(self, nis: float | None = None, nis_dof: int = 0) -> Estimate:
        """Return the pose with its covariance, and the normalised innovation squared of its correction."""
        coordinates = Coordinates.RIGHT if self.kind == RIGHT else Coordinates.LEFT
        return Estimate(self.R, self.p, self.P, coordinates, nis, nis_dof)


def increment(tick: Tick) -> tuple[Array, Array]:
    """Return the tick's odometry, in the types that compiled functions take."""
    return np.asarray(tick.rotation, float), np.asarray(tick.translation, float)
