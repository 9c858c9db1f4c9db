"""Bearings of a frame as measurements of the belief, or of one search hypothesis in its place.

A measurement is set once per frame, with the point at which the bearing aims, and linearised at the current estimates
(linearisation.py).
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import THIRD, block3, exp_so3
from coopenv.observers.contract import MIN_BEARING_STD
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    Pose,
    averaging_time,
    between,
    is_known,
    mat66d,
    odometry_noise,
    position_variance,
    vec3d,
)
from coopenv.observers.robust.joint_state import corrected, index_of, mounting_of, mounting_variances
from coopenv.observers.robust.memory import ERRORS, FOCAL_ERROR, LATENCY_ERROR, MOUNTING, BearingFrame
from coopenv.observers.robust.messages import is_circular
from coopenv.observers.robust.sources import is_excluded, slot_of, take_slot
from coopenv.world.camera import VISIBLE, body_bearing, camera_to_body, mapped_position
from coopenv.world.nearby import agent_of, box_of_entry, entry_at, entry_count
from coopenv.world.v2x import fresh
from coopenv.world.warp_internals import device_function, subroutine

HALF_ACCELERATION = 0.5 * constants.MAX_ACCELERATION
UNIFORM_VARIANCE = THIRD
"""Variance of a uniform distribution over [-1, 1], the paper's noise on the image plane."""
ROUNDING_VARIANCE = 1.0 / 12.0  # of a number that is rounded to integers
MOST_FOCAL_EFFECT = 0.25  # squared turn of a bearing by a relative error of the focal length, at 45 degrees


@device_function
def bearing_variance(model: Any, i: int):
    """Return the variance of a bearing of vehicle i per tangent axis, with that of pixels which are rounded.

    A correlated error counts as white noise.
    """
    std = wp.float64(model.noise[i].bearing)
    variance = std * std
    if model.noise[i].bearing_paper == 1:
        variance = variance * wp.float64(UNIFORM_VARIANCE)
    if model.camera[i].quantise == 1:
        focal = wp.float64(wp.min(model.camera[i].focal_length))
        variance += wp.float64(ROUNDING_VARIANCE) / (focal * focal)
    correlated = wp.float64(model.noise[i].bearing_counted)
    variance += correlated * correlated
    return wp.max(variance, wp.float64(MIN_BEARING_STD) * wp.float64(MIN_BEARING_STD))


@device_function
def set_bearing_measurement(memory: Any, world: int, i: int, n: int, member: int, b: Any, point: Any, variance: Any):
    """Set the n-th bearing b, to a point in the body frame of a member, or (member 0) in the map.

    `variance` is the point's per axis, m^2, without the member's own.
    """
    memory.measurement[world, i, n].member = member
    memory.measurement[world, i, n].bearing = b
    memory.measurement[world, i, n].point = point
    memory.measurement[world, i, n].variance = variance
    memory.measurement[world, i, n].source = -1
    memory.measurement[world, i, n].is_reading = 0
    memory.measurement[world, i, n].rows = 2


@device_function
def is_received(model: Any, state: Any, memory: Any, world: int, i: int, box: int, tick: int) -> bool:
    """Return whether a fresh report in a box is received and valid; False for a landmark, whose box is below 0.

    A vehicle without a known pose sends no report, so that a correct report contains one.
    """
    if box < 0:
        return False
    if not fresh(model, state, world, i, box, tick) or memory.inbox[world, i, box].valid == 0:
        return False
    return is_known(mat66d(memory.inbox[world, i, box].P))


@device_function
def possible_speed(memory: Any, world: int, i: int):
    """Return a possible speed, m/s, of a vehicle of unknown twist: the own speed and the speed of a start from rest."""
    return wp.length(memory.belief[world, i].mean_v) + wp.float64(constants.MAX_ACCELERATION * constants.MEAN_TIME)


