"""Odometry alone in the world's kernels: the lower reference, with the covariance that odometry's noise makes.

It is `coopenv.observers.single_frame` on the state of the Riccati observer, whose P is over e = (2 lambda, p - phat),
positions in the body frame. An error (theta, rho) in LEFT coordinates is there (theta, rho + S(phat) theta).
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, join6, sheared, symmetric_part
from coopenv.estimation.so3 import orthonormalise, skew
from coopenv.observers.riccati.kernels import predict
from coopenv.world.embedded import Embedded, send_nothing
from coopenv.world.v2x import start_covariance


@wp.func
def start(model: Any, state: Any, memory: Any, world: int, vehicle: int):
    """Start with the covariance of the initial estimate, in the coordinates of the state."""
    P = sheared(start_covariance(model, state, world, vehicle), skew(wp.vec3d(state.estimate_position[world, vehicle])))
    state.covariance[world, vehicle] = type(state.covariance[world, vehicle])(symmetric_part(P))


@wp.func
def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
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


DEAD_RECKONING = Embedded("dead_reckoning", estimate, start, send_nothing, fused=True)
