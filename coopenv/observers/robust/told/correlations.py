"""How senders' errors correlate with those of the vehicles that they hear: told, kept, looked up.

With every message a vehicle tells of some members n the correlation A^-1 C B^-T of its own error with n's, A and B
being Cholesky factors of their covariances and C their cross-covariance. That fits the report that it comes with. Where
messages are lost, what was told of a report a little older or newer stands in: correlations change more slowly than
errors do.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, sheared
from coopenv.estimation.so3 import exp_so3, skew
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.memory import Pose, Report, mat66d, mat66f, vec3d
from coopenv.observers.robust.told.memory import Correlation, Known
from coopenv.observers.robust.tracklets import arrived, clear_messages, marker_jacobian, receive, send
from coopenv.world.device_function import device_function
from coopenv.world.faults import content_tick


@wp.func
def factor(P: Any):
    """Return the Cholesky factor of a 6x6 matrix."""
    L11, L21, L22, _, _ = cholesky6(block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3))
    return algebra.lower_blocks(L11, L21, L22)


@wp.func
def bit_count(mask: wp.uint64) -> int:
    """Return how many bits are set."""
    count = int(0)
    rest = wp.uint64(mask)
    while rest != wp.uint64(0):
        rest = rest & (rest - wp.uint64(1))
        count += 1
    return count


@device_function
def rank(model: Any, vehicle: int, report: Report) -> int:
    """Return a number that is larger for vehicles that depend on more others, and then for later ones."""
    return bit_count(report.depends_on) * model.vehicles + vehicle


@device_function
def next_told(model: Any, memory: Any, world: int, i: int, last: int) -> int:
    """Return the considered member of the highest rank below that of member `last` (0: any), 0 if there is none."""
    found = int(0)
    best = int(-1)
    limit = int(2147483647)
    if last > 0:
        limit = rank(model, memory.member[world, i, last].vehicle, memory.member[world, i, last].report)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            at = rank(model, memory.member[world, i, n].vehicle, memory.member[world, i, n].report)
            if at > best and at < limit:
                found = n
                best = at
    return found


@device_function
def own_correlation(model: Any, memory: Any, world: int, i: int, n: int):
    """Return the correlation, 6x6 in whole steps, of the vehicle's left error at its marker with that of a member."""
    P = memory.P[world, i, 0, 0]
    C = memory.P[world, i, 0, n]
    marker = vec3d(model.scene.marker[model.landmarks + i])
    if wp.length_sq(marker) > wp.float64(0.0):
        P = sheared(P, -skew(marker))
        C = marker_jacobian(marker) * C
    X = algebra.inverse_factor(P) * C * wp.transpose(algebra.inverse_factor(memory.P[world, i, n, n]))
    steps = wp.float64(constants.STEPS)
    for k in range(6):
        for j in range(6):
            X[k, j] = wp.clamp(wp.rint(steps * X[k, j]), -steps, steps)
    return mat66f(X)


@wp.func
def no_correlation():
    """Return what stands where nothing is told."""
    none = Correlation()
    none.vehicle = -1
    return none


@device_function
def has_news(model: Any, memory: Any, world: int, i: int, tick: int) -> bool:
    """Return whether a report at a tick is the first of an interval of `NEWS_TIME`, and note that it is."""
    time = wp.float64(tick) * model.camera_period + wp.float64(constants.SAME_TIME)
    interval = int(wp.floor(time / wp.float64(constants.NEWS_TIME))) + 1
    if interval == memory.belief[world, i].told_interval:
        return False
    memory.belief[world, i].told_interval = interval
    return True


@device_function
def tell(model: Any, memory: Any, world: int, i: int, slot: int):
    """Tell of correlations with the members that depend on most others."""
    memory.outbox[world, i, slot].news = 1
    n = int(0)
    for c in range(memory.correlation.shape[3]):
        told = no_correlation()
        if c == 0 or n > 0:
            n = next_told(model, memory, world, i, n)
            if n > 0:
                told.vehicle = memory.member[world, i, n].vehicle
                told.tick = memory.member[world, i, n].report.tick
                told.matrix = own_correlation(model, memory, world, i, n)
        memory.outbox_correlation[world, i, slot, c] = told


