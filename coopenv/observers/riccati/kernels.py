"""The paper's decentralised Riccati observer on the measurements of one vehicle, and dead reckoning on its state.

Source: Wong et al., Beyond Line-of-Sight: Cooperative Localization Using Vision and V2X Communication. P is over
(2 lambda, p). It is no covariance: V and Q are gains. The observer reads bearings, odometry increments and received
messages only. Truth enters through the known positions of landmarks alone.

Dead reckoning is the lower reference: odometry alone, with the covariance that the odometry's noise produces. Its P is
over e = (2 lambda, p - phat), positions in the body frame. An error (theta, rho) in LEFT coordinates is
(theta, rho + S(phat) theta) there.
"""

from dataclasses import replace
from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, exp_so3, join6, orthonormalise, sheared, skew, symmetric_part
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import POSITION, KernelObserver
from coopenv.observers.riccati import equations
from coopenv.world.camera import body_bearing
from coopenv.world.embedded import Embedded, send_nothing, start_nothing
from coopenv.world.quality import known_position, usable
from coopenv.world.v2x import start_covariance

MOST_SUBSTEPS = wp.constant(200)  # re-linearisations per tick; the last one takes what remains of the tick


@wp.func
def information(model: Any, state: Any, world: int, vehicle: int, tick: int, R: Any, p: Any):
    """Return the blocks of M = C^T Q C and r = C^T Q (y - C_2 phat) over all usable targets at (Rhat, phat)."""
    M11 = type(R)()
    M12 = type(R)()
    M22 = type(R)()
    r1 = type(p)()
    r2 = type(p)()
    for n in range(model.target_count[vehicle]):
        target = model.targets[vehicle, n]
        if usable(model, state, world, vehicle, target, tick):
            b = body_bearing(model, state, world, vehicle, target)
            a = wp.transpose(R) * known_position(model, state, world, vehicle, target)
            e = a - model.camera[vehicle].position - p
            M11, M12, M22, r1, r2 = equations.accumulate_information(
                a, b, e, model.observer.q[target], M11, M12, M22, r1, r2
            )
    return M11, M12, M22, r1, r2


@wp.func
def predict(state: Any, world: int, vehicle: int, v1: Any, v2: Any):
    """Carry the estimate and P (6x6) through one tick of odometry.

    `v1` and `v2`, per axis, are what its noise adds to the blocks of P of 2 lambda (rad^2) and of the position (m^2).
    """
    rotation = state.increment_rotation[world, vehicle]
    R, p = equations.predict_pose(
        state.estimate_rotation[world, vehicle],
        state.estimate_position[world, vehicle],
        rotation,
        state.increment_translation[world, vehicle],
    )
    P = state.covariance[world, vehicle]
    E = wp.transpose(rotation)
    A, B, D = equations.predict_covariance(E, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3), v1, v2)
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
    dx1, dx2, A, B, D = equations.correct_kalman(taken, M11, M12, M22, L11, L21, L22, r1, r2)
    turn = wp.length(dx1)
    while turn > limit and not last:
        taken = taken * shrink(turn, limit)
        dx1, dx2, A, B, D = equations.correct_kalman(taken, M11, M12, M22, L11, L21, L22, r1, r2)
        turn = wp.length(dx1)
    return taken, dx1, dx2, A, B, D


@wp.func
def modal_step(
    k: Any, h: Any, limit: Any, last: bool, M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any, r1: Any, r2: Any
):
    """Return what `kalman_step` does for any gain k, through the modes of L^T M L."""
    taken = h
    T, spectrum = equations.correction_modes(M11, M12, M22, L11, L21, L22)
    dx1, dx2 = equations.correct_modes(k, taken, T, spectrum, r1, r2)
    turn = wp.length(dx1)
    while turn > limit and not last:
        taken = taken * shrink(turn, limit)
        dx1, dx2 = equations.correct_modes(k, taken, T, spectrum, r1, r2)
        turn = wp.length(dx1)
    P = equations.covariance_modes(taken, T, spectrum)
    return taken, dx1, dx2, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3)


@wp.func
def gain_step(
    k: Any, h: Any, limit: Any, last: bool, M11: Any, M12: Any, M22: Any, L11: Any, L21: Any, L22: Any, r1: Any, r2: Any
):
    """Return what `kalman_step` does, by the shorter way where k = 1."""
    if k == type(k)(1.0):
        taken, dx1, dx2, A, B, D = kalman_step(k, h, limit, last, M11, M12, M22, L11, L21, L22, r1, r2)
    else:
        taken, dx1, dx2, A, B, D = modal_step(k, h, limit, last, M11, M12, M22, L11, L21, L22, r1, r2)
    return taken, dx1, dx2, A, B, D


def make_estimate(step: Any) -> Any:
    """Return the Warp function of one tick of the observer, whose corrections are made of `step`s."""

    @wp.func
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

    @wp.func
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


RICCATI = Embedded(
    "riccati", make_estimate(gain_step), start_nothing, send_nothing, fit=fitted, messages=POSITION, fused=True
)
KALMAN = replace(RICCATI, name="riccati_kalman", estimate=make_estimate(kalman_step))
"""Where every gain k is 1: the eigenvalues that other gains need are not even compiled."""


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


DEAD_RECKONING = Embedded("dead_reckoning", estimate_dead_reckoning, start_dead_reckoning, send_nothing, fused=True)
