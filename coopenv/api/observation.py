"""The observation of one vehicle as Warp functions: a pure read of what the vehicle itself knows, never of truth."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.api.layout import LOG_SCALE, Field
from coopenv.scenario import Scenario
from coopenv.world.camera import VISIBLE
from coopenv.world.v2x import fresh

EIGENVALUE_FLOOR = wp.constant(1.0e-9)
NEVER = wp.constant(wp.float64(1.0e9))
PER_LOG = wp.constant(1.0 / LOG_SCALE)


@wp.struct
class ObservationPlan:
    """Where each group of fields starts in the flat vector (-1: left out), and the reciprocals of the scales."""

    estimate: wp.int32
    quality: wp.int32
    bearings: wp.int32
    odometry: wp.int32
    messages: wp.int32
    goal: wp.int32
    per_metre: wp.float32
    per_velocity: wp.float32
    per_angular_velocity: wp.float32
    per_age: wp.float32


def observation_plan(scenario: Scenario, layout: dict[str, Field]) -> Any:
    """Return the plan that kernels follow to fill an observation of this layout."""
    plan = ObservationPlan()
    for group in ("estimate", "quality", "bearings", "odometry", "messages", "goal"):
        starts = [field.start for field in layout.values() if field.group == group]
        setattr(plan, group, min(starts, default=-1))
    o = scenario.observation
    plan.per_metre, plan.per_age = 1.0 / o.position_scale, 1.0 / o.age_scale
    plan.per_velocity, plan.per_angular_velocity = 1.0 / o.velocity_scale, 1.0 / o.angular_velocity_scale
    return plan


@wp.func
def log10(value: wp.float32) -> wp.float32:
    """Return the decimal logarithm."""
    return wp.log(value) * 0.4342944819032518


@wp.func
def put(out: wp.array3d(dtype=wp.float32), world: int, vehicle: int, index: int, value: Any, factor: wp.float32):
    """Write value x factor, clipped to [-1, 1]."""
    out[world, vehicle, index] = wp.clamp(wp.float32(value) * factor, -1.0, 1.0)


@wp.func
def put3(out: wp.array3d(dtype=wp.float32), world: int, vehicle: int, index: int, value: Any, factor: wp.float32):
    """Write a vector."""
    for axis in range(3):
        put(out, world, vehicle, index + axis, value[axis], factor)


@wp.func
def seconds_since(model: Any, now: int, then: int) -> wp.float64:
    """Return the age of a measurement or message in s; very old if there is none."""
    if then < 0:
        return NEVER
    return wp.float64(now - then) / model.camera_rate


@wp.func
def write_estimate(plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int):
    """Own pose estimate."""
    R = state.estimate_rotation[world, vehicle]
    position = R * state.estimate_position[world, vehicle]
    put3(out, world, vehicle, plan.estimate, position, plan.per_metre)
    for axis in range(3):
        put(out, world, vehicle, plan.estimate + 3 + axis, R[axis, 0], 1.0)
        put(out, world, vehicle, plan.estimate + 6 + axis, R[axis, 1], 1.0)


@wp.func
def write_quality(
    model: Any,
    plan: ObservationPlan,
    state: Any,
    out: wp.array3d(dtype=wp.float32),
    world: int,
    vehicle: int,
    log_determinant: Any,
    smallest_eigenvalue: Any,
    in_view: int,
):
    """Covariance, its log-determinant, observability, targets in view."""
    P = state.covariance[world, vehicle]
    for i in range(6):
        put(out, world, vehicle, plan.quality + i, log10(wp.float32(P[i, i])), PER_LOG)
    put(out, world, vehicle, plan.quality + 6, log_determinant / P.dtype(6.0), PER_LOG)
    decades = log10(wp.max(wp.float32(smallest_eigenvalue), EIGENVALUE_FLOOR))
    put(out, world, vehicle, plan.quality + 7, decades, PER_LOG)
    put(out, world, vehicle, plan.quality + 8, wp.float32(in_view), 1.0 / wp.float32(model.agents))


@wp.func
def write_bearings(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """Last bearing to every target, with mask and age."""
    now = state.tick[world]
    mask = plan.bearings + 3 * model.agents
    for target in range(model.agents):
        put3(out, world, vehicle, plan.bearings + 3 * target, state.bearing[world, vehicle, target], 1.0)
        seen = wp.where(state.sight[world, vehicle, target] == VISIBLE, 1.0, 0.0)
        put(out, world, vehicle, mask + target, seen, 1.0)
        age = seconds_since(model, now, state.bearing_tick[world, vehicle, target])
        put(out, world, vehicle, mask + model.agents + target, age, plan.per_age)


@wp.func
def write_odometry(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """Last odometry sample and its age."""
    put3(out, world, vehicle, plan.odometry, state.odometry_velocity[world, vehicle], plan.per_velocity)
    angular = state.odometry_angular_velocity[world, vehicle]
    put3(out, world, vehicle, plan.odometry + 3, angular, plan.per_angular_velocity)
    samples = state.odometry_samples[world, vehicle]
    age = NEVER
    if samples > 0:
        now = wp.float64(state.tick[world]) / model.camera_rate
        age = now - wp.float64(samples - 1) / model.odometry_rate
    put(out, world, vehicle, plan.odometry + 6, wp.max(age, wp.float64(0.0)), plan.per_age)


@wp.func
def write_messages(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """What the other vehicles said of themselves, seen from one's own estimate."""
    now = state.tick[world]
    R = state.estimate_rotation[world, vehicle]
    Rt = wp.transpose(R)
    p = state.estimate_position[world, vehicle]
    others = model.vehicles - 1
    for slot in range(others):
        sender = slot
        if slot >= vehicle:
            sender = slot + 1
        position = p - p
        forward = p - p
        mask = float(0.0)
        age = NEVER
        if fresh(model, state, world, vehicle, sender, now):
            position = Rt * state.inbox_position[world, vehicle, sender] - p
            relative = Rt * state.inbox_rotation[world, vehicle, sender]
            forward = type(p)(relative[0, 0], relative[1, 0], relative[2, 0])
            mask = 1.0
            age = seconds_since(model, now, state.inbox_tick[world, vehicle, sender])
        put3(out, world, vehicle, plan.messages + 3 * slot, position, plan.per_metre)
        put3(out, world, vehicle, plan.messages + 3 * (others + slot), forward, 1.0)
        put(out, world, vehicle, plan.messages + 6 * others + slot, mask, 1.0)
        put(out, world, vehicle, plan.messages + 7 * others + slot, age, plan.per_age)


