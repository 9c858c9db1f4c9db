"""The covariance of a sender's new error with all that is believed, from what is known of it.

Known is its own covariance P+, that with other members' errors as told, and, where the sender was heard before, that
with its error then, which is P+, too, because the step from one to the other is not correlated with where it ends.
The new error is regressed on these: e+ = L x + w, so that with any other error y it is L cov(x, y), and the joint
covariance stays positive definite, if that of w is. Where it is not, the sender seems to know itself better than what
it tells allows: P+ is taken larger in those directions, so that all it correlates with is kept. All in blocks of 6x6.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import eigen_symmetric6, symmetric_part
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
def note_told(model: Any, memory: Any, world: int, i: int, n: int, after: Any, heard: bool, count: int, told: bool):
    """Note what is told (else what is only likely) of member n's new error; return how much is noted then."""
    A = factor(after)
    for k in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if k != n and memory.member[world, i, k].considered == 1:  # else it does not stand where its report puts it
            known, is_told, X = correlation_of(model, memory, world, i, n, k, not heard)
            if known and is_told == told:
                note_known(memory, world, count, k, A * X * wp.transpose(factor(memory.P[world, i, k, k])))
                count += 1
    return count


@device_function
def gather_known(model: Any, memory: Any, world: int, i: int, n: int, after: Any, heard: bool):
    """Note all of member n's new error: that with its last one, what is told, what is likely.

    Return how much that is, and how much of it is not only likely.
    """
    count = int(0)
    if heard:
        note_known(memory, world, 0, n, after)
        count = 1
    sure = note_told(model, memory, world, i, n, after, heard, count, True)
    return note_told(model, memory, world, i, n, after, heard, sure, False), sure


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
def excess(left: Any, after: Any):
    """Return by how much a covariance is to be larger so that of what is left over a share of it is in all directions.

    All are 6x6, of left errors, rad and m. It is as little as possible: only in the directions in which it has to be.
    """
    more = mat66d()
    share = wp.float64(constants.LEAST_LEFT)
    if not is_positive(left - share * after):
        X = algebra.inverse_factor(after)
        values, axes = eigen_symmetric6(symmetric_part(X * left * wp.transpose(X)))
        B = factor(after) * axes
        for k in range(6):
            values[k, k] = wp.max(share - values[k, k], wp.float64(0.0))
        more = B * wp.diag(wp.get_diag(values)) * wp.transpose(B)
    return more


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
def solve_for(memory: Any, world: int, i: int, after: Any, count: int):
    """Set the coefficients L of what is known; return what they leave over of a covariance."""
    solve_known(memory, world, i, count)
    left = mat66d(after)
    for a in range(count):
        block = regressed(memory, world, i, count, memory.known[world, a].member)
        left = left - block * wp.transpose(memory.known[world, a].coefficient)
    return left


@device_function
def regress(model: Any, memory: Any, world: int, i: int, n: int, after: Any, heard: bool):
    """Set `scratch.row` to the covariance of member n's new error with all errors; return by how much more it has.

    That is added to the covariance that it states, `after`; both are 6x6, rad and m. Where what is only likely
    contradicts the rest, it does not count.
    """
    count, sure = gather_known(model, memory, world, i, n, after, heard)
    more = mat66d()
    growth = wp.float64(0.0)
    if count > 0:
        left = solve_for(memory, world, i, after, count)
        if sure > 0 and sure < count:
            if not is_positive(left - wp.float64(constants.LEAST_LEFT) * after):
                count = sure
                left = solve_for(memory, world, i, after, count)
        larger = wp.float64(1.0) + least_forgiven(memory, world, i, n)  # what is forgiven is the same error
        more = larger * (after + excess(left, after)) - after
        growth = wp.sqrt(larger)
    if count > wp.where(heard, 1, 0):
        memory.member[world, i, n].untold = 0
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].row = growth * regressed(memory, world, i, count, k)
    memory.scratch[world, n].row = after + more
    return more
