"""One tick of one vehicle's observer, and its start.

One vehicle keeps a joint belief about itself and the vehicles that it hears. Bearings, to landmarks and to vehicles,
correct that belief; a neighbour's messages add what the neighbour has learnt since its last one, and no more. So
nothing that was heard before counts twice, and the neighbour's slowly varying error is no white noise. Without a useful
prior, or when most bearings contradict the belief, the pose is searched for; meanwhile the vehicle sends nothing.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import sheared, symmetric_part
from coopenv.estimation.so3 import orthonormalise, skew
from coopenv.observers.robust.algebra import distance_squared, is_known, odometry_noise
from coopenv.observers.robust.belief import begin_belief, own_estimate
from coopenv.observers.robust.constants import SAME_PRIOR, SURE
from coopenv.observers.robust.measurements import RESECTION, TRACKING, set_lines, time_between
from coopenv.observers.robust.memory import Estimate, Pose, clear, mat33d, vec3d
from coopenv.observers.robust.mounting import walk_mounting
from coopenv.observers.robust.odometry import begin_errors, increment_noise, propagate_own, take_odometry, walk_errors
from coopenv.observers.robust.search import advance_search, begin_search, propagate_search, put_off
from coopenv.observers.robust.tracklets import bit_of
from coopenv.observers.robust.update import is_sound, lose, resect, set_anchor, update
from coopenv.world.device_function import device_function
from coopenv.world.faults import start_covariance

BELIEVING, SEARCHING, FOUND = 0, 1, 2  # how a vehicle stands to its pose; found in the search at this tick


@device_function
def restart_belief(model: Any, memory: Any, world: int, i: int, estimate: Estimate):
    """Believe in a pose alone; on all that may be heard it may depend."""
    begin_belief(memory, world, i, estimate)
    memory.belief[world, i].missed_share = wp.float64(0.0)
    bits = wp.uint64(0)
    for n in range(model.target_count[i]):
        if model.targets[i, n] >= model.landmarks:
            bits = bits | bit_of(model.targets[i, n] - model.landmarks)
    memory.belief[world, i].depends_on = bits


@device_function
def write(state: Any, memory: Any, world: int, i: int):
    """Write the pose believed, while it is searched for that of the best hypothesis, as the state holds it.

    There positions are in the body, and covariances over (2 lambda, p), to first order.
    """
    estimate = own_estimate(memory, world, i)
    if memory.search[world, i].active == 1:
        estimate = memory.search[world, i].prior
        if memory.search[world, i].hypotheses > 0:
            estimate = memory.hypothesis[world, i, 0].estimate
    position = wp.transpose(estimate.pose.R) * estimate.pose.p
    P = symmetric_part(sheared(estimate.P, skew(position)))
    state.estimate_rotation[world, i] = type(state.estimate_rotation[world, i])(estimate.pose.R)
    state.estimate_position[world, i] = type(state.estimate_position[world, i])(position)
    state.covariance[world, i] = type(state.covariance[world, i])(P)


def make_start(begin_messages: Any, receive: Any) -> Any:
    """Return the Warp function that starts an observer, given those that begin anew and take what the radio delivers.

    The former is called with the belief that the vehicle starts with.
    """

    @device_function
    def start(model: Any, state: Any, memory: Any, world: int, i: int):
        """Start at the initial estimate, and take what the leaders have sent.

        An estimate that is too uncertain to linearise about is only a prior for the search.
        """
        clear(model, memory, world, i)
        memory.belief[world, i].others = 1
        begin_errors(model, memory, world, i)
        R = orthonormalise(mat33d(state.estimate_rotation[world, i]))
        initial = Estimate(
            Pose(R, R * vec3d(state.estimate_position[world, i])), start_covariance(model, state, world, i)
        )
        restart_belief(model, memory, world, i, initial)
        memory.belief[world, i].odometry.R = wp.identity(3, wp.float64)
        set_anchor(memory, world, i, initial.P, 0)
        if not is_known(initial.P):
            begin_search(memory, world, i, initial)
        begin_messages(model, memory, world, i)
        write(state, memory, world, i)
        receive(model, state, memory, world, i)

    return start


@device_function
def search(model: Any, state: Any, memory: Any, world: int, i: int, now: Any) -> int:
    """Search for the pose; with one hypothesis left, believe in the prior if it is that, else in the hypothesis."""
    if not advance_search(model, state, memory, world, i, now):
        return SEARCHING
    prior = memory.search[world, i].prior
    found = memory.hypothesis[world, i, 0].estimate
    confirmed = is_known(prior.P) and distance_squared(prior, found) < wp.float64(SAME_PRIOR)
    if confirmed:
        found = prior
    restart_belief(model, memory, world, i, found)
    return wp.where(confirmed, BELIEVING, FOUND)


@device_function
def correct(model: Any, state: Any, memory: Any, world: int, i: int, now: Any, standing: int):
    """Correct the belief by a frame; that of a pose that has just been found, take from this frame alone."""
    purpose = wp.where(standing == BELIEVING, TRACKING, RESECTION)
    frame = set_lines(model, state, memory, world, i, now.tick, time_between(model, state, world, i, now), purpose)
    if standing == BELIEVING:
        memory.search[world, i].active = 0
        update(model, state, memory, world, i, now, frame)
    elif resect(frame, memory, world, i) and is_known(wp.float64(SURE) * memory.P[world, i, 0, 0]):
        memory.search[world, i].active = 0
    else:
        put_off(memory, world, i)


def make_estimate(receive: Any, fuse_messages: Any, separate: Any) -> Any:
    """Return the Warp function of one tick.

    Args:
        receive: takes what the radio delivers.
        fuse_messages: fuses it.
        separate: at last, holds the belief against what landmarks alone say.
    """

    @device_function
    def estimate(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
        """Take one camera tick of one vehicle, whose messages have been delivered."""
        state.nis[world, i] = wp.float64(0.0)
        state.nis_dof[world, i] = 0
        receive(model, state, memory, world, i)
        step, jump = take_odometry(model, state, memory, world, i, now.period)
        walk_errors(model, memory, world, i, now.period)
        walk_mounting(model, memory, world, i, now.period)
        standing = int(BELIEVING)
        if memory.search[world, i].active == 1:
            noise = increment_noise(model, memory, world, i, step, now.period) + jump
            propagate_search(memory, world, i, step, noise)
            standing = SEARCHING
            if now.due:
                standing = search(model, state, memory, world, i, now)
        else:
            noise = odometry_noise(model, i, now.period) + jump
            propagate_own(memory, world, i, step, noise, now.period)
        if standing != SEARCHING:
            fuse_messages(model, state, memory, world, i, now.tick)
            if now.due:
                correct(model, state, memory, world, i, now, standing)
            if memory.search[world, i].active == 0 and not is_sound(own_estimate(memory, world, i)):
                lose(model, memory, world, i, now.tick)  # a message that no honest vehicle sends
        separate(model, state, memory, world, i, now)
        write(state, memory, world, i)
        if now.due:
            state.corrected_tick[world, i] = now.tick

    return estimate
