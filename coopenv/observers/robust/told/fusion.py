"""What a vehicle makes of what others tell: they stand where they say, and its own pose follows what they learn.

The errors of other members are considered: they have the covariance that is told, correlate with the vehicle's own, and
are not corrected by its bearings, as in the filter of Schmidt, Application of state-space methods to navigation
problems, Advances in Control Systems 3, 1966. When a sender moves by d from where it was carried to, its error changes
from e- to e+ = e- - d. As e+ is not correlated with d, d has the covariance N = P- - P+ and with any other error y
cov(y, d) = cov(y, e-) - cov(y, e+): so the vehicle's own pose follows with the gain of that over N.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.belief import append_member, apply_corrections, index_of, make_room, mark_seen
from coopenv.observers.robust.measurements import is_heard
from coopenv.observers.robust.memory import Estimate, mat66d, vec6d
from coopenv.observers.robust.odometry import increment_noise
from coopenv.observers.robust.told.correlations import rank
from coopenv.observers.robust.told.regression import is_positive, regress
from coopenv.observers.robust.tracklets import bit_of, is_due, propagate_member, test_sender
from coopenv.world.camera import VISIBLE


@wp.func
def set_row(memory: Any, world: int, i: int, n: int):
    """Put `scratch.row` into the covariance."""
    for k in range(memory.belief[world, i].members):
        memory.P[world, i, n, k] = memory.scratch[world, k].row
        memory.P[world, i, k, n] = wp.transpose(memory.scratch[world, k].row)


@wp.func
def place(memory: Any, world: int, i: int, n: int):
    """Put a member where its report says that it is, whatever was believed of it before."""
    report = memory.member[world, i, n].report
    after = mat66d(report.P)
    memory.member[world, i, n].pose = report.pose
    memory.member[world, i, n].considered = 1
    for k in range(memory.belief[world, i].members):
        memory.P[world, i, n, k] = mat66d()
        memory.P[world, i, k, n] = mat66d()
    memory.P[world, i, n, n] = after
    regress(memory, world, i, n, after, False)
    set_row(memory, world, i, n)


@wp.func
def add_member(model: Any, memory: Any, world: int, i: int, sender: int, tick: int):
    """Add a sender that is new to the belief, if there is room."""
    if make_room(model, memory, world, i, tick):
        n = memory.belief[world, i].members
        report = memory.inbox[world, i, sender]
        append_member(memory, world, i, sender, report.pose, mat66d(report.P))
        memory.member[world, i, n].report = report
        memory.member[world, i, n].seen_tick = tick
        place(memory, world, i, n)
        depends_on = report.depends_on | bit_of(sender)
        memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on


@wp.func
def follow(memory: Any, world: int, i: int, n: int, d: Any, N: Any):
    """Let the vehicle's own pose follow a step d, whose covariances with all errors are in `scratch.column`."""
    members = memory.belief[world, i].members
    others = memory.belief[world, i].others
    inverse = algebra.inverse6(N)
    for k in range(others):
        gain = wp.transpose(memory.scratch[world, k].column) * inverse
        memory.scratch[world, k].correction = gain * d
        for j in range(k, members):
            block = memory.P[world, i, k, j] - gain * memory.scratch[world, j].column
            memory.P[world, i, k, j] = block
            memory.P[world, i, j, k] = wp.transpose(block)
    for k in range(others, members):
        memory.scratch[world, k].correction = vec6d()
    apply_corrections(memory, world, i)


@wp.func
def step_to(memory: Any, world: int, i: int, n: int):
    """Put a trusted member where its new report says that it is, and follow the step there."""
    report = memory.member[world, i, n].report
    after = mat66d(report.P)
    news = algebra.left_error(memory.member[world, i, n].pose, report.pose)
    G = algebra.recentring(news)
    members = memory.belief[world, i].members
    for k in range(members):
        block = G * memory.P[world, i, n, k]
        if k == n:
            block = block * wp.transpose(G)
        memory.P[world, i, n, k] = block
        memory.P[world, i, k, n] = wp.transpose(block)
    d = G * news
    before = mat66d(memory.P[world, i, n, n])
    memory.member[world, i, n].pose = report.pose
    forgiven = regress(memory, world, i, n, after, True)
    for k in range(members):
        memory.scratch[world, k].column = memory.P[world, i, n, k] - memory.scratch[world, k].row
    memory.scratch[world, n].column = -forgiven * after
    set_row(memory, world, i, n)
    N = before - (wp.float64(1.0) - forgiven) * after
    for k in range(6):
        N[k, k] = N[k, k] + wp.float64(constants.LEAST_NEWS) * before[k, k]
    variance = before[3, 3] + before[4, 4] + before[5, 5]
    if forgiven >= wp.float64(0.0) and variance <= wp.float64(3.0 * constants.MAX_TOLD_VARIANCE) and is_positive(N):
        if wp.length_sq(algebra.inverse_factor(N) * d) <= wp.float64(constants.STEP_GATE):
            follow(memory, world, i, n, d, N)


@wp.func
def hear(model: Any, memory: Any, world: int, i: int, n: int, sender: int):
    """Take a member's new report."""
    sent = memory.inbox[world, i, sender].tick
    before = memory.member[world, i, n].report.tick
    last = memory.member[world, i, n].report
    report = memory.inbox[world, i, sender]
    dt = wp.float64(sent - before) * model.camera_period
    step = algebra.between(last.odometry, report.odometry)
    propagate_member(model, memory, world, i, n, step, dt, increment_noise(model, memory, world, i, step, dt))
    was_distrusted = memory.member[world, i, n].distrusted
    memory.member[world, i, n].report = report
    test_sender(memory, world, i, n, Estimate(report.pose, mat66d(report.P)), dt)
    if memory.member[world, i, n].distrusted == 1:
        memory.member[world, i, n].considered = 0
        return
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | report.depends_on
    if was_distrusted == 1:
        place(memory, world, i, n)
    else:
        step_to(memory, world, i, n)


@wp.func
def has_news(model: Any, state: Any, memory: Any, world: int, i: int, sender: int, tick: int) -> bool:
    """Return whether a sender's message counts: that of a member whose last one is long ago, or of one in view."""
    if not is_heard(model, state, memory, world, i, sender, tick):
        return False
    n = index_of(memory, world, i, sender)
    if n > 0:
        return is_due(model, memory.member[world, i, n].report.tick, memory.inbox[world, i, sender].tick)
    return state.sight[world, i, model.landmarks + sender] == VISIBLE


@wp.func
def hear_all(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Take the messages of members, and add senders in view to the belief; leaders come first."""
    mark_seen(model, state, memory, world, i, tick)
    last = int(-1)
    for _ in range(model.target_count[i]):
        first = int(-1)
        best = int(0)
        for n in range(model.target_count[i]):
            sender = model.targets[i, n] - model.landmarks
            if sender >= 0:
                if has_news(model, state, memory, world, i, sender, tick):
                    order = rank(model, sender, memory.inbox[world, i, sender])
                    if order > last and (first < 0 or order < best):
                        first = sender
                        best = order
        if first < 0:
            return
        last = best
        member = index_of(memory, world, i, first)
        if member > 0:
            hear(model, memory, world, i, member, first)
        else:
            add_member(model, memory, world, i, first, tick)
