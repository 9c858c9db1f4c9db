"""The paper's Riccati observer on the measurements of one vehicle.

It reads bearings, odometry increments and received messages only; truth enters through landmarks alone, whose
positions are known to everybody.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, join6
from coopenv.estimation.so3 import exp_so3, identity3, orthonormalise
from coopenv.observers.riccati.equations import (
    accumulate_information,
    correct_kalman,
    correct_modes,
    correction_modes,
    covariance_modes,
    predict_covariance,
    predict_pose,
)
from coopenv.world.embedded import Embedded, send_nothing, start_nothing
from coopenv.world.gramian import known_position, usable
from coopenv.world.rates import correction_due

MOST_SUBSTEPS = wp.constant(200)
"""Re-linearisations per tick; the last one takes what remains of the tick."""


@wp.func
def information(model: Any, state: Any, world: int, vehicle: int, tick: int, R: Any, p: Any):
    """Return the blocks of M = C^T Q C and r = C^T Q (y - C_2 phat) over all usable targets at (Rhat, phat)."""
    o = p - p
    M11 = R - R
    M12 = R - R
    M22 = R - R
    r1 = o
    r2 = o
    for n in range(model.target_count[vehicle]):
        target = model.targets[vehicle, n]
        if usable(model, state, world, vehicle, target, tick):
            b = model.camera.rotation * state.bearing[world, vehicle, target]
            a = wp.transpose(R) * known_position(model, state, world, vehicle, target)
            e = a - model.camera.position - p
            M11, M12, M22, r1, r2 = accumulate_information(a, b, e, model.observer.q[target], M11, M12, M22, r1, r2)
    return M11, M12, M22, r1, r2


@wp.func
def predict(model: Any, state: Any, world: int, vehicle: int, dt: Any):
    """Carry the estimate and P through one tick of odometry."""
    rotation = state.increment_rotation[world, vehicle]
    R, p = predict_pose(
        state.estimate_rotation[world, vehicle],
        state.estimate_position[world, vehicle],
        rotation,
        state.increment_translation[world, vehicle],
    )
    P = state.covariance[world, vehicle]
    E = wp.transpose(rotation)
    o = R - R
    A, B, D = predict_covariance(
        E,
        block3(P, 0, 0, o),
        block3(P, 0, 3, o),
        block3(P, 3, 3, o),
        model.observer.v1 * dt,
        model.observer.v2 * dt,
    )
    state.estimate_rotation[world, vehicle] = R
    state.estimate_position[world, vehicle] = p
    state.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D, P - P)


@wp.func
def shrink(turn: Any, limit: Any):
    """Return the factor by which to shorten a correction that would turn the attitude too far."""
    return wp.clamp(type(turn)(0.9) * limit / turn, type(turn)(0.1), type(turn)(0.9))


@wp.func
def correct(model: Any, state: Any, world: int, vehicle: int, tick: int, duration: Any):
    """Let the bearings act for `duration`, re-linearising whenever the attitude has turned by max_turn."""
    R = state.estimate_rotation[world, vehicle]
    p = state.estimate_position[world, vehicle]
    P = state.covariance[world, vehicle]
    k = model.observer.k[vehicle]
    limit = model.observer.max_turn
    one = type(duration)(1.0)
    zero6 = P - P
    A = block3(P, 0, 0, R - R)
    B = block3(P, 0, 3, R - R)
    D = block3(P, 3, 3, R - R)
    remaining = duration
    substeps = int(0)
    while remaining > duration * type(duration)(1.0e-9):
        M11, M12, M22, r1, r2 = information(model, state, world, vehicle, tick, R, p)
        L11, L21, L22, _, _ = cholesky6(A, B, D)
        h = remaining
        substeps += 1
        if k == one:
            dx1, dx2, A1, B1, D1 = correct_kalman(h, M11, M12, M22, L11, L21, L22, r1, r2)
            turn = wp.length(dx1)
            while turn > limit and substeps < MOST_SUBSTEPS:
                h = h * shrink(turn, limit)
                dx1, dx2, A1, B1, D1 = correct_kalman(h, M11, M12, M22, L11, L21, L22, r1, r2)
                turn = wp.length(dx1)
        else:
            identity6 = join6(identity3(p), R - R, R - R, identity3(p), zero6)
            T, spectrum = correction_modes(M11, M12, M22, L11, L21, L22, zero6, identity6)
            dx1, dx2 = correct_modes(k, h, T, spectrum, r1, r2)
            turn = wp.length(dx1)
            while turn > limit and substeps < MOST_SUBSTEPS:
                h = h * shrink(turn, limit)
                dx1, dx2 = correct_modes(k, h, T, spectrum, r1, r2)
                turn = wp.length(dx1)
            P1 = covariance_modes(h, T, spectrum)
            A1 = block3(P1, 0, 0, R - R)
            B1 = block3(P1, 0, 3, R - R)
            D1 = block3(P1, 3, 3, R - R)
        R = R * exp_so3(dx1)
        p = p + dx2
        A = A1
        B = B1
        D = D1
        remaining = remaining - h
    # A correction that overflows the precision (float32 far from the origin, absurd gains) is left out.
    if wp.isfinite(wp.dot(p, p) + wp.trace(A) + wp.trace(D) + wp.trace(R)):
        state.estimate_rotation[world, vehicle] = R
        state.estimate_position[world, vehicle] = p
        state.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D, zero6)


@wp.func
def dead_reckon(model: Any, state: Any, memory: Any, world: int, vehicle: int, tick: int):
    """Run one tick without correction: the estimate follows odometry, P grows."""
    predict(model, state, world, vehicle, type(model.observer.max_turn)(model.camera_period))
    if correction_due(model, tick):
        state.corrected_tick[world, vehicle] = tick
    # Products of rotations drift by rounding; once per tick is enough to keep Rhat a rotation.
    state.estimate_rotation[world, vehicle] = orthonormalise(state.estimate_rotation[world, vehicle])


@wp.func
def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, tick: int):
    """Run one tick of the observer of one vehicle: predict, and correct when its rate says so."""
    dt = type(model.observer.max_turn)(model.camera_period)
    predict(model, state, world, vehicle, dt)
    if correction_due(model, tick):
        duration = dt * type(dt)(tick - state.corrected_tick[world, vehicle])
        correct(model, state, world, vehicle, tick, duration)
        state.corrected_tick[world, vehicle] = tick
    state.estimate_rotation[world, vehicle] = orthonormalise(state.estimate_rotation[world, vehicle])


RICCATI = Embedded("riccati", estimate, start_nothing, send_nothing)
DEAD_RECKONING = Embedded("dead_reckoning", dead_reckon, start_nothing, send_nothing)