@device_function
def received_variance(model: Any, memory: Any, world: int, i: int, box: int, frame: BearingFrame):
    """Return the variance per axis, m^2, of the reported position, as it counts in the search.

    Hypotheses are tracked through many frames, and its error is nearly the same in all of them.
    """
    variance = position_variance(memory.inbox[world, i, box].P) * wp.float64(THIRD)
    age = wp.float64(frame.tick - memory.inbox[world, i, box].tick) * model.camera_period
    gone = possible_speed(memory, world, i) * age
    return factor_in_search(memory, world, i, frame) * (variance + gone * gone)


@device_function
def factor_in_search(memory: Any, world: int, i: int, frame: BearingFrame):
    """Return the factor of a variance of a position of which the error is the same in all frames of a search."""
    factor = wp.float64(constants.SQUARED_MARGIN)
    if memory.search[world, i].hypotheses > 0:
        factor = wp.max(factor, wp.float64(constants.MEAN_TIME) / frame.period)
    return factor


@device_function
def set_mapped_point(model: Any, state: Any, memory: Any, world: int, i: int, frame: BearingFrame, target: int):
    """Set the point, the source and the accuracy of the frame's next bearing, one to a landmark.

    Of tracked landmarks, the error on the map is considered, see `project`. Otherwise it counts as noise that is the
    same in several frames.
    """
    point = vec3d(mapped_position(model, state, world, i, target))
    std = wp.float64(model.landmark_std[target])
    variance = std * std
    q = int(-1)
    if frame.searching == 0:
        q = take_slot(memory, world, i, target, frame.tick, True, model.camera_period)
        if q >= 0:
            memory.source[world, i, q].map_variance = variance
            variance = wp.float64(0.0)
        else:
            variance *= frames_in(wp.float64(constants.CONSIDERED_LINEARISATION_TIME), frame.period)
    else:
        variance *= factor_in_search(memory, world, i, frame)
    set_bearing_measurement(memory, world, i, frame.bearings, 0, vec3d(), point, variance)
    memory.measurement[world, i, frame.bearings].source = q


@wp.func
def frames_in(time: Any, period: Any):
    """Return the number of frames, one every `period` (s), in a time (s): at least 1."""
    return wp.max(time / period, wp.float64(1.0))


@device_function
def step_since_report(model: Any, state: Any, memory: Any, world: int, i: int, tick: int, member: int):
    """Return a member's motion by its broadcast odometry since its last fused report, and the tick of its end."""
    last = memory.member[world, i, member].report
    box = memory.member[world, i, member].box
    if is_received(model, state, memory, world, i, box, tick) and memory.inbox[world, i, box].tick > last.tick:
        return between(last.odometry, memory.inbox[world, i, box].odometry), memory.inbox[world, i, box].tick
    return Pose(wp.identity(3, wp.float64), vec3d()), last.tick


@device_function
def set_measurement_of_member(
    model: Any, state: Any, memory: Any, world: int, i: int, frame: BearingFrame, member: int, b: Any
) -> bool:
    """Set the frame's next bearing as one to a member that has moved since its last fused report.

    The member is propagated by its broadcast odometry, and from there by its last twist. Before a second report its
    twist is unknown, and the bearing is not used; the function returns whether it is. Errors that are the same in
    several frames count once in all of them.
    """
    step, stands = step_since_report(model, state, memory, world, i, frame.tick, member)
    gone = step.p
    passed = wp.float64(stands - memory.member[world, i, member].report.tick) * model.camera_period
    variance = odometry_noise(model, i, passed)[1]
    age = wp.float64(frame.tick - stands) * model.camera_period - frame.age
    if age != wp.float64(0.0):
        away = wp.float64(HALF_ACCELERATION) * age * age
        time = wp.abs(age)
        variance += odometry_noise(model, i, time)[1] * frames_in(time, frame.period) + away * away
        if memory.member[world, i, member].has_twist == 0:
            return False
        half_turn = memory.member[world, i, member].w * (wp.float64(0.5) * age)
        gone = gone + step.R * (exp_so3(half_turn) * memory.member[world, i, member].v * age)
        averaged = frames_in(averaging_time(model, i), frame.period)
        variance += memory.member[world, i, member].velocity_variance * age * age * averaged
    set_bearing_measurement(memory, world, i, frame.bearings, member, b, gone, variance)
    return True


