"""The sources of a vehicle's information: a slot each for its sensors, senders and landmarks, with their monitors."""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import Pose, errors_by_rows, forward, mat33d, mat63d, mat66d, vec3d
from coopenv.observers.robust.memory import ERRORS, SENDER_SLOTS, SOURCES, BlockSums, GuardTotals, SourceMonitor, fill
from coopenv.world.camera import VISIBLE
from coopenv.world.warp_internals import device_function, subroutine

VELOCITY, PRIOR, FOCAL, CAMERA, GYRO = 0, SOURCES - 4, SOURCES - 3, SOURCES - 2, SOURCES - 1
"""Slots of the own velocity, initial position, focal length, camera's mounting and angular velocity; slots of senders
and landmarks are behind the first."""
NO_TARGET = -1


@device_function
def is_seen(state: Any, world: int, i: int, entry: int, tick: int) -> bool:
    """Return whether the target of an entry is measured at a tick, by the camera or by another sensor."""
    for sensor in range(state.reading_tick.shape[2]):
        if state.reading_tick[world, i, sensor, entry] == tick:
            return True
    return state.sight[world, i, entry] == VISIBLE


@wp.func
def is_sender(q: int) -> bool:
    """Return whether a slot is one of senders."""
    return q > 0 and q <= SENDER_SLOTS


@wp.func
def is_own(q: int) -> bool:
    """Return whether a slot is one of the own sensors."""
    return q <= VELOCITY or q >= PRIOR


@device_function
def guard_factor(memory: Any, world: int, i: int):
    """Return the factor on the covariance of the own pose that is stated and broadcast."""
    return wp.max(memory.belief[world, i].guard.factor, wp.float64(1.0))


@device_function
def guarded_covariance(memory: Any, world: int, i: int):
    """Return the covariance (6, 6) of the own pose that is stated and broadcast, likely faults included."""
    return guard_factor(memory, world, i) * (memory.P[world, i, 0, 0] + memory.fault_mixture[world, i])


@device_function
def clear_drift(memory: Any, world: int, i: int, q: int):
    """Begin the sums of a sender's drift anew."""
    memory.source[world, i, q].drift = vec3d()
    memory.source[world, i, q].drift_vector = vec3d()
    memory.source[world, i, q].drift_ratio = wp.float64(0.0)
    memory.source[world, i, q].drift_time = wp.float64(0.0)
    memory.source[world, i, q].drift_information = mat33d()


@subroutine
def clear_source(memory: Any, world: int, i: int, q: int):
    """Clear the information about a source."""
    memory.source[world, i, q].rejected = wp.float64(0.0)
    memory.source[world, i, q].vector = vec3d()
    memory.source[world, i, q].sum = vec3d()
    if is_sender(q):
        clear_drift(memory, world, i, q)
    memory.source[world, i, q].information = mat33d()
    fill(memory.sensitivity[world, i, q], mat63d())
    fill(memory.information[world, i, q], mat33d())
    if is_sender(q):
        for c in range(SOURCES):
            memory.information[world, i, c, q] = mat33d()


@device_function
def release_slot(memory: Any, world: int, i: int, q: int):
    """Empty a slot."""
    clear_source(memory, world, i, q)
    memory.source[world, i, q] = SourceMonitor()
    memory.source[world, i, q].target = NO_TARGET


@device_function
def begin_monitors(memory: Any, world: int, i: int):
    """Begin without any information about the sources."""
    memory.fault_mixture[world, i] = mat66d()
    memory.belief[world, i].guard = GuardTotals()
    for q in range(SOURCES):
        clear_source(memory, world, i, q)
        memory.source[world, i, q].guard = BlockSums()
    for k in range(3):
        memory.sensitivity[world, i, PRIOR, 0][k + 3, k] += wp.float64(1.0)


@device_function
def begin_sources(memory: Any, world: int, i: int):
    """Begin without sources, so that none is excluded."""
    for q in range(SOURCES):
        release_slot(memory, world, i, q)
    begin_monitors(memory, world, i)


@device_function
def slot_of(memory: Any, world: int, i: int, target: int) -> int:
    """Return the slot of a target, -1 if it has none."""
    for q in range(1, SOURCES):
        if memory.source[world, i, q].target == target:
            return q
    return -1


