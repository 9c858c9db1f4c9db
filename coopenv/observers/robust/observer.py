"""One tick of one vehicle's observer. See observers/robust/observer.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import identity3, orthonormalise, skew
from coopenv.observers.robust.algebra import is_known, odometry_variances
from coopenv.observers.robust.belief import begin, move, place_of
from coopenv.observers.robust.eviction import notice
from coopenv.observers.robust.hypotheses import best_hypothesis
from coopenv.observers.robust.resection import resect
from coopenv.observers.robust.search import begin_search, confirms_prior, look_around, move_search
from coopenv.observers.robust.tracklets import collect, hear, may_lean_on, meet
from coopenv.observers.robust.types import lower_blocks, wide_matrix, wide_vector
from coopenv.observers.robust.update import drop_anchor, look
from coopenv.world.camera import VISIBLE
from coopenv.world.v2x import fresh


@wp.func
def start_vehicle(model: Any, state: Any, mind: Any, world: int, i: int):
    """Start at the initial estimate; one that is too uncertain to linearise about is only a hint for the search."""
    R = orthonormalise(wide_matrix(state.estimate_rotation[world, i]))
    p = R * wide_vector(state.estimate_position[world, i])
    P = model.start.covariance[i]
    begin(mind, world, i, R, p, P)
    mind.odometry_rotation[world, i] = wp.identity(3, wp.float64)
    mind.leans_on[world, i] = may_lean_on(model, i)
    drop_anchor(mind, world, i, P, 0)
    if not is_known(P):
        begin_search(mind, world, i, R, p, P)


@wp.func
def listen(model: Any, state: Any, mind: Any, world: int, i: int, tick: int):
    """Take in the messages of those in view, and of those that are already believed in."""
    notice(model, state, mind, world, i, tick)
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        sender = target - model.landmarks
        if sender >= 0:
            if fresh(model, state, world, i, sender, tick) and mind.inbox_says[world, i, sender] == 1:
                place = place_of(mind, world, i, sender)
                if place > 0:
                    hear(model, mind, world, i, place, sender)
                elif state.sight[world, i, target] == VISIBLE:
                    meet(model, mind, world, i, sender, tick)


@wp.func
def believe(model: Any, state: Any, mind: Any, world: int, i: int, tick: int, R: Any, p: Any, P: Any):
    """Believe in a pose and in those that are in view."""
    begin(mind, world, i, R, p, P)
    mind.leans_on[world, i] = may_lean_on(model, i)
    mind.missed[world, i] = wp.float64(0.0)
    listen(model, state, mind, world, i, tick)


@wp.func
def search(model: Any, state: Any, mind: Any, world: int, i: int, now: Any):
    """Look for the pose; once only one is possible, go on with the prior, or with what this frame alone says."""
    if not look_around(model, state, mind, world, i, now):
        return
    if confirms_prior(mind, world, i):
        P = mind.prior_covariance[world, i]
        believe(model, state, mind, world, i, now.tick, mind.prior_rotation[world, i], mind.prior_position[world, i], P)
        mind.searching[world, i] = 0
        look(model, state, mind, world, i, now)
        return
    P = mind.bank_covariance[world, i, 0]
    believe(model, state, mind, world, i, now.tick, mind.bank_rotation[world, i, 0], mind.bank_position[world, i, 0], P)
    if resect(model, state, mind, world, i, now.tick) and is_known(mind.P[world, i, 0, 0]):
        mind.searching[world, i] = 0


@wp.func
def write_pose(state: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Write an estimate as the state holds it: position in the body, covariance over (2 lambda, p) to first order."""
    position = wp.transpose(R) * p
    one = identity3(position)
    J = lower_blocks(one, skew(position), one)
    Q = J * P * wp.transpose(J)
    rotation = state.estimate_rotation[world, i]
    covariance = state.covariance[world, i]
    for k in range(3):
        for j in range(3):
            rotation[k, j] = rotation.dtype(R[k, j])
    for k in range(6):
        for j in range(6):
            covariance[k, j] = covariance.dtype((Q[k, j] + Q[j, k]) * wp.float64(0.5))
    old = state.estimate_position[world, i]
    state.estimate_rotation[world, i] = rotation
    state.estimate_position[world, i] = type(old)(
        old.dtype(position[0]), old.dtype(position[1]), old.dtype(position[2])
    )
    state.covariance[world, i] = covariance


@wp.func
def write(state: Any, mind: Any, world: int, i: int):
    """Write where the vehicle believes to be."""
    if mind.searching[world, i] == 0:
        write_pose(state, world, i, mind.R[world, i, 0], mind.p[world, i, 0], mind.P[world, i, 0, 0])
        return
    R = mind.prior_rotation[world, i]
    p = mind.prior_position[world, i]
    P = mind.prior_covariance[world, i]
    h = best_hypothesis(mind, world, i)
    if h >= 0:
        R = mind.bank_rotation[world, i, h]
        p = mind.bank_position[world, i, h]
        P = mind.bank_covariance[world, i, h]
    write_pose(state, world, i, R, p, P)


@wp.func
def update(model: Any, state: Any, mind: Any, world: int, i: int, now: Any):
    """Take one camera tick of one vehicle, whose messages have been delivered."""
    state.nis[world, i] = wp.float64(0.0)
    state.nis_dof[world, i] = 0
    collect(model, state, mind, world, i)
    dR = orthonormalise(wide_matrix(state.increment_rotation[world, i]))
    dp = wide_vector(state.increment_translation[world, i])
    R = mind.odometry_rotation[world, i]
    mind.odometry_rotation[world, i] = orthonormalise(R * dR)
    mind.odometry_position[world, i] = mind.odometry_position[world, i] + R * dp
    rotation, translation = odometry_variances(model, now.period)
    if mind.searching[world, i] == 1:
        move_search(mind, world, i, dR, dp, rotation, translation)
        if now.due:
            search(model, state, mind, world, i, now)
    else:
        move(mind, world, i, 0, dR, dp, rotation, translation)
        listen(model, state, mind, world, i, now.tick)
        if now.due:
            look(model, state, mind, world, i, now)
    write(state, mind, world, i)
    if now.due:
        state.corrected_tick[world, i] = now.tick
