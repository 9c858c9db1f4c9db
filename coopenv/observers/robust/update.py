"""A frame's bearings against the belief: which of them fit, and whether the vehicle is where it believes to be."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import exp_so3, orthonormalise
from coopenv.observers.robust.algebra import odometry_variances, transition, with_noise
from coopenv.observers.robust.belief import place_of
from coopenv.observers.robust.measurements import NOTHING, aim, draw, fitting_lines, normalised, settle
from coopenv.observers.robust.reference.observer import (
    ACCELERATION,
    HEALTHY_SHARE,
    HEALTHY_TIME,
    LOST_SHARE,
    LOST_TIME,
    SLACK,
)
from coopenv.observers.robust.search import FITTING, begin_search
from coopenv.observers.robust.types import vec3d, wide_vector
from coopenv.world.camera import VISIBLE, marker_position

HALF_ACCELERATION = wp.constant(0.5 * ACCELERATION)
SLACK_ANGLE, SLACK_POSITION = wp.constant(float(SLACK[0, 0])), wp.constant(float(SLACK[3, 3]))
MOST_AILING, LEAST_HEALTHY = wp.constant(HEALTHY_SHARE), wp.constant(HEALTHY_TIME)
MOST_LOST, LOST_MEMORY = wp.constant(LOST_SHARE), wp.constant(LOST_TIME)


@wp.func
def drift(model: Any, age: Any):
    """Return the variance per axis, m^2, of where a sender is a time after its last message."""
    if age <= wp.float64(0.0):
        return wp.float64(0.0)
    _, translation = odometry_variances(model, age)
    away = wp.float64(HALF_ACCELERATION) * age * age
    return translation + away * away


@wp.func
def aim_at_member(model: Any, mind: Any, world: int, i: int, n: int, place: int, tick: int, b: Any):
    """Let a bearing be about a member, which is carried on by its last twist."""
    age = wp.float64(tick - mind.report_tick[world, i, place]) * model.camera_period
    gone = vec3d()
    if age > wp.float64(0.0) and mind.twists[world, i, place] == 1:
        half_turn = mind.w[world, i, place] * (wp.float64(0.5) * age)
        gone = exp_so3(half_turn) * mind.v[world, i, place] * age
    aim(mind, world, n, place, b, gone, drift(model, age))


@wp.func
def aim_at_belief(model: Any, state: Any, mind: Any, world: int, i: int, tick: int):
    """Say what each bearing of the frame is about."""
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        mind.line_place[world, n] = NOTHING
        if state.sight[world, i, target] == VISIBLE:
            b = wide_vector(model.camera.rotation * state.bearing[world, i, target])
            if target < model.landmarks:
                z = wide_vector(marker_position(model, state, world, target))
                aim(mind, world, n, 0, b, z, wp.float64(0.0))
            else:
                place = place_of(mind, world, i, target - model.landmarks)
                if place > 0:
                    aim_at_member(model, mind, world, i, n, place, tick, b)


@wp.func
def examine(model: Any, mind: Any, world: int, i: int):
    """Draw the lines and mark those that fit; return the share of those that do not, and the NIS of those that do.

    Bearings to distrusted senders do not count in the share; it is -1 if none counts.
    """
    counted = int(0)
    missed = int(0)
    total = wp.float64(0.0)
    for n in range(model.target_count[i]):
        fitting = int(0)
        place = mind.line_place[world, n]
        if place != NOTHING:
            if draw(model, mind, world, i, n):
                nis = normalised(mind, world, i, n)
                if nis < wp.float64(FITTING):
                    fitting = 1
                    total += nis
            if place == 0 or mind.distrusted[world, i, place] == 0:
                counted += 1
                missed += 1 - fitting
        mind.line_fits[world, n] = fitting
    if counted == 0:
        return wp.float64(-1.0), total
    return wp.float64(missed) / wp.float64(counted), total


@wp.func
def drop_anchor(mind: Any, world: int, i: int, P: Any, tick: int):
    """Remember where the vehicle is, for a search after a loss."""
    mind.anchor_rotation[world, i] = mind.R[world, i, 0]
    mind.anchor_position[world, i] = mind.p[world, i, 0]
    mind.anchor_covariance[world, i] = P
    mind.anchor_odometry_rotation[world, i] = mind.odometry_rotation[world, i]
    mind.anchor_odometry_position[world, i] = mind.odometry_position[world, i]
    mind.anchor_tick[world, i] = tick


@wp.func
def lose(model: Any, mind: Any, world: int, i: int, tick: int):
    """Search anew, from where the vehicle was when most bearings fitted, carried on by its odometry."""
    since = wp.transpose(mind.anchor_odometry_rotation[world, i])
    dR = since * mind.odometry_rotation[world, i]
    dp = since * (mind.odometry_position[world, i] - mind.anchor_odometry_position[world, i])
    elapsed = wp.float64(tick - mind.anchor_tick[world, i]) * model.camera_period
    rotation, translation = odometry_variances(model, elapsed)
    R = mind.anchor_rotation[world, i]
    F = transition(dR, dp)
    P = with_noise(F * mind.anchor_covariance[world, i] * wp.transpose(F), rotation, translation)
    begin_search(mind, world, i, orthonormalise(R * dR), mind.anchor_position[world, i] + R * dp, P)


@wp.func
def look(model: Any, state: Any, mind: Any, world: int, i: int, now: Any):
    """Correct the belief by every bearing that fits it; search anew when most do not."""
    aim_at_belief(model, state, mind, world, i, now.tick)
    share, nis = examine(model, mind, world, i)
    state.nis[world, i] = nis
    fitting = fitting_lines(mind, world, model.target_count[i])
    state.nis_dof[world, i] = 2 * fitting
    if fitting > 0:
        settle(model, mind, world, i)
    if share < wp.float64(0.0):
        return
    memory = wp.min(wp.float64(1.0), now.period / wp.float64(LOST_MEMORY))
    missed = mind.missed[world, i] + (share - mind.missed[world, i]) * memory
    healthy = mind.healthy[world, i] + now.period
    if missed >= wp.float64(MOST_AILING):
        healthy = wp.float64(0.0)
    mind.missed[world, i] = missed
    mind.healthy[world, i] = healthy
    if missed > wp.float64(MOST_LOST):
        lose(model, mind, world, i, now.tick)
    elif healthy > wp.float64(LEAST_HEALTHY):
        P = wp.float64(4.0) * mind.P[world, i, 0, 0]
        drop_anchor(mind, world, i, with_noise(P, wp.float64(SLACK_ANGLE), wp.float64(SLACK_POSITION)), now.tick)
