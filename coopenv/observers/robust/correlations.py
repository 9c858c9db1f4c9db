"""Correlations of a sender's error with the errors of the vehicles that it receives: broadcast, storage, regression.

With a message a vehicle broadcasts, for some members n, the correlation A^-1 C B^-T of its own error with n's. A and B
are Cholesky factors of their covariances, and C is their cross-covariance; the values fit the report in the same
message. If messages are lost, the correlation of a slightly older or newer report takes its place: correlations change
more slowly than errors.

Regression gives the covariance of a sender's new error e+ with all errors of the belief. Known are its own covariance
P+, the broadcast covariances with other members, and the covariance with the sender's previous error. The last is P+,
because the increment from the old error to the new one is not correlated with e+. With e+ = L x + w regressed on the
known errors x, the covariance with any other error y is L cov(x, y). The joint covariance stays positive definite if
that of w is. Otherwise P+ is inflated in the directions in which it is smaller than the correlations allow. All in
blocks of 6x6.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, eigen_symmetric6, exp_so3, join6, sheared, skew, symmetric_part
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.algebra import Pose, mat33d, mat66d, mat66f, vec3d
from coopenv.observers.robust.memory import Correlation, SenderReport, fill, fill_rows
from coopenv.observers.robust.messages import dependents, depends_on_own, own_report
from coopenv.observers.robust.sources import guarded_covariance, is_excluded
from coopenv.world.nearby import agent_of, box_of, box_of_entry, entry_at, entry_count, is_target
from coopenv.world.v2x import content_tick
from coopenv.world.warp_internals import device_function, subroutine

REPORT_BYTES = wp.constant(172)
CORRELATION_BYTES = wp.constant(42)
"""Sizes of a message, see `coopenv.observers.robust.messages.write`."""


@wp.func
def factor(P: Any):
    """Return the Cholesky factor of a 6x6 matrix."""
    L11, L21, L22, _, _ = cholesky6(block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3))
    return join6(L11, mat33d(), L21, L22)


@device_function
def rank(model: Any, vehicle: int, report: SenderReport) -> int:
    """Return a number that is larger for vehicles that depend on more vehicles, and then for later ones."""
    return int(wp.bit_count(report.depends_on)) * model.vehicles + vehicle


@device_function
def next_broadcast(model: Any, memory: Any, world: int, i: int, last: int) -> int:
    """Return the used member of the highest rank below that of member `last` (0: any), 0 if there is none."""
    found = int(0)
    best = int(-1)
    limit = int(2147483647)
    if last > 0:
        limit = rank(model, memory.member[world, i, last].vehicle, memory.member[world, i, last].report)
    for n in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if not is_excluded(memory, world, i, memory.member[world, i, n].source):
            at = rank(model, memory.member[world, i, n].vehicle, memory.member[world, i, n].report)
            if at > best and at < limit:
                found = n
                best = at
    return found


@subroutine
def own_correlation(model: Any, memory: Any, world: int, i: int, n: int):
    """Return the correlation, 6x6 in whole steps, of the vehicle's left error at its marker with that of a member."""
    P = guarded_covariance(memory, world, i)
    C = memory.P[world, i, 0, n]
    marker = vec3d(model.scene.marker[model.landmarks + i])
    if wp.length_sq(marker) > wp.float64(0.0):
        P = sheared(P, -skew(marker))
        one = wp.identity(3, wp.float64)
        C = join6(one, mat33d(), -skew(marker), one) * C
    X = algebra.inverse_factor(P) * C * wp.transpose(algebra.inverse_factor(memory.P[world, i, n, n]))
    steps = wp.float64(constants.STEPS)
    for k in range(6):
        for j in range(6):
            X[k, j] = wp.clamp(wp.rint(steps * X[k, j]), -steps, steps)
    return mat66f(X)


@wp.func
def no_correlation():
    """Return the entry of an empty place."""
    none = Correlation()
    none.vehicle = -1
    return none


