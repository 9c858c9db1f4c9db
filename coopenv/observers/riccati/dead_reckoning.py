"""Odometry alone in the world's kernels: the lower reference, with the covariance that odometry's noise makes.

It is `coopenv.observers.dead_reckoning` on the state of the Riccati observer, whose P is over e = (2 lambda, p - phat),
positions in the body frame. An error (theta, rho) in LEFT coordinates is there (theta, rho + S(phat) theta).
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, join6, symmetric_part
from coopenv.estimation.so3 import orthonormalise, skew
from coopenv.observers.riccati import equations
from coopenv.world.embedded import Embedded, send_nothing
from coopenv.world.faults import start_covariance


@wp.func
def start(model: Any, state: Any, memory: Any, world: int, vehicle: int):
    """Start with the covariance of the initial estimate, in the coordinates of the state."""
    P = start_covariance(model, state, world, vehicle)
    S = skew(wp.vec3d(state.estimate_position[world, vehicle]))
    A, B = block3(P, 0, 0), block3(P, 0, 3)
    SA, SB = S * A, S * B
    D = block3(P, 3, 3) + SB + wp.transpose(SB) + SA * wp.transpose(S)
    cross = B + wp.transpose(SA)
    whole = join6(A, cross, wp.transpose(cross), symmetric_part(D))
    state.covariance[world, vehicle] = type(state.covariance[world, vehicle])(whole)


@wp.func
def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Run one tick: the estimate follows odometry, and P grows by the noise of odometry."""
    rotation = state.increment_rotation[world, vehicle]
    R, p = equations.predict_pose(
        state.estimate_rotation[world, vehicle],
        state.estimate_position[world, vehicle],
        rotation,
        state.increment_translation[world, vehicle],
    )
    noise = model.noise[vehicle]
    density = type(noise.velocity)(model.odometry_period * now.period)
    turn = noise.angular_velocity * noise.angular_velocity * density
    step = noise.velocity * noise.velocity * density
    P = state.covariance[world, vehicle]
    E = wp.transpose(rotation)
    A, B, D = equations.predict_covariance(E, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3), turn, step)
    St = wp.transpose(skew(p))
    B = B + turn * St
    D = D + turn * symmetric_part(wp.transpose(St) * St)
    state.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D)
    state.estimate_position[world, vehicle] = p
    # Products of rotations drift by rounding; once per tick is enough to keep Rhat a rotation.
    state.estimate_rotation[world, vehicle] = orthonormalise(R)
    if now.due:
        state.corrected_tick[world, vehicle] = now.tick


DEAD_RECKONING = Embedded("dead_reckoning", estimate, start, send_nothing)