@device_function
def set_measurement_of_target(
    model: Any, state: Any, memory: Any, world: int, i: int, frame: BearingFrame, entry: int, b: Any
) -> bool:
    """Set the frame's next measurement to one of an entry's target, with a bearing b; return whether it is usable."""
    target = agent_of(state, model.kept, world, i, entry)
    sender = target - model.landmarks
    if frame.searching == 1 and is_excluded(memory, world, i, slot_of(memory, world, i, target)):
        return False
    if sender < 0:
        set_mapped_point(model, state, memory, world, i, frame, target)
        memory.measurement[world, i, frame.bearings].bearing = b
        return True
    if frame.searching == 1:
        box = box_of_entry(model, entry)
        received = is_received(model, state, memory, world, i, box, frame.tick)
        if received:
            variance = received_variance(model, memory, world, i, box, frame)
            point = memory.inbox[world, i, box].pose.p
            set_bearing_measurement(memory, world, i, frame.bearings, 0, b, point, variance)
        return received
    member = index_of(memory, world, i, sender)
    if member == 0:
        return False
    q = memory.member[world, i, member].source
    if is_circular(memory, world, i, member) and not is_excluded(memory, world, i, q):
        return False
    usable = set_measurement_of_member(model, state, memory, world, i, frame, member, b)
    memory.measurement[world, i, frame.bearings].source = q
    memory.source[world, i, q].seen_tick = frame.tick
    return usable


@device_function
def motion_since(memory: Any, world: int, i: int, age: Any):
    """Return the vehicle's motion from now back to a time `age` (s) before, at its last twist."""
    turn = memory.belief[world, i].sample_w * age
    step = exp_so3(wp.float64(0.5) * turn) * memory.belief[world, i].sample_v * age
    there = corrected(memory, world, i, Pose(exp_so3(turn), step), age)
    return between(there, Pose(wp.identity(3, wp.float64), vec3d()))


@subroutine
def set_bearing_measurements(model: Any, state: Any, memory: Any, world: int, i: int, now: Any, searching: bool):
    """Set the usable bearings to landmarks and vehicles as measurements, and return their frame.

    While `searching`, vehicles have their reported positions, otherwise their estimated ones.
    """
    frame = BearingFrame()
    frame.searching = wp.where(searching, 1, 0)
    frame.tick = now.tick
    frame.lever = vec3d(model.camera[i].position)
    frame.variance = bearing_variance(model, i)
    frame.period = now.period
    if not searching:  # since the last frame that has corrected the belief, one tick at least
        since = wp.float64(now.tick - state.corrected_tick[world, i]) * model.camera_period
        frame.period = wp.max(since, now.period)
    R = camera_to_body(model, state, world, i)
    frame.axis = vec3d(wp.float64(R[0, 2]), wp.float64(R[1, 2]), wp.float64(R[2, 2]))
    frame.age = wp.float64(state.bearing_age[world, i]) + memory.member[world, i, ERRORS].v[2]
    frame.since.R = wp.identity(3, wp.float64)
    if frame.age != wp.float64(0.0):
        frame.since = motion_since(memory, world, i, frame.age)
    jitter = wp.float64(model.camera[i].latency_jitter)
    frame.jitter = jitter * jitter
    focal = memory.P[world, i, ERRORS, ERRORS][FOCAL_ERROR, FOCAL_ERROR]
    latency = memory.P[world, i, ERRORS, ERRORS][LATENCY_ERROR, LATENCY_ERROR]
    if not searching:
        frame.mounting = mounting_of(memory, world, i)
        frame.errors = wp.where(wp.max(focal, latency) > wp.float64(constants.MIN_VARIANCE), ERRORS, 0)
    else:
        frame.variance += mounting_variances(model, i)[0] + wp.float64(MOST_FOCAL_EFFECT) * focal
        frame.jitter += latency
    kept = model.kept
    for n in range(entry_count(model, state, world, i)):
        entry = entry_at(model, state, kept, world, i, n)
        if state.sight[world, i, entry] == VISIBLE:
            b = vec3d(body_bearing(model, state, world, i, entry))
            if searching and mounting_of(memory, world, i) > 0:
                b = memory.member[world, i, MOUNTING].pose.R * b
            if set_measurement_of_target(model, state, memory, world, i, frame, entry, b):
                frame.bearings += 1
    frame.jitter *= wp.float64(frame.bearings)  # it is the same for all of them
    return frame


