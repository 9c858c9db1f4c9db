"""One tick of one vehicle's observer, and its start.

One vehicle keeps a joint belief about itself and the vehicles that it hears. Bearings, to landmarks and to vehicles,
correct that belief; a neighbour's messages add what the neighbour has learnt since its last one, and no more. So
nothing that was heard before counts twice, and the neighbour's slowly varying error is no white noise. Without a useful
prior, or when most bearings contradict the belief, the pose is searched for; meanwhile the vehicle sends nothing.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import identity3, orthonormalise, skew
from coopenv.observers.robust.algebra import is_known, odometry_variances
from coopenv.observers.robust.belief import begin_belief, propagate
from coopenv.observers.robust.hypotheses import best_hypothesis
from coopenv.observers.robust.memory import Belief, Hypothesis, Line, Member, Scratch, Search
from coopenv.observers.robust.resection import resect
from coopenv.observers.robust.search import advance_search, begin_search, confirms_prior, propagate_search
from coopenv.observers.robust.tracklets import possible_dependencies
from coopenv.observers.robust.types import lower_blocks, mat66d, wide_matrix, wide_vector
from coopenv.observers.robust.update import set_anchor, update


@wp.func
def clear(model: Any, memory: Any, world: int, i: int):
    """Forget an earlier episode, down to what is only used within a tick: equal states are equal in every bit."""
    memory.belief[world, i] = Belief()
    memory.search[world, i] = Search()
    members = memory.member.shape[2]
    for n in range(members):
        memory.member[world, i, n] = Member()
        memory.scratch[world, n] = Scratch()
        for k in range(members):
            memory.P[world, i, n, k] = mat66d()
            memory.scratch_blocks[world, n, k] = mat66d()
    for h in range(memory.hypothesis.shape[2]):
        memory.hypothesis[world, i, h] = Hypothesis()
    for n in range(model.agents):
        memory.line[world, n] = Line()


@wp.func
def start_belief(model: Any, state: Any, memory: Any, world: int, i: int):
    """Start at the initial estimate; one that is too uncertain to linearise about is only a prior for the search."""
    R = orthonormalise(wide_matrix(state.estimate_rotation[world, i]))
    p = R * wide_vector(state.estimate_position[world, i])
    P = model.start.covariance[i]
    begin_belief(memory, world, i, R, p, P)
    memory.belief[world, i].odometry.R = wp.identity(3, wp.float64)
    memory.belief[world, i].depends_on = possible_dependencies(model, i)
    set_anchor(memory, world, i, P, 0)
    if not is_known(P):
        begin_search(memory, world, i, R, p, P)


@wp.func
def restart_belief(model: Any, memory: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Believe in a pose alone."""
    begin_belief(memory, world, i, R, p, P)
    memory.belief[world, i].depends_on = possible_dependencies(model, i)
    memory.belief[world, i].missed_share = wp.float64(0.0)


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
def write(state: Any, memory: Any, world: int, i: int):
    """Write the pose believed, while it is searched for that of the best hypothesis."""
    if memory.search[world, i].active == 0:
        p = memory.member[world, i, 0].p
        write_pose(state, world, i, memory.member[world, i, 0].R, p, memory.P[world, i, 0, 0])
        return
    R = memory.search[world, i].prior.R
    p = memory.search[world, i].prior.p
    P = memory.search[world, i].prior.P
    h = best_hypothesis(memory, world, i)
    if h >= 0:
        R = memory.hypothesis[world, i, h].R
        p = memory.hypothesis[world, i, h].p
        P = memory.hypothesis[world, i, h].P
    write_pose(state, world, i, R, p, P)


def make_start(clear_messages: Any, receive: Any) -> Any:
    """Return the Warp function that starts an observer.

    Args:
        clear_messages: (model, memory, world, i): forget what was sent and received.
        receive: (model, state, memory, world, i): take what the radio has delivered.
    """

    @wp.func
    def start(model: Any, state: Any, memory: Any, world: int, i: int):
        """Start the observer of a vehicle, and take what its leaders have sent."""
        clear(model, memory, world, i)
        clear_messages(model, memory, world, i)
        start_belief(model, state, memory, world, i)
        receive(model, state, memory, world, i)

    return start


def make_estimate(receive: Any, fuse_messages: Any) -> Any:
    """Return the Warp function of one tick.

    Args:
        receive: (model, state, memory, world, i): take what the radio has delivered.
        fuse_messages: (model, state, memory, world, i, tick): fuse what has been received.
    """

    @wp.func
    def search(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
        """Search for the pose; with one hypothesis left, go on with the prior if it is that, else with this frame."""
        if not advance_search(model, state, memory, world, i, now):
            return
        confirmed = confirms_prior(memory, world, i)
        R = memory.search[world, i].prior.R
        p = memory.search[world, i].prior.p
        P = memory.search[world, i].prior.P
        if not confirmed:
            R = memory.hypothesis[world, i, 0].R
            p = memory.hypothesis[world, i, 0].p
            P = memory.hypothesis[world, i, 0].P
        restart_belief(model, memory, world, i, R, p, P)
        fuse_messages(model, state, memory, world, i, now.tick)
        if confirmed:
            memory.search[world, i].active = 0
            update(model, state, memory, world, i, now)
        elif resect(model, state, memory, world, i, now.tick) and is_known(memory.P[world, i, 0, 0]):
            memory.search[world, i].active = 0

    @wp.func
    def estimate(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
        """Take one camera tick of one vehicle, whose messages have been delivered."""
        state.nis[world, i] = wp.float64(0.0)
        state.nis_dof[world, i] = 0
        receive(model, state, memory, world, i)
        dR = orthonormalise(wide_matrix(state.increment_rotation[world, i]))
        dp = wide_vector(state.increment_translation[world, i])
        R = memory.belief[world, i].odometry.R
        memory.belief[world, i].odometry.R = orthonormalise(R * dR)
        memory.belief[world, i].odometry.p = memory.belief[world, i].odometry.p + R * dp
        rotation, translation = odometry_variances(model, now.period)
        if memory.search[world, i].active == 1:
            propagate_search(memory, world, i, dR, dp, rotation, translation)
            if now.due:
                search(model, state, memory, world, i, now)
        else:
            propagate(memory, world, i, 0, dR, dp, rotation, translation)
            fuse_messages(model, state, memory, world, i, now.tick)
            if now.due:
                update(model, state, memory, world, i, now)
        write(state, memory, world, i)
        if now.due:
            state.corrected_tick[world, i] = now.tick

    return estimate
