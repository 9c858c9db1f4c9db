"""Whether it is others who lie than those that a vehicle does not believe.

Who hears a liar first fits its own pose to what that one says, and then the honest ones contradict it. From then on its
bearings agree with the liar, so nothing within the belief tells. But from where landmarks and odometry alone put the
vehicle the bearings to all can be explained anew, every sender that is left out at the price of `MAX_BEARING_COST`.
Where leaving out one sender alone explains them better than leaving out those that are not believed, and at another
pose, that sender is believed no more, and the others are again. But those who have contradicted themselves, by a jump
or a drift while they were believed, are not: two who collude explain as much as two who are honest. Nor are those whom
bearings have contradicted more than `MAX_REVISIONS` times, so that nobody goes back and forth for ever.
Source: the price of what is left out is that of consensus, Torr and Zisserman, MLESAC, Computer Vision and Image
Understanding 78(1), 2000.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import distance_squared, position_variance
from coopenv.observers.robust.belief import index_of, own_estimate, put_own
from coopenv.observers.robust.correction import iterated_update
from coopenv.observers.robust.measurements import (
    bearing_variance,
    innovation_squared,
    is_heard,
    linearise,
    set_line,
)
from coopenv.observers.robust.memory import Estimate, Frame, Word, mat66d, vec3d
from coopenv.observers.robust.mounting import mounting_variances
from coopenv.observers.robust.told.clocks import by_clocks
from coopenv.observers.robust.told.fusion import place
from coopenv.world.camera import VISIBLE, body_bearing
from coopenv.world.device_function import device_function

THIRD = 1.0 / 3.0


@device_function
def is_disputed(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether member n is not believed because of bearings, and has not been so too often before."""
    word = memory.word[world, i, memory.member[world, i, n].vehicle]
    may_be_right = word.perjured == 0 and word.offences <= constants.MAX_REVISIONS
    return memory.member[world, i, n].distrusted == 1 and may_be_right


@device_function
def believe_again(model: Any, memory: Any, world: int, i: int, n: int):
    """Put member n where it says to be; how often it has not been believed, and its drift, are not forgotten."""
    sender = memory.member[world, i, n].vehicle
    word = Word()
    word.drift = memory.word[world, i, sender].drift
    word.slow_drift = memory.word[world, i, sender].slow_drift
    word.offences = memory.word[world, i, sender].offences
    memory.word[world, i, sender] = word
    memory.member[world, i, n].distrusted = 0
    depends_on = memory.member[world, i, n].report.depends_on
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on
    place(model, memory, world, i, n)


@device_function
def is_rejected(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether member n is not believed, or most bearings to it do not fit."""
    share = memory.word[world, i, memory.member[world, i, n].vehicle].missed_share
    return memory.member[world, i, n].distrusted == 1 or share > wp.float64(constants.LOST_SHARE)


@device_function
def set_told_lines(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Set the lines of sight to members in view that may be right, where they have said last; return their frame."""
    lines = int(0)
    mounting = mounting_variances(model, i)
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        sender = target - model.landmarks
        if sender >= 0 and state.sight[world, i, target] == VISIBLE:
            member = index_of(memory, world, i, sender)
            if member > 0 and is_heard(model, state, memory, world, i, sender, tick):
                if memory.member[world, i, member].distrusted == 0 or is_disputed(memory, world, i, member):
                    report = memory.inbox[world, i, sender]
                    gone = wp.float64(constants.MAX_SPEED) * wp.float64(tick - report.tick) * model.camera_period
                    P = mat66d(report.P) + by_clocks(model, memory, world, i, member)
                    variance = wp.float64(THIRD) * position_variance(P) + gone * gone + mounting[1]
                    b = vec3d(body_bearing(model, state, world, i, target))
                    set_line(memory, world, lines, 0, b, report.pose.p, variance)
                    memory.line[world, lines].teller = member
                    lines += 1
    variance = bearing_variance(model, i) + mounting[0]
    once = wp.float64(constants.BEND_TIME)  # a period for which what linearisations leave out counts once
    return Frame(lines, 0, vec3d(model.camera[i].position), variance, once)


@device_function
def cost_of(frame: Frame, memory: Any, world: int, i: int, alone: Estimate):
    """Return what an estimate and the lines that are marked as fitting cost together; put the own pose between them.

    Infinite where the target of one is not ahead. Every other line costs as much as a wrong bearing.
    """
    put_own(memory, world, i, alone)
    cost = wp.float64(0.0)
    fitting = int(0)
    for n in range(frame.lines):
        if memory.line[world, n].fits == 1:
            fitting += 1
            if not innovation_squared(frame, memory, world, i, n) < wp.float64(wp.inf):
                return wp.float64(wp.inf)
        else:
            cost += wp.float64(constants.MAX_BEARING_COST)
    if fitting > 0:
        iterated_update(frame, memory, world, i)
    for n in range(frame.lines):
        if memory.line[world, n].fits == 1:
            if not linearise(frame, memory, world, i, n):
                return wp.float64(wp.inf)
            cost += wp.length_sq(memory.line[world, n].residual) / memory.line[world, n].noise
    return cost + distance_squared(alone, Estimate(memory.member[world, i, 0].pose, mat66d()))


@device_function
def least_cost(frame: Frame, memory: Any, world: int, i: int, alone: Estimate):
    """Return the member without whom bearings to all others cost least, that cost, and the own pose then."""
    liar = int(0)
    least = wp.float64(wp.inf)
    pose = alone.pose
    for n in range(frame.lines):
        for m in range(frame.lines):
            memory.line[world, m].fits = wp.where(m == n, 0, 1)
        cost = cost_of(frame, memory, world, i, alone)
        if cost < least:
            least = cost
            liar = memory.line[world, n].teller
            pose = memory.member[world, i, 0].pose
    return liar, least, pose


@device_function
def find_liar(model: Any, state: Any, memory: Any, world: int, i: int, tick: int, alone: Estimate):
    """Return the frame, and without whom its bearings are explained much better than without those not believed.

    That is a member, 0 where all is well as it is. `alone` is what landmarks alone say; the own pose is back at last.
    """
    frame = set_told_lines(model, state, memory, world, i, tick)
    rejected = int(0)
    for n in range(frame.lines):
        fits = wp.where(is_rejected(memory, world, i, memory.line[world, n].teller), 0, 1)
        memory.line[world, n].fits = fits
        rejected += 1 - fits
    if rejected == 0:
        return frame, int(0)
    own = own_estimate(memory, world, i)
    members = memory.belief[world, i].members
    others = memory.belief[world, i].others
    memory.belief[world, i].members = 1
    memory.belief[world, i].others = 1
    cost = cost_of(frame, memory, world, i, alone)
    liar, least, pose = least_cost(frame, memory, world, i, alone)
    memory.belief[world, i].members = members
    memory.belief[world, i].others = others
    put_own(memory, world, i, own)
    elsewhere = distance_squared(own, Estimate(pose, mat66d())) > wp.float64(constants.SEPARATION_GATE)
    convincing = cost - least > wp.float64(constants.REVISION_MARGIN)
    return frame, wp.where(elsewhere and convincing, liar, 0)