@device_function
def start_news_interval(model: Any, memory: Any, world: int, i: int, tick: int) -> bool:
    """Begin an interval of `NEWS_TIME` if a report at a tick is its first one; return whether it is."""
    time = wp.float64(tick) * model.camera_period + wp.float64(constants.SAME_TIME)
    interval = int(wp.floor(time / wp.float64(constants.NEWS_TIME))) + 1
    if interval == memory.belief[world, i].news_interval:
        return False
    memory.belief[world, i].news_interval = interval
    return True


@device_function
def broadcast_correlations(model: Any, memory: Any, world: int, i: int, slot: int):
    """Broadcast the correlations with the members that depend on most vehicles."""
    memory.outbox[world, i, slot].carries_correlations = 1
    fill(memory.outbox_correlation[world, i, slot], no_correlation())
    n = int(0)
    for c in range(memory.correlation.shape[3]):
        n = next_broadcast(model, memory, world, i, n)
        if n == 0:
            break
        member = memory.member[world, i, n].vehicle
        tick = memory.member[world, i, n].report.tick
        broadcast = Correlation(member, tick, own_correlation(model, memory, world, i, n))
        memory.outbox_correlation[world, i, slot, c] = broadcast


@subroutine
def send_broadcast(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Send a report if one is due; the first of an interval of `NEWS_TIME` carries correlations."""
    if tick % model.radio.period == 0:
        slot = tick % model.radio.slots
        report = own_report(model, state, memory, world, i, tick)
        turn = vec3d(wp.vec3f(algebra.log_so3(report.odometry.R)))  # in single precision
        report.odometry = Pose(exp_so3(turn), vec3d(wp.vec3f(report.odometry.p)))
        memory.outbox[world, i, slot] = report
        size = wp.where(report.valid == 1, REPORT_BYTES, 0)
        if report.valid == 1:
            if start_news_interval(model, memory, world, i, tick):
                broadcast_correlations(model, memory, world, i, slot)
                for c in range(memory.correlation.shape[3]):
                    if memory.outbox_correlation[world, i, slot, c].vehicle >= 0:
                        size += CORRELATION_BYTES
        state.report_size[world, i] = size


@device_function
def clear_broadcasts(memory: Any, world: int, i: int):
    """Clear all sent and received correlations."""
    fill_rows(memory.outbox_correlation[world, i], no_correlation())
    fill_rows(memory.correlation[world, i], no_correlation())


@device_function
def copy_correlations(memory: Any, world: int, i: int, box: int, sender: int, slot: int, later: int):
    """Copy the correlations of a message, if it carries them, with ticks `later`: ages are broadcast, not ticks."""
    if memory.outbox[world, sender, slot].carries_correlations == 1:
        for c in range(memory.correlation.shape[3]):
            memory.correlation[world, i, box, c] = memory.outbox_correlation[world, sender, slot, c]
            memory.correlation[world, i, box, c].tick += later


@device_function
def clear_box_of_another(model: Any, memory: Any, world: int, i: int, box: int, sender: int):
    """Clear a box that another sender had before."""
    if model.kept > 0 and memory.inbox_sender[world, i, box] != sender:
        memory.inbox_sender[world, i, box] = sender
        memory.inbox[world, i, box].tick = -1
        fill(memory.correlation[world, i, box], no_correlation())


@subroutine
def receive_broadcast(model: Any, state: Any, memory: Any, world: int, i: int):
    """Receive the messages that the radio delivers at this tick."""
    kept = model.kept
    for n in range(entry_count(model, state, world, i)):
        entry = entry_at(model, state, kept, world, i, n)
        target = agent_of(state, kept, world, i, entry)
        sender = target - model.landmarks
        if sender >= 0 and is_target(model, i, target):
            box = box_of_entry(model, entry)
            clear_box_of_another(model, memory, world, i, box, sender)
            sent = state.inbox_tick[world, i, box]
            stamp = state.inbox_stamp[world, i, box]
            whole = state.inbox_pose_only[world, i, box] == 0
            if sent >= 0 and whole and stamp != memory.inbox[world, i, box].tick:
                content = content_tick(model, state, world, sender, sent)
                slot = content % model.radio.slots
                copy_correlations(memory, world, i, box, sender, slot, stamp - content)
                memory.inbox[world, i, box] = memory.outbox[world, sender, slot]
                memory.inbox[world, i, box].tick = stamp
    for n in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        memory.member[world, i, n].box = box_of(model, state, world, i, memory.member[world, i, n].vehicle)


@device_function
def correlation_index(memory: Any, world: int, i: int, box: int, vehicle: int) -> int:
    """Return the index of the correlation with a vehicle in a box, -1 if there is none."""
    for c in range(memory.correlation.shape[3]):
        if memory.correlation[world, i, box, c].vehicle == vehicle:
            return c
    return -1


@device_function
def matrix_of(memory: Any, world: int, i: int, box: int, c: int):
    """Return a stored correlation."""
    return mat66d(memory.correlation[world, i, box, c].matrix) * (wp.float64(1.0) / wp.float64(constants.STEPS))


@wp.func
def is_near(model: Any, tick: int, other: int) -> bool:
    """Return whether the correlation of a report at one tick is valid for a report at another."""
    return wp.float64(wp.abs(tick - other)) * model.camera_period <= wp.float64(constants.VALID_TIME)


@device_function
def set_correlation(model: Any, memory: Any, world: int, i: int, n: int, k: int, use_reverse: bool, a: int) -> bool:
    """Set the covariance of regressor a to the correlation of the new error of member n with that of member k.

    The source is a message of n, or a message of k if `use_reverse` is set. Correlations of reports too far apart in
    time are not used. Return whether it is known.
    """
    box = memory.member[world, i, n].box
    c = correlation_index(memory, world, i, box, memory.member[world, i, k].vehicle)
    if c >= 0:
        memory.known[world, i, a].covariance = matrix_of(memory, world, i, box, c)
        return is_near(model, memory.correlation[world, i, box, c].tick, memory.member[world, i, k].report.tick)
    box = memory.member[world, i, k].box
    c = correlation_index(memory, world, i, box, memory.member[world, i, n].vehicle)
    if c < 0 or not use_reverse:
        return False
    memory.known[world, i, a].covariance = wp.transpose(matrix_of(memory, world, i, box, c))
    return is_near(model, memory.correlation[world, i, box, c].tick, memory.member[world, i, n].report.tick)


@subroutine
def note_correlations(model: Any, memory: Any, world: int, i: int, n: int, received: bool, count: int) -> int:
    """Store broadcast correlations of member n's new error; return the number of regressors.

    `scratch.column` of n is the Cholesky factor of its new covariance.
    """
    for k in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if k != n and set_correlation(model, memory, world, i, n, k, not received, count):
            X = memory.scratch[world, i, n].column * memory.known[world, i, count].covariance
            memory.known[world, i, count].covariance = X * wp.transpose(factor(memory.P[world, i, k, k]))
            memory.known[world, i, count].member = k
            count += 1
    return count


@wp.func
def is_positive(P: Any) -> bool:
    """Return whether a matrix is positive definite, by more than rounding."""
    X = algebra.inverse_factor(P)
    for k in range(6):
        if not X[k, k] * X[k, k] * P[k, k] < wp.float64(1.0 / constants.ROUNDING):
            return False
    return wp.min(wp.get_diag(P)) > wp.float64(0.0)


@device_function
def by_clocks(model: Any, memory: Any, world: int, i: int, n: int):
    """Return the covariance, 6x6, of member n's error by clock offsets; zero before its velocity is known."""
    std = wp.float64(model.fault[i].clock)
    v = memory.member[world, i, n].clock_v
    P = mat66d()
    P[3:, 3:] = (wp.float64(2.0) * std * std) * wp.outer(v, v)
    return P


@device_function
def stated_covariance(model: Any, memory: Any, world: int, i: int, n: int):
    """Return the covariance, 6x6, of member n's report, increased by clock offsets."""
    return mat66d(memory.member[world, i, n].report.P) + by_clocks(model, memory, world, i, n)


@wp.func
def excess(left: Any, after: Any):
    """Return the least inflation of a covariance `after` that makes the residual `left` positive semidefinite.

    All are 6x6, of left errors, rad and m. Only the directions in which it is negative are inflated.
    """
    more = mat66d()
    if not is_positive(left):
        X = algebra.inverse_factor(after)
        values, axes = eigen_symmetric6(symmetric_part(X * left * wp.transpose(X)))
        B = factor(after) * axes
        for k in range(6):
            values[k, k] = wp.max(-values[k, k], wp.float64(0.0))
        more = B * wp.diag(wp.get_diag(values)) * wp.transpose(B)
    return more


@device_function
def dependence_inflation(memory: Any, world: int, i: int, n: int):
    """Return the share by which member n's covariance is inflated for its dependence on this vehicle.

    Senders that depend on this vehicle may return its own information; together they count as one.
    """
    if not depends_on_own(memory, world, i, n):
        return wp.float64(0.0)
    return wp.float64(dependents(memory, world, i))


@subroutine
def factorise(memory: Any, world: int, i: int, count: int):
    """Set `factor` to the block Cholesky factor of the regressors' covariance, with its inverse on the diagonal."""
    for a in range(count):
        for b in range(a + 1):
            X = mat66d(memory.P[world, i, memory.known[world, i, a].member, memory.known[world, i, b].member])
            for c in range(b):
                X = X - memory.factor[world, i, a, c] * wp.transpose(memory.factor[world, i, b, c])
            if a == b:
                variances = wp.get_diag(
                    memory.P[world, i, memory.known[world, i, a].member, memory.known[world, i, a].member]
                )
                memory.factor[world, i, a, a] = algebra.inverse_factor(
                    X + wp.diag(wp.float64(constants.SINGLE) * variances)
                )
            else:
                memory.factor[world, i, a, b] = X * wp.transpose(memory.factor[world, i, b, b])


@subroutine
def solve_for(model: Any, memory: Any, world: int, i: int, n: int, count: int):
    """Set the regression coefficients L, `scratch.row` to L cov(x, y), and `scratch.column` of n to the residual."""
    factorise(memory, world, i, count)
    for a in range(count):
        Y = mat66d(memory.known[world, i, a].covariance)
        for b in range(a):
            Y = Y - memory.known[world, i, b].coefficient * wp.transpose(memory.factor[world, i, a, b])
        memory.known[world, i, a].coefficient = Y * wp.transpose(memory.factor[world, i, a, a])
    for back in range(count):
        a = count - 1 - back
        Y = mat66d(memory.known[world, i, a].coefficient)
        for c in range(a + 1, count):
            Y = Y - memory.known[world, i, c].coefficient * memory.factor[world, i, c, a]
        memory.known[world, i, a].coefficient = Y * memory.factor[world, i, a, a]
    for k in range(memory.belief[world, i].members):
        row = mat66d()
        for a in range(count):
            row = row + memory.known[world, i, a].coefficient * memory.P[world, i, memory.known[world, i, a].member, k]
        memory.scratch[world, i, k].row = row
    left = stated_covariance(model, memory, world, i, n)
    for a in range(count):
        row = memory.scratch[world, i, memory.known[world, i, a].member].row
        left = left - row * wp.transpose(memory.known[world, i, a].coefficient)
    memory.scratch[world, i, n].column = left


@subroutine
def regress(model: Any, memory: Any, world: int, i: int, n: int, received: bool):
    """Set `scratch.row` to the covariance of member n's new error with all errors.

    Its own covariance is the reported one, inflated if needed. Known are the covariance with n's previous error, if its
    report was `received` before, and the broadcast ones.
    """
    first = wp.where(received, 1, 0)
    memory.known[world, i, 0].member = n
    memory.known[world, i, 0].covariance = stated_covariance(model, memory, world, i, n)
    memory.scratch[world, i, n].column = factor(memory.known[world, i, 0].covariance)
    count = note_correlations(model, memory, world, i, n, received, first)
    solve_for(model, memory, world, i, n, count)
    if count > first:
        memory.member[world, i, n].correlation_unknown = 0
    larger = wp.float64(1.0) + dependence_inflation(memory, world, i, n)  # the added error is the same one
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, i, k].row = wp.sqrt(larger) * memory.scratch[world, i, k].row
    after = stated_covariance(model, memory, world, i, n)
    memory.scratch[world, i, n].row = larger * (after + excess(memory.scratch[world, i, n].column, after))