@device_function
def send_told(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Send a report if one is due; the first of an interval counts, and tells of correlations."""
    send(model, state, memory, world, i, tick)
    if tick % model.radio.period == 0:
        slot = tick % model.radio.slots
        odometry = memory.outbox[world, i, slot].odometry
        turn = vec3d(wp.vec3f(algebra.log_so3(odometry.R)))  # in single precision
        memory.outbox[world, i, slot].odometry = Pose(exp_so3(turn), vec3d(wp.vec3f(odometry.p)))
        if memory.outbox[world, i, slot].valid == 1:
            if has_news(model, memory, world, i, tick):
                tell(model, memory, world, i, slot)


@device_function
def clear_told(model: Any, memory: Any, world: int, i: int):
    """Forget what was sent and received."""
    clear_messages(model, memory, world, i)
    for c in range(memory.correlation.shape[3]):
        for slot in range(model.radio.slots):
            memory.outbox_correlation[world, i, slot, c] = no_correlation()
        for sender in range(model.vehicles):
            memory.correlation[world, i, sender, c] = no_correlation()
    for a in range(memory.known.shape[1]):
        memory.known[world, a] = Known()
        for b in range(memory.known.shape[1]):
            memory.factor[world, a, b] = mat66d()


@device_function
def receive_told(model: Any, state: Any, memory: Any, world: int, i: int):
    """Take what the radio has delivered at this tick."""
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        sent = arrived(state, memory, world, i, sender)
        if sent >= 0:
            slot = content_tick(model, state, world, sender, sent) % model.radio.slots
            if memory.outbox[world, sender, slot].news == 1:
                later = state.inbox_stamp[world, i, sender] - memory.outbox[world, sender, slot].tick
                for c in range(memory.correlation.shape[3]):
                    memory.correlation[world, i, sender, c] = memory.outbox_correlation[world, sender, slot, c]
                    memory.correlation[world, i, sender, c].tick += later  # ages are told, not ticks
    receive(model, state, memory, world, i)


@device_function
def place_of(memory: Any, world: int, i: int, sender: int, vehicle: int) -> int:
    """Return where it is kept what a sender has told of a vehicle, -1 if it has told nothing."""
    for c in range(memory.correlation.shape[3]):
        if memory.correlation[world, i, sender, c].vehicle == vehicle:
            return c
    return -1


@device_function
def matrix_of(memory: Any, world: int, i: int, sender: int, c: int):
    """Return a correlation that is kept."""
    return mat66d(memory.correlation[world, i, sender, c].matrix) * (wp.float64(1.0) / wp.float64(constants.STEPS))


@wp.func
def is_near(model: Any, tick: int, other: int) -> bool:
    """Return whether what is told of a report of one tick counts for that of another."""
    return wp.float64(wp.abs(tick - other)) * model.camera_period < wp.float64(constants.TOLD_TIME)


@device_function
def correlation_of(model: Any, memory: Any, world: int, i: int, n: int, k: int, met: bool):
    """Return (is known, is told, matrix) of the correlation of the new error of member n with that of member k.

    Member n has told it; or k, which counts where they have just met; or, where neither hears the other, both have told
    of a third one, of several that on which they depend most: that is only likely. What is told of reports far apart
    does not count.
    """
    sender = memory.member[world, i, n].vehicle
    other = memory.member[world, i, k].vehicle
    c = place_of(memory, world, i, sender, other)
    if c >= 0:
        near = is_near(model, memory.correlation[world, i, sender, c].tick, memory.member[world, i, k].report.tick)
        return near, True, matrix_of(memory, world, i, sender, c)
    c = place_of(memory, world, i, other, sender)
    if c >= 0:
        near = is_near(model, memory.correlation[world, i, other, c].tick, memory.member[world, i, n].report.tick)
        return met and near, True, wp.transpose(matrix_of(memory, world, i, other, c))
    most = wp.float64(-1.0)
    shared = mat66d()
    for a in range(memory.correlation.shape[3]):
        third = memory.correlation[world, i, sender, a].vehicle
        if third >= 0:
            b = place_of(memory, world, i, other, third)
            if b >= 0:
                tick = memory.correlation[world, i, other, b].tick
                if is_near(model, memory.correlation[world, i, sender, a].tick, tick):
                    X = matrix_of(memory, world, i, sender, a) * wp.transpose(matrix_of(memory, world, i, other, b))
                    size = wp.ddot(X, X)
                    if size > most:
                        most = size
                        shared = X
    return most >= wp.float64(0.0), False, shared
