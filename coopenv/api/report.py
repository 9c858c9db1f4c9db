"""What the faces of a world read after each decision step, computed for all worlds and vehicles in one launch."""

from functools import cache
from typing import Any

import warp as wp

from coopenv.api.observation import write_observation
from coopenv.api.rewards import TERMS, weigh, write_terms
from coopenv.estimation.so3 import rotation_angle
from coopenv.estimation.trajectory import Outcome
from coopenv.world.collision import UNDER_WAY, goal_distance
from coopenv.world.precision import Precision
from coopenv.world.quality import (
    cholesky_of,
    gramian_smallest_eigenvalue,
    log_determinant,
    normalised_error_squared,
    observer_error,
    targets_in_view,
)
from coopenv.world.saved_state import FLAG, NUMBER, whole

DEGREES = wp.constant(57.29577951308232)


@cache
def report_struct(p: Precision) -> Any:
    """Return the Warp struct of a report in one precision."""
    scalar = p.scalar

    @wp.struct
    class Report:
        """W worlds, N vehicles, D observation entries, K reward terms."""

        observation: wp.array3d(dtype=wp.float32)  # (W, N, D)
        terms: wp.array3d(dtype=wp.float32)  # (W, N, K)
        reward: wp.array2d(dtype=wp.float32)  # (W, N) 0 for vehicles that had ended before, and right after a reset
        alive: wp.array2d(dtype=wp.bool)  # (W, N) had not ended before this step
        terminated: wp.array2d(dtype=wp.bool)  # (W, N) arrived or collided in this step
        truncated: wp.array2d(dtype=wp.bool)  # (W, N) the world is over and this vehicle has not just terminated
        over: wp.array(dtype=wp.int32)  # (W,) 1: at the horizon, or every vehicle has ended
        position_error: wp.array2d(dtype=scalar)  # (W, N) m
        orientation_error: wp.array2d(dtype=scalar)  # (W, N) deg
        nees: wp.array2d(dtype=scalar)  # (W, N)
        log_determinant: wp.array2d(dtype=scalar)  # (W, N) of P
        gramian_min_eigenvalue: wp.array2d(dtype=scalar)  # (W, N)
        targets_in_view: wp.array2d(dtype=wp.int32)  # (W, N)
        last_goal_distance: wp.array2d(dtype=scalar)  # (W, N) m, at the last report
        last_ended: wp.array2d(dtype=wp.int32)  # (W, N) at the last report
        last_tick: wp.array2d(dtype=wp.int32)  # (W, N) of the last report

    return Report


MEMORY = {
    "last_goal_distance": NUMBER._replace(of_truth=True),
    "last_ended": whole(min(Outcome), max(Outcome)),
    "last_tick": whole(0, "tick"),
    "over": FLAG,
}
"""Fields that carry over from one report to the next, and what a saved state may hold of them."""


def allocate_report(model: Any, worlds: int, size: int, p: Precision, device: str) -> Any:
    """Return a zeroed report for observations of `size` entries."""
    report = report_struct(p)()
    N = model.vehicles
    shapes = {"observation": (worlds, N, size), "terms": (worlds, N, len(TERMS)), "over": (worlds,)}
    for name, var in report_struct(p).vars.items():
        setattr(report, name, wp.zeros(shapes.get(name, (worlds, N)), dtype=var.type.dtype, device=device))
    return report


@wp.func
def forget(model: Any, state: Any, report: Any, world: int, vehicle: int):
    """Start the memory of a new episode."""
    report.last_goal_distance[world, vehicle] = goal_distance(model, state, world, vehicle)
    report.last_ended[world, vehicle] = UNDER_WAY
    report.last_tick[world, vehicle] = 0


