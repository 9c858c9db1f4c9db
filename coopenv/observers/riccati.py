"""The paper's decentralised Riccati observer on the measurements of one vehicle, and dead reckoning on its state.

Source: Wong et al., Beyond Line-of-Sight: Cooperative Localization Using Vision and V2X Communication. P is over
(2 lambda, p). It is no covariance: V and Q are gains. The observer reads bearings, odometry increments and received
messages only. Truth enters through the known positions of landmarks alone.

Dead reckoning is the lower reference: odometry alone, with the covariance that the odometry's noise produces. Its P is
over e = (2 lambda, p - phat), positions in the body frame. An error (theta, rho) in LEFT coordinates is
(theta, rho + S(phat) theta) there.

Integrated by splitting into exact sub-flows: a rotation by the odometry, P <- F P F^T + h V, and the bearings'
correction P^-1 <- P^-1 + h C^T Q C with the matching motion of the estimate for any gain k. P stays symmetric
positive definite for every step and gain by construction.

Symbols: R = Rhat (body to map), p = phat (body frame), P over (2 lambda, p) in blocks (A, B; B^T, D),
b the unit bearing from the camera to the target in the body frame (the paper's g_ij = -b; Pi is even in it),
c the camera's place in the body, z the target's position in the map frame.
"""

from dataclasses import replace
from typing import Any

import warp as wp

from coopenv.estimation.linalg import (
    SIXTH,
    block3,
    cholesky6,
    eigen_symmetric6,
    exp_so3,
    identity3,
    join6,
    orthonormalise,
    sheared,
    skew,
    symmetric_part,
)
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import POSITION, KernelObserver
from coopenv.world.camera import body_bearing
from coopenv.world.embedded import Embedded, send_nothing, start_nothing
from coopenv.world.nearby import agent_of, entry_at, entry_count
from coopenv.world.quality import known_position, usable
from coopenv.world.v2x import start_covariance
from coopenv.world.warp_internals import device_function


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


MOST_SUBSTEPS = wp.constant(200)  # re-linearisations per tick; the last one takes what remains of the tick


@device_function
def information(model: Any, state: Any, world: int, vehicle: int, tick: int, R: Any, p: Any):
    """Return the blocks of M = C^T Q C and r = C^T Q (y - C_2 phat) over all usable targets at (Rhat, phat)."""
    M11 = type(R)()
    M12 = type(R)()
    M22 = type(R)()
    r1 = type(p)()
    r2 = type(p)()
    kept = model.kept
    for n in range(entry_count(model, state, world, vehicle)):
        entry = entry_at(model, state, kept, world, vehicle, n)
        target = agent_of(state, kept, world, vehicle, entry)
        if usable(model, state, world, vehicle, entry, target, tick):
            b = body_bearing(model, state, world, vehicle, entry)
            a = wp.transpose(R) * known_position(model, state, world, vehicle, entry, target)
            e = a - model.camera[vehicle].position - p
            q = model.observer.q[target]
            M11, M12, M22, r1, r2 = accumulate_information(a, b, e, q, M11, M12, M22, r1, r2)
    return M11, M12, M22, r1, r2


@wp.func
def predict(state: Any, world: int, vehicle: int, v1: Any, v2: Any):
    """Carry the estimate and P (6x6) through one tick of odometry.

    `v1` and `v2`, per axis, are what its noise adds to the blocks of P of 2 lambda (rad^2) and of the position (m^2).
    """
    rotation = state.increment_rotation[world, vehicle]
    R, p = predict_pose(
        state.estimate_rotation[world, vehicle],
        state.estimate_position[world, vehicle],
        rotation,
        state.increment_translation[world, vehicle],
    )
    P = state.covariance[world, vehicle]
    E = wp.transpose(rotation)
    A, B, D = predict_covariance(E, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3), v1, v2)
    state.estimate_rotation[world, vehicle] = R
    state.estimate_position[world, vehicle] = p
    state.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D)


@wp.func
def shrink(turn: Any, limit: Any):
    """Return the factor by which to shorten a correction that would turn the attitude too far."""
    return wp.clamp(type(turn)(0.9) * limit / turn, type(turn)(0.1), type(turn)(0.9))


@wp.func
def kalman_step(
    k: Any, h: Any, limit: Any, last: bool, M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any, r1: Any, r2: Any
):
    """Return (h, dx1, dx2, A, B, D) of one sub-step for k = 1, P = L L^T.

    h is shortened until the attitude turns by no more than `limit`, but not in the `last` sub-step.
    """
    taken = h
    dx1, dx2, A, B, D = correct_kalman(taken, M11, M12, M22, L11, L21, L22, r1, r2)
    while wp.length(dx1) > limit and not last:
        taken = taken * shrink(wp.length(dx1), limit)
        dx1, dx2, A, B, D = correct_kalman(taken, M11, M12, M22, L11, L21, L22, r1, r2)
    return taken, dx1, dx2, A, B, D


@wp.func
def modal_step(
    k: Any, h: Any, limit: Any, last: bool, M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any, r1: Any, r2: Any
):
    """Return the result of `kalman_step` for any gain k, through the modes of L^T M L."""
    taken = h
    T, spectrum = correction_modes(M11, M12, M22, L11, L21, L22)
    dx1, dx2 = correct_modes(k, taken, T, spectrum, r1, r2)
    while wp.length(dx1) > limit and not last:
        taken = taken * shrink(wp.length(dx1), limit)
        dx1, dx2 = correct_modes(k, taken, T, spectrum, r1, r2)
    P = covariance_modes(taken, T, spectrum)
    return taken, dx1, dx2, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3)


