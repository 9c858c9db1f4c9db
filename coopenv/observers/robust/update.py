"""A frame's bearings against the belief: which of them fit, and whether the vehicle is where it believes to be."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import exp_so3, orthonormalise
from coopenv.observers.robust.algebra import odometry_variances, transition, with_noise
from coopenv.observers.robust.belief import index_of
from coopenv.observers.robust.constants import (
    ANCHOR_ANGLE_VARIANCE,
    ANCHOR_POSITION_VARIANCE,
    BEARING_GATE,
    HEALTHY_SHARE,
    HEALTHY_TIME,
    LOST_SHARE,
    LOST_TIME,
    MAX_ACCELERATION,
)
from coopenv.observers.robust.measurements import (
    NOTHING,
    fitting_lines,
    iterated_update,
    linearise,
    normalised_innovation,
    set_line,
)
from coopenv.observers.robust.memory import Anchor
from coopenv.observers.robust.search import begin_search
from coopenv.observers.robust.types import vec3d, wide_vector
from coopenv.world.camera import VISIBLE, marker_position

HALF_ACCELERATION = 0.5 * MAX_ACCELERATION


@wp.func
def drift_variance(model: Any, age: Any):
    """Return the variance per axis, m^2, of where a sender is a time after its last message."""
    if age <= wp.float64(0.0):
        return wp.float64(0.0)
    _, translation = odometry_variances(model, age)
    away = wp.float64(HALF_ACCELERATION) * age * age
    return translation + away * away


@wp.func
def set_line_to_member(model: Any, memory: Any, world: int, i: int, n: int, member: int, tick: int, b: Any):
    """Let a bearing be to a member, which is carried on by its last twist."""
    age = wp.float64(tick - memory.member[world, i, member].report.tick) * model.camera_period
    gone = vec3d()
    if age > wp.float64(0.0) and memory.member[world, i, member].has_twist == 1:
        half_turn = memory.member[world, i, member].w * (wp.float64(0.5) * age)
        gone = exp_so3(half_turn) * memory.member[world, i, member].v * age
    set_line(memory, world, n, member, b, gone, drift_variance(model, age))


@wp.func
def set_lines_to_belief(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Set the line of sight of each bearing to a landmark or a member."""
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        memory.line[world, n].member = NOTHING
        if state.sight[world, i, target] == VISIBLE:
            b = wide_vector(model.camera.rotation * state.bearing[world, i, target])
            if target < model.landmarks:
                z = wide_vector(marker_position(model, state, world, target))
                set_line(memory, world, n, 0, b, z, wp.float64(0.0))
            else:
                member = index_of(memory, world, i, target - model.landmarks)
                if member > 0:
                    set_line_to_member(model, memory, world, i, n, member, tick, b)


@wp.func
def gate(model: Any, memory: Any, world: int, i: int):
    """Linearise the lines and mark those that fit; return the share of the others, and the NIS of those that do.

    Bearings to distrusted senders do not count in the share; it is -1 if none counts.
    """
    counted = int(0)
    missed = int(0)
    total = wp.float64(0.0)
    for n in range(model.target_count[i]):
        fitting = int(0)
        member = memory.line[world, n].member
        if member != NOTHING:
            if linearise(model, memory, world, i, n):
                nis = normalised_innovation(memory, world, i, n)
                if nis < wp.float64(BEARING_GATE):
                    fitting = 1
                    total += nis
            if member == 0 or memory.member[world, i, member].distrusted == 0:
                counted += 1
                missed += 1 - fitting
        memory.line[world, n].fits = fitting
    if counted == 0:
        return wp.float64(-1.0), total
    return wp.float64(missed) / wp.float64(counted), total


@wp.func
def set_anchor(memory: Any, world: int, i: int, P: Any, tick: int):
    """Remember where the vehicle is, for a search after a loss."""
    anchor = Anchor()
    anchor.R = memory.member[world, i, 0].R
    anchor.p = memory.member[world, i, 0].p
    anchor.P = P
    anchor.odometry = memory.belief[world, i].odometry
    anchor.tick = tick
    memory.anchor[world, i] = anchor


@wp.func
def restart_search(model: Any, memory: Any, world: int, i: int, tick: int):
    """Search anew, from where the vehicle was when most bearings fitted, carried on by its odometry."""
    since = wp.transpose(memory.anchor[world, i].odometry.R)
    dR = since * memory.belief[world, i].odometry.R
    dp = since * (memory.belief[world, i].odometry.p - memory.anchor[world, i].odometry.p)
    elapsed = wp.float64(tick - memory.anchor[world, i].tick) * model.camera_period
    rotation, translation = odometry_variances(model, elapsed)
    R = memory.anchor[world, i].R
    F = transition(dR, dp)
    P = with_noise(F * memory.anchor[world, i].P * wp.transpose(F), rotation, translation)
    begin_search(memory, world, i, orthonormalise(R * dR), memory.anchor[world, i].p + R * dp, P)


@wp.func
def update(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Correct the belief by every bearing that fits it; search anew when most do not."""
    set_lines_to_belief(model, state, memory, world, i, now.tick)
    share, nis = gate(model, memory, world, i)
    state.nis[world, i] = nis
    fitting = fitting_lines(memory, world, model.target_count[i])
    state.nis_dof[world, i] = 2 * fitting
    if fitting > 0:
        iterated_update(model, memory, world, i)
    if share < wp.float64(0.0):
        return
    weight = wp.min(wp.float64(1.0), now.period / wp.float64(LOST_TIME))
    missed = memory.belief[world, i].missed_share + (share - memory.belief[world, i].missed_share) * weight
    healthy = memory.belief[world, i].healthy_time + now.period
    if missed >= wp.float64(HEALTHY_SHARE):
        healthy = wp.float64(0.0)
    memory.belief[world, i].missed_share = missed
    memory.belief[world, i].healthy_time = healthy
    if missed > wp.float64(LOST_SHARE):
        restart_search(model, memory, world, i, now.tick)
    elif healthy > wp.float64(HEALTHY_TIME):
        P = wp.float64(4.0) * memory.P[world, i, 0, 0]
        P = with_noise(P, wp.float64(ANCHOR_ANGLE_VARIANCE), wp.float64(ANCHOR_POSITION_VARIANCE))
        set_anchor(memory, world, i, P, now.tick)