@device_function
def member_of(memory: Any, world: int, i: int, q: int) -> int:
    """Return the member that has a slot, 0 if there is none."""
    for k in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if memory.member[world, i, k].source == q:
            return k
    return 0


@device_function
def longest_unseen_slot(memory: Any, world: int, i: int, first: int, last: int) -> int:
    """Return a free slot among some slots, else the slot of the source unseen for longest; -1 if members hold all."""
    found = int(-1)
    for q in range(first, last):
        if memory.source[world, i, q].target == NO_TARGET:
            return q
        if member_of(memory, world, i, q) == 0:
            if found < 0 or memory.source[world, i, q].seen_tick < memory.source[world, i, found].seen_tick:
                found = q
    return found


@device_function
def take_slot(memory: Any, world: int, i: int, target: int, tick: int, landmark: bool, period: Any) -> int:
    """Return the slot of a target, a new one if there is room, else -1; note that it is in view.

    A member needs a slot, which it takes from a source that is no member; a landmark takes one only from a source that
    has been out of view for `MEAN_TIME`.
    """
    q = slot_of(memory, world, i, target)
    if q < 0:
        first = wp.where(landmark, 1 + SENDER_SLOTS, 1)
        q = longest_unseen_slot(memory, world, i, first, wp.where(landmark, PRIOR, 1 + SENDER_SLOTS))
        if landmark and q >= 0 and memory.source[world, i, q].target != NO_TARGET:
            unseen = wp.float64(tick - memory.source[world, i, q].seen_tick) * period
            q = wp.where(unseen > wp.float64(constants.MEAN_TIME), q, -1)
        if q >= 0:
            release_slot(memory, world, i, q)
            memory.source[world, i, q].target = target
    if q >= 0:
        memory.source[world, i, q].seen_tick = tick
    return q


@device_function
def is_active(memory: Any, world: int, i: int, q: int) -> bool:
    """Return whether a slot is of a source that is used."""
    active = is_own(q) or memory.source[world, i, q].target != NO_TARGET
    return active and memory.source[world, i, q].excluded == 0


@device_function
def is_excluded(memory: Any, world: int, i: int, q: int) -> bool:
    """Return whether the source of a slot is excluded; False for -1."""
    if q < 0:
        return False
    return memory.source[world, i, q].excluded == 1


@device_function
def is_rejected(memory: Any, world: int, i: int, q: int) -> bool:
    """Return whether the gate rejects many bearings to a source."""
    return memory.source[world, i, q].rejected > wp.float64(constants.FOUND_SHARE)


@device_function
def note_rejection(memory: Any, world: int, i: int, q: int, weight: Any):
    """Add a bearing that the gate rejects, of a weight, to a source's share of rejected ones.

    A landmark that had fitted, without evidence against it, and is rejected now has a fault that begins now.
    """
    before = is_rejected(memory, world, i, q)
    rejected = memory.source[world, i, q].rejected + weight
    memory.source[world, i, q].rejected = rejected
    fitted = memory.source[world, i, q].fitted_time > wp.float64(constants.MEAN_TIME)
    fitted = fitted and memory.source[world, i, q].ratio < wp.float64(constants.OFFSET_GATE)
    if fitted and not before and is_rejected(memory, world, i, q) and not is_sender(q):
        clear_source(memory, world, i, q)
        memory.source[world, i, q].rejected = rejected
        memory.source[world, i, q].fitted_time = wp.float64(0.0)


@device_function
def propagate_sources(memory: Any, world: int, i: int, step: Pose, G: Any, dt: Any):
    """Carry the sensitivities through an increment of odometry over dt; G: of the own error by the odometry's."""
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            Phi = forward(step, memory.sensitivity[world, i, q, 0])
            Phi = Phi + errors_by_rows(G, memory.sensitivity[world, i, q, ERRORS])
            if q == VELOCITY:
                E = dt * wp.transpose(step.R)
                for k in range(3):
                    Phi[k + 3] = Phi[k + 3] + E[k]
            if q == GYRO:
                for k in range(6):
                    Phi[k] = Phi[k] - vec3d(G[k, 0], G[k, 1], G[k, 2])
            memory.sensitivity[world, i, q, 0] = Phi