@wp.func
def gain_step(
    k: Any, h: Any, limit: Any, last: bool, M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any, r1: Any, r2: Any
):
    """Return the result of `kalman_step`, by a shorter computation where k = 1."""
    if k == type(k)(1.0):
        taken, dx1, dx2, A, B, D = kalman_step(k, h, limit, last, M11, M12, M22, L11, L21, L22, r1, r2)
    else:
        taken, dx1, dx2, A, B, D = modal_step(k, h, limit, last, M11, M12, M22, L11, L21, L22, r1, r2)
    return taken, dx1, dx2, A, B, D


def make_estimate(step: Any) -> Any:
    """Return the Warp function of one tick of the observer, whose corrections are made of `step`s."""

    @device_function
    def correct(model: Any, state: Any, world: int, vehicle: int, tick: int, duration: Any):
        """Let the bearings act for `duration`, re-linearising whenever the attitude has turned by max_turn."""
        R = state.estimate_rotation[world, vehicle]
        p = state.estimate_position[world, vehicle]
        P = state.covariance[world, vehicle]
        A = block3(P, 0, 0)
        B = block3(P, 0, 3)
        D = block3(P, 3, 3)
        remaining = duration
        substeps = int(0)
        while remaining > duration * type(duration)(1.0e-9):
            M11, M12, M22, r1, r2 = information(model, state, world, vehicle, tick, R, p)
            L11, L21, L22, _, _ = cholesky6(A, B, D)
            substeps += 1
            last = substeps >= MOST_SUBSTEPS
            limit = model.observer.max_turn
            k = model.observer.k[vehicle]
            h, dx1, dx2, A, B, D = step(k, remaining, limit, last, M11, M12, M22, L11, L21, L22, r1, r2)
            R = R * exp_so3(dx1)
            p = p + dx2
            remaining = remaining - h
        # A correction that overflows the precision (float32 far from the origin, absurd gains) is left out.
        if wp.isfinite(wp.dot(p, p) + wp.trace(A) + wp.trace(D) + wp.trace(R)):
            state.estimate_rotation[world, vehicle] = R
            state.estimate_position[world, vehicle] = p
            state.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D)

    @device_function
    def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
        """Run one tick of the observer of one vehicle: predict, and correct when its rate says so."""
        dt = type(model.observer.max_turn)(now.period)
        predict(state, world, vehicle, model.observer.v1 * dt, model.observer.v2 * dt)
        if now.due:
            unit = type(model.observer.max_turn)(model.camera_period)
            duration = unit * type(unit)(now.tick - state.corrected_tick[world, vehicle])
            correct(model, state, world, vehicle, now.tick, duration)
            state.corrected_tick[world, vehicle] = now.tick
        state.estimate_rotation[world, vehicle] = orthonormalise(state.estimate_rotation[world, vehicle])

    return estimate


def fitted(model: Any) -> Embedded:
    """Return the variant that the gains of a model need."""
    return KALMAN if (model.observer.k.numpy() == 1.0).all() else RICCATI


RICCATI = Embedded("riccati", make_estimate(gain_step), start_nothing, send_nothing, fit=fitted, messages=POSITION)
KALMAN = replace(RICCATI, name="riccati_kalman", estimate=make_estimate(kalman_step), fused=True)
"""Variant with every gain k equal to 1: the eigenvalues that other gains need are not even compiled."""


def riccati(setup: Setup) -> Observer:
    """The paper's observer, with the scenario's gains."""
    return KernelObserver(RICCATI, setup)


@wp.func
def start_dead_reckoning(model: Any, state: Any, memory: Any, world: int, vehicle: int):
    """Start with the covariance of the initial estimate, in the coordinates of the state."""
    P = sheared(start_covariance(model, state, world, vehicle), skew(wp.vec3d(state.estimate_position[world, vehicle])))
    state.covariance[world, vehicle] = type(state.covariance[world, vehicle])(symmetric_part(P))


@wp.func
def estimate_dead_reckoning(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Run one tick: the estimate follows odometry, and P grows by the noise of odometry."""
    noise = model.noise[vehicle]
    density = type(noise.velocity)(model.odometry_period * now.period)
    turn = noise.angular_velocity * noise.angular_velocity * density
    predict(state, world, vehicle, turn, noise.velocity * noise.velocity * density)
    S = skew(state.estimate_position[world, vehicle])
    P = state.covariance[world, vehicle]
    B = block3(P, 0, 3) - turn * S
    D = block3(P, 3, 3) - turn * symmetric_part(S * S)
    state.covariance[world, vehicle] = join6(block3(P, 0, 0), B, wp.transpose(B), D)
    # Products of rotations drift by rounding; once per tick is enough to keep Rhat a rotation.
    state.estimate_rotation[world, vehicle] = orthonormalise(state.estimate_rotation[world, vehicle])
    if now.due:
        state.corrected_tick[world, vehicle] = now.tick


DEAD_RECKONING = Embedded("dead_reckoning", estimate_dead_reckoning, start_dead_reckoning, send_nothing)
