"""Errors of a pose, compiled: how odometry carries them on, how they move it, and what they are about another one.

Three of them, with theta in rad and rho in m:

- LEFT: R = Rhat Exp(theta), p = phat + Rhat rho. Over a tick of odometry (dR, dp), with E = dR^T,
  F = [E, 0; -E S(dp), E].
- INVARIANT: T = That Exp(theta, rho), the left error on SE(3). Odometry T <- T U is group affine, so that
  xi <- Ad(U^-1) xi, which is the same F, is exact for errors of any size.
- RIGHT: R = Exp(theta) Rhat, p = Exp(theta) phat + rho, the right error on SE(3), about the map's axes. F = I, and
  noise comes in by G = [Rhat, 0; S(phat) Rhat, Rhat].

Source of the last two: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE
Transactions on Automatic Control 62(4), 2017.
"""

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled import MATRIX, VECTOR, WHOLE, compiled
from coopenv.estimation.compiled_matrices import congruent, place, product, transformed
from coopenv.estimation.compiled_rotations import (
    cross_matrix,
    exp_so3,
    exp_translation,
    orthonormalised,
    right_jacobian,
)

LEFT, RIGHT, INVARIANT = 0, 1, 2


@compiled(MATRIX, VECTOR)
def transition(rotation: Array, translation: Array) -> Array:
    """Return F (6, 6) of a left error over an odometry increment (dR, dp)."""
    F, E = np.zeros((6, 6)), rotation.T
    place(F, 0, 0, E)
    place(F, 3, 3, E)
    place(F, 3, 0, product(E, cross_matrix(-translation)))
    return F


@compiled(MATRIX, VECTOR)
def from_left(R: Array, p: Array) -> Array:
    """Return G (6, 6), which turns left errors (theta, rho) at a pose into right ones."""
    G = np.zeros((6, 6))
    place(G, 0, 0, R)
    place(G, 3, 3, R)
    place(G, 3, 0, product(cross_matrix(p), R))
    return G


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, MATRIX, VECTOR, VECTOR)
def predicted(
    kind: int, R: Array, p: Array, P: Array, rotation: Array, translation: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Return R (3, 3), p (3,) in m and P (6, 6) after an odometry increment of variances (6,), rad^2 and m^2."""
    R, p = orthonormalised(product(R, rotation)), p + transformed(R, translation)
    Q = np.diag(noise)
    if kind == RIGHT:
        return R, p, P + congruent(from_left(R, p), Q)
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