@wp.func
def judge(model: Any, state: Any, report: Any, world: int, vehicle: int):
    """Compare the estimate with the truth and with what it believes of itself."""
    agent = model.landmarks + vehicle
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    R_hat = state.estimate_rotation[world, vehicle]
    p_hat = state.estimate_position[world, vehicle]
    angle = rotation_angle(wp.transpose(R_hat) * R, p_hat)
    report.position_error[world, vehicle] = wp.length(position - R_hat * p_hat)
    report.orientation_error[world, vehicle] = angle * type(angle)(DEGREES)
    I11, L21, I22 = cholesky_of(state.covariance[world, vehicle], R - R)
    e1, e2 = observer_error(R, position, R_hat, p_hat)
    report.nees[world, vehicle] = normalised_error_squared(I11, L21, I22, e1, e2)
    report.log_determinant[world, vehicle] = log_determinant(I11, I22)
    report.gramian_min_eigenvalue[world, vehicle] = gramian_smallest_eigenvalue(model, state, world, vehicle)
    report.targets_in_view[world, vehicle] = targets_in_view(model, state, world, vehicle)


@wp.func
def is_over(model: Any, state: Any, world: int) -> bool:
    """Return whether a world is at its horizon or has no vehicle under way."""
    if state.tick[world] >= model.horizon_ticks:
        return True
    for vehicle in range(model.vehicles):
        if state.ended[world, vehicle] == UNDER_WAY:
            return False
    return True


@wp.func
def known(value: Any) -> wp.float32:
    """Return a quantity of truth, 0 where a recording does not know it."""
    return wp.where(wp.isfinite(value), wp.float32(value), 0.0)


@wp.func
def reward(
    model: Any, state: Any, report: Any, weights: wp.array(dtype=wp.float32), world: int, vehicle: int, fresh: int
):
    """Write the reward terms since the last report, and the flags that end an episode."""
    tick = state.tick[world]
    ended = state.ended[world, vehicle]
    # Over since the last report: nothing more is earned before a reset (each vehicle reads its own memory only).
    waiting = report.last_tick[world, vehicle] >= model.horizon_ticks
    alive = report.last_ended[world, vehicle] == UNDER_WAY and not waiting
    distance = goal_distance(model, state, world, vehicle)
    has_goal = model.scene.goal_radius[vehicle] > distance - distance
    progress = wp.where(has_goal, report.last_goal_distance[world, vehicle] - distance, distance - distance)
    elapsed = wp.float64(tick - report.last_tick[world, vehicle]) / model.camera_rate
    write_terms(
        model,
        state,
        report.terms,
        world,
        vehicle,
        known(progress),
        wp.float32(elapsed),
        wp.where(alive, ended, UNDER_WAY),
        known(report.position_error[world, vehicle]),
        known(report.orientation_error[world, vehicle]) / wp.float32(DEGREES),
        wp.float32(report.log_determinant[world, vehicle]),
        wp.float32(report.gramian_min_eigenvalue[world, vehicle]),
        report.targets_in_view[world, vehicle],
    )
    total = weigh(report.terms, weights, world, vehicle)
    report.reward[world, vehicle] = wp.where(alive and fresh == 0, total, 0.0)
    over = is_over(model, state, world)
    report.alive[world, vehicle] = alive
    report.terminated[world, vehicle] = alive and ended != UNDER_WAY
    report.truncated[world, vehicle] = over and not (alive and ended != UNDER_WAY)
    if vehicle == 0:
        report.over[world] = wp.where(over, 1, 0)
    report.last_goal_distance[world, vehicle] = distance
    report.last_ended[world, vehicle] = ended
    report.last_tick[world, vehicle] = tick


def report_kernel(
    model: Any,
    state: Any,
    plan: Any,
    weights: wp.array(dtype=wp.float32),
    report: Any,
    fresh: wp.array(dtype=wp.int32),
    chosen: wp.array(dtype=wp.int32),
):
    """Fill the report of every vehicle of the chosen worlds. One thread per (world, vehicle).

    `fresh` marks worlds that have just been reset: they forget the last episode and earn no reward.
    """
    world, vehicle = wp.tid()
    if chosen[world] == 0:
        return
    if fresh[world] != 0:
        forget(model, state, report, world, vehicle)
    judge(model, state, report, world, vehicle)
    reward(model, state, report, weights, world, vehicle, fresh[world])
    write_observation(
        model,
        plan,
        state,
        report.observation,
        world,
        vehicle,
        report.log_determinant[world, vehicle],
        report.gramian_min_eigenvalue[world, vehicle],
        report.targets_in_view[world, vehicle],
    )
