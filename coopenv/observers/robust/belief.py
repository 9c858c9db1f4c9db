"""The belief: the joint state of the vehicle itself and of the vehicles that it receives, with one covariance.

Errors are left errors, R = Rhat Exp(theta), p = phat + Rhat rho, six per member, the vehicle itself first. The
covariance is kept in blocks of 6x6. A member's pose is the one of its last fused report. If a new member needs room,
the member that has been out of view for longest is evicted.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import symmetric_part
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    diagonal_by_rows,
    displaced,
    forward,
    moved,
    propagated,
    recentred,
    recentring,
    with_noise,
)
from coopenv.observers.robust.memory import ERRORS, SENDER_SLOTS, Anchor, Pose, PoseEstimate, mat66d
from coopenv.world.camera import VISIBLE
from coopenv.world.nearby import agent_of, entry_at, entry_count
from coopenv.world.warp_internals import device_function, subroutine

MAX_UNSEEN_TIME = constants.MEAN_TIME + constants.SAME_TIME


@device_function
def index_of(memory: Any, world: int, i: int, vehicle: int) -> int:
    """Return the index of a vehicle among the members of i's belief, 0 if it is none, or i itself."""
    for n in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if memory.member[world, i, n].vehicle == vehicle:
            return n
    return 0


@device_function
def set_block(memory: Any, world: int, i: int, k: int, j: int, block: Any):
    """Set the covariance at (k, j) to a block and at (j, k) to its transpose; on the diagonal to the symmetric part."""
    memory.P[world, i, k, j] = block
    memory.P[world, i, j, k] = wp.transpose(block)
    if k == j:
        memory.P[world, i, k, k] = symmetric_part(block)


@device_function
def begin_belief(memory: Any, world: int, i: int, estimate: PoseEstimate):
    """Begin the belief with the vehicle itself; the calibration states are kept without correlations."""
    memory.belief[world, i].members = memory.belief[world, i].first_sender
    for k in range(1, memory.belief[world, i].first_sender):
        for j in range(k):
            set_block(memory, world, i, k, j, mat66d())
    memory.member[world, i, 0].vehicle = i
    memory.member[world, i, 0].pose = estimate.pose
    memory.P[world, i, 0, 0] = estimate.P


@device_function
def own_estimate(memory: Any, world: int, i: int):
    """Return the own estimate."""
    return PoseEstimate(memory.member[world, i, 0].pose, memory.P[world, i, 0, 0])


@device_function
def estimate_with_faults(memory: Any, world: int, i: int):
    """Return the own estimate with a covariance that includes the mixture of likely faults."""
    return PoseEstimate(memory.member[world, i, 0].pose, memory.P[world, i, 0, 0] + memory.fault_mixture[world, i])


@subroutine
def propagate(memory: Any, world: int, i: int, n: int, step: Pose, noise: Any):
    """Propagate a member by an increment of odometry with noise."""
    memory.member[world, i, n].pose = moved(memory.member[world, i, n].pose, step)
    for k in range(memory.belief[world, i].members):
        if k != n:
            set_block(memory, world, i, n, k, forward(step, memory.P[world, i, n, k]))
    memory.P[world, i, n, n] = with_noise(propagated(memory.P[world, i, n, n], step), noise)


@device_function
def apply_error(memory: Any, world: int, i: int, n: int, error: Any):
    """Move a member's pose by an error."""
    memory.member[world, i, n].pose = displaced(memory.member[world, i, n].pose, error)


@device_function
def recentre(memory: Any, world: int, i: int, n: int, G: Any):
    """Recentre the covariance of a member's error about its moved pose, see `recentring`."""
    for k in range(memory.belief[world, i].members):
        if k != n:
            set_block(memory, world, i, n, k, diagonal_by_rows(G, memory.P[world, i, n, k]))
    memory.P[world, i, n, n] = symmetric_part(recentred(G, memory.P[world, i, n, n]))


@subroutine
def apply_corrections(memory: Any, world: int, i: int):
    """Apply the corrections of all estimated members, and recentre the covariance about the new poses.

    Senders are considered: they keep their reported poses.
    """
    for k in range(memory.belief[world, i].first_sender):
        correction = memory.scratch[world, i, k].correction
        if k == ERRORS:
            memory.member[world, i, k].w += correction[:3]
            memory.member[world, i, k].v += correction[3:]
        else:
            apply_error(memory, world, i, k, correction)
            memory.scratch[world, i, k].recentring = recentring(correction)
            recentre(memory, world, i, k, memory.scratch[world, i, k].recentring)


@device_function
def remove_member(memory: Any, world: int, i: int, n: int):
    """Remove a member; those behind it move up."""
    members = memory.belief[world, i].members
    for m in range(n + 1, members):
        memory.member[world, i, m - 1] = memory.member[world, i, m]
        for k in range(members):
            memory.P[world, i, m - 1, k] = memory.P[world, i, m, k]
    for m in range(n + 1, members):
        for k in range(members):
            memory.P[world, i, k, m - 1] = memory.P[world, i, k, m]
    memory.belief[world, i].members = members - 1


@device_function
def insert_member(memory: Any, world: int, i: int, n: int):
    """Make room for a member whose error is independent of the others'; those from n on move down."""
    members = memory.belief[world, i].members
    for j in range(members - n):
        m = members - j
        memory.member[world, i, m] = memory.member[world, i, m - 1]
        for k in range(members):
            memory.P[world, i, m, k] = memory.P[world, i, m - 1, k]
    for j in range(members - n):
        m = members - j
        for k in range(members + 1):
            memory.P[world, i, k, m] = memory.P[world, i, k, m - 1]
    memory.belief[world, i].members = members + 1
    for k in range(members + 1):
        set_block(memory, world, i, n, k, mat66d())


@device_function
def mark_seen(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Note which members are in view."""
    kept = model.kept
    for n in range(entry_count(model, state, world, i)):
        entry = entry_at(model, state, kept, world, i, n)
        target = agent_of(state, kept, world, i, entry)
        if target >= model.landmarks and state.sight[world, i, entry] == VISIBLE:
            member = index_of(memory, world, i, target - model.landmarks)
            if member > 0:
                memory.member[world, i, member].seen_tick = tick


@device_function
def make_room(model: Any, memory: Any, world: int, i: int, tick: int) -> bool:
    """Return whether there is room for one more, after an eviction if there has to be one and may be one.

    Evicted is the member that has been out of view for longest, unless that is within `MAX_UNSEEN_TIME`.
    """
    first = memory.belief[world, i].first_sender
    members = memory.belief[world, i].members
    if members - first < SENDER_SLOTS:
        return True
    longest_unseen = int(first)
    for n in range(first + 1, members):
        if memory.member[world, i, n].seen_tick < memory.member[world, i, longest_unseen].seen_tick:
            longest_unseen = n
    unseen = wp.float64(tick - memory.member[world, i, longest_unseen].seen_tick) * model.camera_period
    if unseen <= wp.float64(MAX_UNSEEN_TIME):
        return False
    remove_member(memory, world, i, longest_unseen)
    return True


@device_function
def set_anchor(memory: Any, world: int, i: int, P: Any, tick: int):
    """Store the own pose as the anchor: the prior of a search after a loss."""
    here = PoseEstimate(memory.member[world, i, 0].pose, P)
    memory.anchor[world, i] = Anchor(here, memory.belief[world, i].odometry, tick)
