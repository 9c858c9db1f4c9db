"""The paper's decentralised Riccati observer as Warp functions.

Integrated by splitting into exact sub-flows: a rotation by the odometry, P <- F P F^T + h V, and the bearings'
correction P^-1 <- P^-1 + h C^T Q C with the matching motion of the estimate for any gain k. P stays symmetric
positive definite for every step and gain by construction.

Symbols: R = Rhat (body to map), p = phat (body frame), P over (2 lambda, p) in blocks (A, B; B^T, D),
b the unit bearing from the camera to the target in the body frame (the paper's g_ij = -b; Pi is even in it),
c the camera's place in the body, z the target's position in the map frame.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import SIXTH, cholesky6, eigen_symmetric6, identity3, join6, skew, symmetric_part


@wp.func
def accumulate_information(a: Any, b: Any, e: Any, q: Any, M11: Any, M12: Any, M22: Any, r1: Any, r2: Any):
    """Add one bearing to M = C^T Q C (blocks) and r = C^T Q (y - C_2 phat).

    C_ij = [-Pi_b S(a), Pi_b] with a = Rhat^T z (paper, definition of C_i1 and C_i2), e = a - c - phat.
    Using Pi S(a)^T = S(a)^T - b (a x b)^T no 3x3 product is needed.
    """
    m = wp.cross(a, b)
    innovation = e - wp.dot(b, e) * b
    i3 = identity3(a)
    M11 += q * (wp.dot(a, a) * i3 - wp.outer(a, a) - wp.outer(m, m))
    M12 += q * (skew(a) - wp.outer(m, b))
    M22 += q * (i3 - wp.outer(b, b))
    r1 += q * wp.cross(a, innovation)
    r2 += q * innovation
    return M11, M12, M22, r1, r2


@wp.func
def predict_covariance(E: Any, A: Any, B: Any, D: Any, v1: Any, v2: Any):
    """Return the blocks of F P F^T + diag(v1 I, v2 I), F = blkdiag(E, E); exact as V commutes with F."""
    Et = wp.transpose(E)
    i3 = identity3(E[0])
    return symmetric_part(E * A * Et) + v1 * i3, E * B * Et, symmetric_part(E * D * Et) + v2 * i3


@wp.func
def predict_pose(R: Any, p: Any, rotation: Any, translation: Any):
    """Return (R, p) after the odometry increment: R <- R dR, p <- dR^T (p + dp) (paper, eq. dot_estmate)."""
    return R * rotation, wp.transpose(rotation) * (p + translation)


@wp.func
def correct_kalman(h: Any, M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any, r1: Any, r2: Any):
    """Return (dx1, dx2, A, B, D) of the correction over h for k = 1, where it is a Kalman update.

    With P = L L^T and I + h L^T M L = G G^T: P+ = X X^T, X = L G^-T, and dx = h P+ r.
    """
    L11t = wp.transpose(L11)
    L21t = wp.transpose(L21)
    L22t = wp.transpose(L22)
    U1 = M11 * L11 + M12 * L21
    U2 = wp.transpose(M12) * L11 + M22 * L21
    N11 = symmetric_part(L11t * U1 + L21t * U2) * h + identity3(r1)
    N12 = wp.transpose(L22t * U2) * h
    N22 = symmetric_part(L22t * M22 * L22) * h + identity3(r1)
    _, G21, _, I11, I22 = cholesky6(N11, N12, N22)
    H11 = wp.transpose(I11)
    H22 = wp.transpose(I22)
    H12 = -H11 * wp.transpose(G21) * H22
    X11 = L11 * H11
    X12 = L11 * H12
    X21 = L21 * H11
    X22 = L21 * H12 + L22 * H22
    A = X11 * wp.transpose(X11) + X12 * wp.transpose(X12)
    B = X11 * wp.transpose(X21) + X12 * wp.transpose(X22)
    D = X21 * wp.transpose(X21) + X22 * wp.transpose(X22)
    return h * (A * r1 + B * r2), h * (wp.transpose(B) * r1 + D * r2), A, B, D


@wp.func
def gain_factor(k: Any, m: Any, h: Any):
    """Return (1 - (1 + m h)^-k) / m, the exact flow of a mode of information m over h; k h as m -> 0."""
    growth = wp.log(m * h + type(m)(1.0))
    if m * h < type(m)(1.0e-4):
        growth = m * h * (type(m)(1.0) - m * h * (type(m)(0.5) - m * h / type(m)(3.0)))
    x = k * growth
    decayed = type(m)(1.0) - wp.exp(-x)
    if x < type(m)(1.0e-3):
        decayed = x * (type(m)(1.0) - x * (type(m)(0.5) - x * (type(m)(SIXTH) - x / type(m)(24.0))))
    if m * h < type(m)(1.0e-30):
        return k * h
    return decayed / m


@wp.func
def correction_modes(M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any):
    """Return (T, m): T = L U and the spectrum m (diagonal) of L^T M L = U diag(m) U^T."""
    L = join6(L11, type(L11)(), L21, L22)
    M = join6(M11, M12, wp.transpose(M12), M22)
    spectrum, U = eigen_symmetric6(symmetric_part(wp.transpose(L) * M * L))
    return L * U, spectrum


@wp.func
def correct_modes(k: Any, h: Any, T: Any, spectrum: Any, r1: Any, r2: Any):
    """Return (dx1, dx2) = T diag((1 - (1 + m h)^-k) / m) T^T r, the flow of the estimate for any gain k."""
    dx1 = type(r1)()
    dx2 = type(r2)()
    for i in range(6):
        m = wp.max(spectrum[i, i], type(k)(0.0))
        along = type(k)(0.0)
        for j in range(3):
            along += T[j, i] * r1[j] + T[j + 3, i] * r2[j]
        along *= gain_factor(k, m, h)
        for j in range(3):
            dx1[j] += T[j, i] * along
            dx2[j] += T[j + 3, i] * along
    return dx1, dx2


@wp.func
def covariance_modes(h: Any, T: Any, spectrum: Any):
    """Return P+ = T diag(1 / (1 + m h)) T^T; its flow does not depend on k."""
    scaled = T
    for i in range(6):
        m = wp.max(spectrum[i, i], type(h)(0.0))
        root = wp.sqrt(type(h)(1.0) / (type(h)(1.0) + m * h))
        for j in range(6):
            scaled[j, i] = T[j, i] * root
    return symmetric_part(scaled * wp.transpose(scaled))