@wp.func
def write_goal(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """The goal, which is known in the map, seen from one's own estimate."""
    p = state.estimate_position[world, vehicle]
    radius = model.scene.goal_radius[vehicle]
    seen = p - p
    if radius > radius - radius:
        seen = wp.transpose(state.estimate_rotation[world, vehicle]) * model.scene.goal[vehicle] - p
    put3(out, world, vehicle, plan.goal, seen, plan.per_metre)


@wp.func
def write_observation(
    model: Any,
    plan: ObservationPlan,
    state: Any,
    out: wp.array3d(dtype=wp.float32),
    world: int,
    vehicle: int,
    log_determinant: Any,
    smallest_eigenvalue: Any,
    in_view: int,
):
    """Fill one row of the observation; the last three arguments are the estimate's quality."""
    if plan.estimate >= 0:
        write_estimate(plan, state, out, world, vehicle)
    if plan.quality >= 0:
        write_quality(model, plan, state, out, world, vehicle, log_determinant, smallest_eigenvalue, in_view)
    if plan.bearings >= 0:
        write_bearings(model, plan, state, out, world, vehicle)
    if plan.odometry >= 0:
        write_odometry(model, plan, state, out, world, vehicle)
    if plan.messages >= 0 and model.vehicles > 1:
        write_messages(model, plan, state, out, world, vehicle)
    if plan.goal >= 0:
        write_goal(model, plan, state, out, world, vehicle)
