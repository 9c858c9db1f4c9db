"""The observation of one vehicle as Warp functions: a pure read of what the vehicle itself knows, never of truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from coopenv.api.layout import LOG_SCALE, Field
from coopenv.estimation.quality import cholesky_of, gramian_smallest_eigenvalue, log_determinant
from coopenv.scenario import Scenario
from coopenv.world.camera import VISIBLE
from coopenv.world.v2x import fresh

EIGENVALUE_FLOOR = wp.constant(1.0e-9)
NEVER = wp.constant(wp.float64(1.0e9))
LOGARITHMIC = wp.constant(LOG_SCALE)


@wp.struct
class ObservationPlan:
    """Where each group of fields starts in the flat vector (-1: left out), and the scales."""

    estimate: wp.int32
    quality: wp.int32
    bearings: wp.int32
    odometry: wp.int32
    messages: wp.int32
    goal: wp.int32
    position_scale: wp.float32
    velocity_scale: wp.float32
    angular_velocity_scale: wp.float32
    age_scale: wp.float32


def observation_plan(scenario: Scenario, layout: dict[str, Field]) -> Any:
    """Return the plan that kernels follow to fill an observation of this layout."""
    plan = ObservationPlan()
    for group in ("estimate", "quality", "bearings", "odometry", "messages", "goal"):
        starts = [field.start for field in layout.values() if field.group == group]
        setattr(plan, group, min(starts, default=-1))
    for name in ("position_scale", "velocity_scale", "angular_velocity_scale", "age_scale"):
        setattr(plan, name, float(np.float32(getattr(scenario.observation, name))))
    return plan


@wp.func
def put(out: wp.array3d(dtype=wp.float32), world: int, vehicle: int, index: int, value: Any, scale: wp.float32):
    """Write value / scale, clipped to [-1, 1]."""
    out[world, vehicle, index] = wp.clamp(wp.float32(value) / scale, -1.0, 1.0)


@wp.func
def put3(out: wp.array3d(dtype=wp.float32), world: int, vehicle: int, index: int, value: Any, scale: wp.float32):
    """Write a vector."""
    for axis in range(3):
        put(out, world, vehicle, index + axis, value[axis], scale)


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
    put3(out, world, vehicle, plan.estimate, position, plan.position_scale)
    for axis in range(3):
        put(out, world, vehicle, plan.estimate + 3 + axis, R[axis, 0], 1.0)
        put(out, world, vehicle, plan.estimate + 6 + axis, R[axis, 1], 1.0)


@wp.func
def targets_in_view(model: Any, state: Any, world: int, vehicle: int) -> int:
    """Return how many targets the vehicle measures in this frame."""
    count = int(0)
    for target in range(model.agents):
        if state.sight[world, vehicle, target] == VISIBLE:
            count += 1
    return count


@wp.func
def write_quality(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """Covariance, its log-determinant, observability, targets in view."""
    P = state.covariance[world, vehicle]
    R = state.estimate_rotation[world, vehicle]
    per_decade = P.dtype(0.4342944819032518)
    for i in range(6):
        put(out, world, vehicle, plan.quality + i, wp.log(P[i, i]) * per_decade, LOGARITHMIC)
    I11, _, I22 = cholesky_of(P, R - R)
    put(out, world, vehicle, plan.quality + 6, log_determinant(I11, I22) / P.dtype(6.0), LOGARITHMIC)
    smallest = gramian_smallest_eigenvalue(model, state, world, vehicle)
    decades = wp.log(wp.max(wp.float32(smallest), EIGENVALUE_FLOOR)) * 0.4342944819032518
    put(out, world, vehicle, plan.quality + 7, decades, LOGARITHMIC)
    count = targets_in_view(model, state, world, vehicle)
    put(out, world, vehicle, plan.quality + 8, wp.float32(count), wp.float32(model.agents))


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
        put(out, world, vehicle, mask + model.agents + target, age, plan.age_scale)


@wp.func
def write_odometry(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """Last odometry sample and its age."""
    put3(out, world, vehicle, plan.odometry, state.odometry_velocity[world, vehicle], plan.velocity_scale)
    angular = state.odometry_angular_velocity[world, vehicle]
    put3(out, world, vehicle, plan.odometry + 3, angular, plan.angular_velocity_scale)
    samples = state.odometry_samples[world, vehicle]
    age = NEVER
    if samples > 0:
        now = wp.float64(state.tick[world]) / model.camera_rate
        age = now - wp.float64(samples - 1) / model.odometry_rate
    put(out, world, vehicle, plan.odometry + 6, wp.max(age, wp.float64(0.0)), plan.age_scale)


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
        put3(out, world, vehicle, plan.messages + 3 * slot, position, plan.position_scale)
        put3(out, world, vehicle, plan.messages + 3 * (others + slot), forward, 1.0)
        put(out, world, vehicle, plan.messages + 6 * others + slot, mask, 1.0)
        put(out, world, vehicle, plan.messages + 7 * others + slot, age, plan.age_scale)


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
    put3(out, world, vehicle, plan.goal, seen, plan.position_scale)


@wp.func
def write_observation(
    model: Any, plan: ObservationPlan, state: Any, out: wp.array3d(dtype=wp.float32), world: int, vehicle: int
):
    """Fill one row of the observation."""
    if plan.estimate >= 0:
        write_estimate(plan, state, out, world, vehicle)
    if plan.quality >= 0:
        write_quality(model, plan, state, out, world, vehicle)
    if plan.bearings >= 0:
        write_bearings(model, plan, state, out, world, vehicle)
    if plan.odometry >= 0:
        write_odometry(model, plan, state, out, world, vehicle)
    if plan.messages >= 0 and model.vehicles > 1:
        write_messages(model, plan, state, out, world, vehicle)
    if plan.goal >= 0:
        write_goal(model, plan, state, out, world, vehicle)
