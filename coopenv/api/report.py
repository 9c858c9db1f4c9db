"""What the faces of a world read after each decision step, computed for all worlds and vehicles in one launch."""

from functools import cache
from typing import Any

import warp as wp

from coopenv.api.observation import write_observation
from coopenv.api.rewards import TERMS, weigh, write_terms
from coopenv.estimation.quality import (
    cholesky_of,
    gramian_smallest_eigenvalue,
    log_determinant,
    normalised_error_squared,
    observer_error,
    targets_in_view,
)
from coopenv.estimation.so3 import rotation_angle
from coopenv.world.collision import UNDER_WAY, goal_distance
from coopenv.world.precision import Precision

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
        reward: wp.array2d(dtype=wp.float32)  # (W, N)
        terminated: wp.array2d(dtype=wp.bool)  # (W, N) arrived or collided
        truncated: wp.array2d(dtype=wp.bool)  # (W, N) horizon reached without having ended before
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


MEMORY = ("last_goal_distance", "last_ended", "last_tick")
"""Fields that carry over from one report to the next."""


def allocate_report(model: Any, worlds: int, size: int, p: Precision, device: str) -> Any:
    """Return a zeroed report for observations of `size` entries."""
    report = report_struct(p)()
    N = model.vehicles
    shapes = {"observation": (worlds, N, size), "terms": (worlds, N, len(TERMS))}
    for name, var in report_struct(p).vars.items():
        setattr(report, name, wp.zeros(shapes.get(name, (worlds, N)), dtype=var.type.dtype, device=device))
    return report


def begin_kernel(model: Any, state: Any, report: Any, mask: wp.array(dtype=wp.int32)):
    """Forget the last episode's memory in the worlds that have been reset."""
    world, vehicle = wp.tid()
    if mask[world] != 0:
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
def reward(model: Any, state: Any, report: Any, weights: wp.array(dtype=wp.float32), world: int, vehicle: int):
    """Write the reward terms since the last report, and the flags that end an episode."""
    tick = state.tick[world]
    ended = state.ended[world, vehicle]
    before = report.last_ended[world, vehicle]
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
        wp.float32(progress),
        wp.float32(elapsed),
        wp.where(before == UNDER_WAY, ended, UNDER_WAY),
        wp.float32(report.position_error[world, vehicle]),
        wp.float32(report.orientation_error[world, vehicle]) / wp.float32(DEGREES),
        wp.float32(report.log_determinant[world, vehicle]),
        wp.float32(report.gramian_min_eigenvalue[world, vehicle]),
        report.targets_in_view[world, vehicle],
    )
    report.reward[world, vehicle] = weigh(report.terms, weights, world, vehicle)
    report.terminated[world, vehicle] = ended != UNDER_WAY
    report.truncated[world, vehicle] = ended == UNDER_WAY and tick >= model.horizon_ticks
    report.last_goal_distance[world, vehicle] = distance
    report.last_ended[world, vehicle] = ended
    report.last_tick[world, vehicle] = tick


def report_kernel(model: Any, state: Any, plan: Any, weights: wp.array(dtype=wp.float32), report: Any):
    """Fill the report of every vehicle of every world. One thread per (world, vehicle)."""
    world, vehicle = wp.tid()
    judge(model, state, report, world, vehicle)
    reward(model, state, report, weights, world, vehicle)
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
