"""Start an observer anew: nothing of an earlier episode stays."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.observer import collect, start_vehicle
from coopenv.observers.robust.state import BANK_PLACES
from coopenv.observers.robust.types import (
    mat26d,
    mat33d,
    mat62d,
    mat66d,
    mat66f,
    vec2d,
    vec3d,
    vec6d,
)


@wp.func
def forget_members(mind: Any, world: int, i: int):
    """Clear the belief."""
    mind.odometry_position[world, i] = vec3d()
    mind.missed[world, i] = wp.float64(0.0)
    mind.healthy[world, i] = wp.float64(0.0)
    most = mind.vehicle.shape[2]
    for n in range(most):
        mind.vehicle[world, i, n] = 0
        mind.R[world, i, n] = mat33d()
        mind.p[world, i, n] = vec3d()
        for k in range(most):
            mind.P[world, i, n, k] = mat66d()
        mind.twists[world, i, n] = 0
        mind.v[world, i, n] = vec3d()
        mind.w[world, i, n] = vec3d()
        mind.seen_tick[world, i, n] = 0
        mind.report_tick[world, i, n] = 0
        mind.report_rotation[world, i, n] = mat33d()
        mind.report_position[world, i, n] = vec3d()
        mind.report_covariance[world, i, n] = mat66d()
        mind.report_odometry_rotation[world, i, n] = mat33d()
        mind.report_odometry_position[world, i, n] = vec3d()
        mind.report_leans_on[world, i, n] = wp.uint64(0)
        mind.distrusted[world, i, n] = 0
        mind.agreed[world, i, n] = wp.float64(0.0)


@wp.func
def forget_search(mind: Any, world: int, i: int):
    """Clear the hypotheses."""
    mind.searching[world, i] = 0
    mind.prior_rotation[world, i] = mat33d()
    mind.prior_position[world, i] = vec3d()
    mind.prior_covariance[world, i] = mat66d()
    mind.hypotheses[world, i] = 0
    mind.age[world, i] = wp.float64(0.0)
    mind.waited[world, i] = wp.float64(0.0)
    mind.clear[world, i] = wp.float64(0.0)
    mind.attempts[world, i] = 0
    for h in range(BANK_PLACES):
        mind.bank_rotation[world, i, h] = mat33d()
        mind.bank_position[world, i, h] = vec3d()
        mind.bank_covariance[world, i, h] = mat66d()
        mind.paid[world, i, h] = wp.float64(0.0)
        mind.surprise[world, i, h] = wp.float64(0.0)
        mind.bearings[world, i, h] = 0


@wp.func
def forget_messages(model: Any, mind: Any, world: int, i: int):
    """Clear what was sent and heard."""
    for slot in range(model.radio.slots):
        mind.outbox_says[world, i, slot] = 0
        mind.outbox_rotation[world, i, slot] = mat33d()
        mind.outbox_position[world, i, slot] = vec3d()
        mind.outbox_covariance[world, i, slot] = mat66f()
        mind.outbox_odometry_rotation[world, i, slot] = mat33d()
        mind.outbox_odometry_position[world, i, slot] = vec3d()
        mind.outbox_leans_on[world, i, slot] = wp.uint64(0)
    for sender in range(model.vehicles):
        mind.inbox_tick[world, i, sender] = -1
        mind.inbox_says[world, i, sender] = 0
        mind.inbox_rotation[world, i, sender] = mat33d()
        mind.inbox_position[world, i, sender] = vec3d()
        mind.inbox_covariance[world, i, sender] = mat66f()
        mind.inbox_odometry_rotation[world, i, sender] = mat33d()
        mind.inbox_odometry_position[world, i, sender] = vec3d()
        mind.inbox_leans_on[world, i, sender] = wp.uint64(0)


@wp.func
def clear_scratch(model: Any, mind: Any, world: int):
    """Clear what is only used within a tick, so that equal states are equal in every bit."""
    for n in range(model.agents):
        mind.line_place[world, n] = 0
        mind.line_bearing[world, n] = vec3d()
        mind.line_point[world, n] = vec3d()
        mind.line_spread[world, n] = wp.float64(0.0)
        mind.line_fits[world, n] = 0
        mind.line_own[world, n] = mat26d()
        mind.line_other[world, n] = mat26d()
        mind.line_noise[world, n] = wp.float64(0.0)
        mind.line_distance[world, n] = wp.float64(0.0)
        mind.line_residual[world, n] = vec2d()
    most = mind.column.shape[1]
    for n in range(most):
        mind.column[world, n] = mat66d()
        mind.narrow[world, n] = mat62d()
        mind.dx[world, n] = vec6d()
        mind.last[world, n] = vec6d()
        mind.before_rotation[world, n] = mat33d()
        mind.before_position[world, n] = vec3d()
        for k in range(most):
            mind.before_covariance[world, n, k] = mat66d()


@wp.func
def start(model: Any, state: Any, mind: Any, world: int, i: int):
    """Start the observer of a vehicle anew, and take what its leaders have sent."""
    clear_scratch(model, mind, world)
    forget_members(mind, world, i)
    forget_search(mind, world, i)
    forget_messages(model, mind, world, i)
    start_vehicle(model, state, mind, world, i)
    collect(model, state, mind, world, i)
