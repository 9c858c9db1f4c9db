"""The covariance of a sender's new error with all that is believed, from what is known of it.

Known is its own covariance P+, that with other members' errors as told, and, where the sender was heard before, that
with its error then, which is P+, too, because the step from one to the other is not correlated with where it ends.
The new error is regressed on these: e+ = L x + w, so that with any other error y it is L cov(x, y), and the joint
covariance stays positive definite, if that of w is. All in blocks of 6x6.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.memory import mat66d
from coopenv.observers.robust.told.correlations import correlation_of, factor
from coopenv.observers.robust.tracklets import depends_on_own
from coopenv.world.device_function import device_function

INFLATION = 1.0 + constants.RELATIVE_NOISE


@device_function
def note_known(memory: Any, world: int, at: int, member: int, covariance: Any):
    """Note the covariance with a member's error as the next that is known."""
    memory.known[world, at].member = member
    memory.known[world, at].covariance = covariance


@device_function
def gather_known(memory: Any, world: int, i: int, n: int, after: Any, heard: bool) -> int:
    """Note all that is known of member n's new error, that with its last one first; return how much it is."""
    count = int(0)
    if heard:
        note_known(memory, world, 0, n, after)
        count = 1
    A = factor(after)
    for k in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if k != n:
            known, X = correlation_of(memory, world, i, n, k, not heard)
            if known:
                note_known(memory, world, count, k, A * X * wp.transpose(factor(memory.P[world, i, k, k])))
                count += 1
    return count


@wp.func
def inflated(P: Any):
    """Return a covariance with a little more on its diagonal."""
    more = mat66d(P)
    for k in range(6):
        more[k, k] = P[k, k] * wp.float64(INFLATION)
    return more


@device_function
def factorise(memory: Any, world: int, i: int, a: int):
    """Set row a of the block Cholesky factor of the covariance of what is known; on its diagonal the inverse."""
    row = memory.known[world, a].member
    for b in range(a + 1):
        X = mat66d(memory.P[world, i, row, memory.known[world, b].member])
        if a == b:
            X = inflated(X)
        for c in range(b):
            X = X - memory.factor[world, a, c] * wp.transpose(memory.factor[world, b, c])
        if a == b:
            memory.factor[world, a, a] = algebra.inverse_factor(X)
        else:
            memory.factor[world, a, b] = X * wp.transpose(memory.factor[world, b, b])


@device_function
def solve_known(memory: Any, world: int, i: int, count: int):
    """Set the coefficients L of what is known."""
    for a in range(count):
        factorise(memory, world, i, a)
        Y = mat66d(memory.known[world, a].covariance)
        for c in range(a):
            Y = Y - memory.known[world, c].coefficient * wp.transpose(memory.factor[world, a, c])
        memory.known[world, a].coefficient = Y * wp.transpose(memory.factor[world, a, a])
    for back in range(count):
        a = count - 1 - back
        Y = mat66d(memory.known[world, a].coefficient)
        for c in range(a + 1, count):
            Y = Y - memory.known[world, c].coefficient * memory.factor[world, c, a]
        memory.known[world, a].coefficient = Y * memory.factor[world, a, a]


@device_function
def regressed(memory: Any, world: int, i: int, count: int, k: int):
    """Return the covariance L cov(x, y) with the error y of member k."""
    block = mat66d()
    for a in range(count):
        block = block + memory.known[world, a].coefficient * memory.P[world, i, memory.known[world, a].member, k]
    return block


@wp.func
def is_positive(P: Any) -> bool:
    """Return whether a matrix is positive definite, by more than rounding."""
    X = algebra.inverse_factor(P)
    for k in range(6):
        if not X[k, k] * X[k, k] * P[k, k] < wp.float64(1.0 / constants.ROUNDING):
            return False
    return wp.min(wp.get_diag(P)) > wp.float64(0.0)


@wp.func
def contradiction_of(left: Any, after: Any):
    """Return which share of a sender's covariance makes what is left over positive definite; -1: too large a one.

    No more than has to be: what is added correlates with nothing.
    """
    if is_positive(left):
        return wp.float64(0.0)
    share = wp.float64(constants.LEAST_CONTRADICTION)
    while share < wp.float64(1.5 * constants.MAX_CONTRADICTION):
        if is_positive(left + share * after):
            return share
        share = share * wp.float64(2.0)
    return wp.float64(-1.0)


@device_function
def least_forgiven(memory: Any, world: int, i: int, n: int):
    """Return the share of its covariance that is added to member n's: a little if it depends on others.

    Where senders depend on this vehicle in turn, what they tell may be its own words, and all of them count once.
    """
    depends_on = memory.member[world, i, n].report.depends_on
    if depends_on == wp.uint64(0):
        return wp.float64(0.0)
    if not depends_on_own(memory, world, i, n):
        return wp.float64(constants.LEAST_FORGIVEN)
    count = wp.float64(0.0)
    for k in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if depends_on_own(memory, world, i, k):
            count += wp.float64(1.0)
    return count


@device_function
def try_known(memory: Any, world: int, i: int, n: int, after: Any, count: int):
    """Return what has to be forgiven the sender, as a share of its covariance, so that what is known fits; -1: more.

    Blocks of the new row are left in `scratch.row`.
    """
    solve_known(memory, world, i, count)
    left = mat66d(after)
    for a in range(count):
        block = regressed(memory, world, i, count, memory.known[world, a].member)
        left = left - block * wp.transpose(memory.known[world, a].coefficient)
    needed = contradiction_of(left, after)
    if needed < wp.float64(0.0):
        return needed
    forgiven = wp.max(needed, least_forgiven(memory, world, i, n))
    # What is forgiven beyond that is the same error, only larger.
    growth = wp.sqrt((wp.float64(1.0) + forgiven) / (wp.float64(1.0) + needed))
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].row = growth * regressed(memory, world, i, count, k)
    memory.scratch[world, n].row = (wp.float64(1.0) + forgiven) * after
    return forgiven


@device_function
def regress(memory: Any, world: int, i: int, n: int, after: Any, heard: bool):
    """Set `scratch.row` to the covariance of member n's new error with all errors; return what is forgiven the sender.

    That is a share of its covariance. Where more would have to be, less is taken as known. -1: nothing is left; the new
    error is the one before, only larger, because of errors of the sender's odometry that last.
    """
    count = gather_known(memory, world, i, n, after, heard)
    alone = wp.where(heard, 1, 0)
    forgiven = wp.float64(-1.0)
    if count > alone:
        forgiven = try_known(memory, world, i, n, after, count)
    if heard and forgiven < wp.float64(0.0):
        forgiven = try_known(memory, world, i, n, after, 1)
    if forgiven < wp.float64(0.0):
        growth = mat66d()
        if heard:
            growth = factor(after) * algebra.inverse_factor(memory.P[world, i, n, n])
        for k in range(memory.belief[world, i].members):
            memory.scratch[world, k].row = growth * memory.P[world, i, n, k]
        memory.scratch[world, n].row = after
    return forgiven
