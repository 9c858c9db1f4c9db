"""What the interfaces of a world read after each decision: how good estimates are, rewards, flags that end episodes."""

from functools import cache
from typing import Any

import warp as wp

from coopenv.estimation.so3 import rotation_angle
from coopenv.world.collision import UNDER_WAY
from coopenv.world.device_function import device_function
from coopenv.world.precision import Precision
from coopenv.world.quality import (
    cholesky_of,
    gramian_smallest_eigenvalue,
    log_determinant,
    normalised_error_squared,
    observer_error,
    position_variance,
    targets_in_view,
)
from coopenv.world.records import array
from coopenv.world.saved_state import FLAG, NUMBER, whole

DEGREES = wp.constant(57.29577951308232)


@cache
def results_struct(p: Precision) -> Any:
    """Return the Warp struct of step results in one precision."""
    scalar = p.scalar

    @wp.struct
    class StepResults:
        """W worlds, N vehicles, D observation entries, K reward terms."""

        observation: array("WND", wp.float32)
        terms: array("WNK", wp.float32)
        reward: array("WN", wp.float32)  # 0 for vehicles that had ended before, and right after a reset
        alive: array("WN", wp.bool)  # had not ended before this step
        terminated: array("WN", wp.bool)  # ended in this step
        truncated: array("WN", wp.bool)  # the world is over and this vehicle has not just terminated
        over: array("W", wp.int32)  # 1: at the horizon, or every vehicle has ended
        position_error: array("WN", scalar)  # m
        orientation_error: array("WN", scalar)  # deg
        nees: array("WN", scalar)
        log_determinant: array("WN", scalar)  # of P
        position_std: array("WN", scalar)  # m, sqrt of the trace of the position's covariance in the map
        gramian_min_eigenvalue: array("WN", scalar)
        targets_in_view: array("WN", wp.int32)
        last_way: array("WN", scalar)  # m left to the goal, at the last step
        last_ended: array("WN", wp.int32)  # at the last step
        last_tick: array("WN", wp.int32)  # of the last step
        last_arrivals: array("WN", wp.int32)  # at the last step
        last_log_determinant: array("WN", scalar)  # at the last step
        furthest: array("WN", scalar)  # m, the farthest along its way that the vehicle has believed to be

    return StepResults


MEMORY = {
    "last_way": NUMBER._replace(of_truth=True),
    "last_ended": whole(-1, "last_outcome"),
    "last_arrivals": whole(0, 10**8),
    "last_tick": whole(0, "tick"),
    "last_log_determinant": NUMBER,
    "furthest": NUMBER,
    "over": FLAG,
}
"""Fields that carry over from one step to the next, and what a saved state may hold of them."""


@device_function
def remember(state: Any, results: Any, world: int, vehicle: int, way: Any, furthest: Any, tick: int):
    """Keep what the next step compares with; `assess` comes before."""
    results.last_arrivals[world, vehicle] = state.arrivals[world, vehicle]
    results.last_log_determinant[world, vehicle] = results.log_determinant[world, vehicle]
    results.furthest[world, vehicle] = furthest
    results.last_way[world, vehicle] = way
    results.last_ended[world, vehicle] = state.ended[world, vehicle]
    results.last_tick[world, vehicle] = tick


@device_function
def assess(model: Any, state: Any, results: Any, world: int, vehicle: int):
    """Compare the estimate with the truth and with what it believes of itself."""
    agent = model.landmarks + vehicle
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    R_hat = state.estimate_rotation[world, vehicle]
    p_hat = state.estimate_position[world, vehicle]
    angle = rotation_angle(wp.transpose(R_hat) * R)
    results.position_error[world, vehicle] = wp.length(position - R_hat * p_hat)
    results.orientation_error[world, vehicle] = angle * type(angle)(DEGREES)
    I11, L21, I22 = cholesky_of(state.covariance[world, vehicle])
    e1, e2 = observer_error(R, position, R_hat, p_hat)
    results.nees[world, vehicle] = normalised_error_squared(I11, L21, I22, e1, e2)
    results.log_determinant[world, vehicle] = log_determinant(I11, I22)
    results.position_std[world, vehicle] = wp.sqrt(position_variance(state.covariance[world, vehicle], p_hat))
    results.gramian_min_eigenvalue[world, vehicle] = gramian_smallest_eigenvalue(model, state, world, vehicle)
    results.targets_in_view[world, vehicle] = targets_in_view(model, state, world, vehicle)


@device_function
def is_over(model: Any, state: Any, world: int) -> bool:
    """Return whether a world is at its horizon, without further ticks, or has no vehicle under way."""
    if state.tick[world] >= model.horizon_ticks or state.exhausted[world] != 0:
        return True
    for vehicle in range(model.vehicles):
        if state.ended[world, vehicle] == UNDER_WAY:
            return False
    return True


@device_function
def set_flags(results: Any, world: int, vehicle: int, ended: int, over: bool, horizon_ticks: int):
    """Write who was under way, who has just ended, and whether the world is over."""
    # Over since the last step: nothing more is earned before a reset (each vehicle reads its own memory only).
    waiting = results.last_tick[world, vehicle] >= horizon_ticks
    alive = results.last_ended[world, vehicle] == UNDER_WAY and not waiting
    terminated = alive and ended != UNDER_WAY
    results.alive[world, vehicle] = alive
    results.terminated[world, vehicle] = terminated
    results.truncated[world, vehicle] = over and not terminated
    if vehicle == 0:
        results.over[world] = wp.where(over, 1, 0)