@device_function
def map_variance_of(memory: Any, world: int, i: int, n: int):
    """Return the variance of the n-th measurement's landmark on the map that is considered, m^2 per axis."""
    q = memory.measurement[world, i, n].source
    variance = wp.float64(0.0)
    if memory.belief[world, i].map_errors == 1 and q >= 0:
        variance = memory.source[world, i, q].map_variance
    return variance


@device_function
def linearisation_variance(memory: Any, world: int, i: int, n: int, turn: Any, u: Any, distance: Any, period: Any):
    """Return the variance of the n-th bearing's second-order linearisation error, rad^2.

    With errors s of the relative position along the line of sight u and t across it, the direction is t / (d + s). Its
    term t s / d^2 is not linear. That error is correlated over a time, so that all frames of that time, one every
    `period`, count as one. `turn` rotates from the member's body to the vehicle's.
    """
    along, across = relative_spread(memory, world, i, n, turn, u)
    square = distance * distance
    return linearised_frames(memory, world, i, n, period) * along * across / (square * square)


@device_function
def linearised_frames(memory: Any, world: int, i: int, n: int, period: Any):
    """Return how many frames have the same linearisation error of the n-th measurement."""
    time = wp.float64(constants.LINEARISATION_TIME)
    considered = memory.measurement[world, i, n].member > 0
    if considered or map_variance_of(memory, world, i, n) > wp.float64(0.0):
        time = wp.float64(constants.CONSIDERED_LINEARISATION_TIME)
    return frames_in(time, period)


@device_function
def relative_spread(memory: Any, world: int, i: int, n: int, turn: Any, u: Any):
    """Return the variances, m^2, of the n-th target's relative position along a direction u, and across it.

    The latter is the sum of two axes.
    """
    member = memory.measurement[world, i, n].member
    V = block3(memory.P[world, i, 0, 0], 3, 3)
    latency = memory.P[world, i, ERRORS, ERRORS][LATENCY_ERROR, LATENCY_ERROR]
    if latency > wp.float64(constants.MIN_VARIANCE):  # at the exposure
        v = memory.belief[world, i].mean_v
        c = memory.P[world, i, ERRORS, 0][LATENCY_ERROR]
        common = wp.outer(v, vec3d(c[3], c[4], c[5]))
        V = V - common - wp.transpose(common) + latency * wp.outer(v, v)
    mapped = map_variance_of(memory, world, i, n)
    along = wp.dot(u, V * u) + mapped
    total = wp.trace(V) + wp.float64(3.0) * mapped
    if member > 0:
        # of V + turn W turn^T - C turn^T - turn C^T
        W = block3(memory.P[world, i, member, member], 3, 3)
        C = block3(memory.P[world, i, 0, member], 3, 3)
        w = wp.transpose(turn) * u
        along += wp.dot(w, W * w) - wp.float64(2.0) * wp.dot(u, C * w)
        total += wp.trace(W) - wp.float64(2.0) * wp.ddot(C, turn)
    along = wp.max(along, wp.float64(0.0))
    return along, wp.max(total - along, wp.float64(0.0))
