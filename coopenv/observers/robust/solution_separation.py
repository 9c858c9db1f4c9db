"""The belief against what landmarks and odometry alone say, and who is wrong of two that contradict each other.

A second estimate of the vehicle's pose takes no message; of the odometry's errors, where there are any, it takes what
is believed. It is vaguer than the belief, but hardly to be misled, and it shares all its information with a belief that
is right: so the belief is nearly always within its covariance. Where it is not, and where bearings contradict one
sender, every sender in view is left out in turn: the one without whom the bearings to the others agree best with
landmarks is believed no more. Then the belief is that estimate again. As long as somebody is not believed because
bearings contradicted him, it is asked again whether it was him.
Source: separation of solutions, Brown and McBurney, Self-contained GPS integrity check using maximum solution
separation, Navigation 35(1), 1988.

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
from coopenv.observers.robust.algebra import between, carried, distance_squared, position_variance, with_noise
from coopenv.observers.robust.belief import index_of, own_estimate, put_own, set_anchor
from coopenv.observers.robust.correction import correct_by_lines, iterated_update, store_poses
from coopenv.observers.robust.correlated_fusion import by_clocks, place
from coopenv.observers.robust.correlations import clear_told
from coopenv.observers.robust.measurements import (
    TRACKING,
    bearing_variance,
    innovation_squared,
    is_heard,
    linearise,
    set_line,
    set_lines,
    time_between,
)
from coopenv.observers.robust.memory import Alone, Estimate, Frame, Word, mat66d, vec2d, vec3d
from coopenv.observers.robust.propagation import begin_errors, increment_noise, mounting_variances
from coopenv.observers.robust.sender_monitor import distrust, forget_evidence
from coopenv.world.camera import VISIBLE, body_bearing
from coopenv.world.warp_internals import device_function


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
                    variance = wp.float64(constants.THIRD) * position_variance(P) + gone * gone + mounting[1]
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


LASTING_FRAME = constants.BEND_TIME / constants.CONSIDERED_BEND_TIME
"""Share of its period that a frame counts for, so that what a linearisation leaves out is the same for longer."""


@device_function
def begin_alone(memory: Any, world: int, i: int, estimate: Estimate, tick: int):
    """Begin with an estimate at a tick."""
    memory.alone[world, i].begun = 1
    memory.alone[world, i].tick = tick
    memory.alone[world, i].odometry = memory.belief[world, i].odometry
    memory.alone[world, i].estimate = estimate


@device_function
def begin_told(model: Any, memory: Any, world: int, i: int):
    """Forget what was sent and received; begin with the initial estimate, unless the pose is searched for.

    A search may use what anybody says; who begins with an estimate depends on nobody yet.
    """
    clear_told(model, memory, world, i)
    memory.alone[world, i] = Alone()
    if memory.search[world, i].active == 0:
        memory.belief[world, i].depends_on = wp.uint64(0)
        begin_alone(memory, world, i, own_estimate(memory, world, i), 0)


@device_function
def follow_alone(model: Any, memory: Any, world: int, i: int, tick: int):
    """Carry the estimate on by odometry; return for which time, s."""
    alone = memory.alone[world, i]
    elapsed = wp.float64(tick - alone.tick) * model.camera_period
    step = between(alone.odometry, memory.belief[world, i].odometry)
    noise = wp.float64(constants.ALONE_NOISE) * increment_noise(model, memory, world, i, step, elapsed)
    begin_alone(memory, world, i, carried(alone.estimate, step, noise), tick)
    return elapsed


@device_function
def correct_alone(model: Any, frame: Frame, memory: Any, world: int, i: int, elapsed: Any) -> int:
    """Correct the estimate by the landmarks of a frame, elapsed (s) after the last one; return how many fit.

    Where none fits that are in view, it begins anew.
    It stands in the belief's place meanwhile. What is the same in all frames counts as one measurement.
    """
    own = own_estimate(memory, world, i)
    members = memory.belief[world, i].members
    others = memory.belief[world, i].others
    memory.belief[world, i].members = 1
    memory.belief[world, i].others = 1
    put_own(memory, world, i, memory.alone[world, i].estimate)
    frames = wp.max(wp.float64(constants.CONSIDERED_BEND_TIME) / elapsed, wp.float64(1.0))
    mounting = wp.float64(constants.ALONE_NOISE) * frames * mounting_variances(model, i)
    variance = wp.float64(constants.ALONE_NOISE) * frame.variance + mounting[0]
    alone = Frame(frame.lines, 0, frame.lever, variance, wp.float64(LASTING_FRAME) * elapsed)
    fitting = int(0)
    landmarks = int(0)
    for n in range(alone.lines):
        fits = int(0)
        if memory.line[world, n].member == 0:
            landmarks += 1
            memory.line[world, n].variance = mounting[1]
            if innovation_squared(alone, memory, world, i, n) < wp.float64(constants.BEARING_GATE):
                fits = 1
        memory.line[world, n].fits = fits
        fitting += fits
    if fitting > 0:
        iterated_update(alone, memory, world, i)
        memory.alone[world, i].estimate = own_estimate(memory, world, i)
    elif landmarks > 0:
        memory.alone[world, i].begun = 0
    memory.belief[world, i].members = members
    memory.belief[world, i].others = others
    put_own(memory, world, i, own)
    return fitting


@device_function
def exchange_own(memory: Any, world: int, i: int, estimate: Estimate):
    """Put the vehicle itself where an estimate says that depends on nobody; keep what it shared with others."""
    put_own(memory, world, i, estimate)
    for k in range(1, memory.belief[world, i].members):
        memory.scratch[world, k].row = memory.P[world, i, 0, k]
        memory.P[world, i, 0, k] = mat66d()
        memory.P[world, i, k, 0] = mat66d()


@device_function
def restore_own(memory: Any, world: int, i: int, estimate: Estimate):
    """Put the vehicle back, with what it shared with others."""
    put_own(memory, world, i, estimate)
    for k in range(1, memory.belief[world, i].members):
        memory.P[world, i, 0, k] = memory.scratch[world, k].row
        memory.P[world, i, k, 0] = wp.transpose(memory.scratch[world, k].row)


@device_function
def is_believed(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether the n-th bearing is to a sender that is believed."""
    member = memory.line[world, n].member
    return member > 0 and memory.member[world, i, member].considered == 1


@device_function
def cost_without(memory: Any, world: int, i: int, lines: int, without: int):
    """Return what the bearings to all senders cost that are believed, but for one line."""
    for n in range(lines):
        fits = int(0)
        if n != without and is_believed(memory, world, i, n):
            fits = 1
        memory.line[world, n].fits = fits
    return correct_by_lines(memory, world, i, lines, False)


@device_function
def find_culprit(frame: Frame, memory: Any, world: int, i: int, accused: int):
    """Return the sender without whom bearings to the others cost least, that cost, and that without the accused one.

    Besides how many bearings to senders there are. The own pose is what landmarks alone say meanwhile. The sender is a
    member, 0 if none is in view; costs are normalised innovations squared, the last one infinite where the accused one
    is out of view.
    """
    own = own_estimate(memory, world, i)
    exchange_own(memory, world, i, memory.alone[world, i].estimate)
    culprit = int(0)
    least = wp.float64(wp.inf)
    without = wp.float64(wp.inf)
    count = int(0)
    for n in range(frame.lines):
        if not innovation_squared(frame, memory, world, i, n) < wp.float64(wp.inf):
            memory.line[world, n].residual = vec2d(wp.float64(constants.NOT_AHEAD), wp.float64(constants.NOT_AHEAD))
    store_poses(memory, world, i)
    for n in range(frame.lines):
        if is_believed(memory, world, i, n):
            count += 1
            cost = cost_without(memory, world, i, frame.lines, n)
            member = memory.line[world, n].member
            if cost < least:
                culprit = member
                least = cost
            if member == accused:
                without = cost
    restore_own(memory, world, i, own)
    return culprit, least, without, count


@wp.func
def consistent_cost(bearings: int):
    """Return what so many bearings that agree cost at most: the 0.999 quantile of chi-square, by Wilson and Hilferty.

    Source: Wilson and Hilferty, The distribution of chi-square, Proc. National Academy of Sciences 17(12), 1931.
    """
    dof = wp.float64(2.0) * wp.float64(bearings)
    if bearings == 0:
        return wp.float64(0.0)
    a = wp.float64(2.0 / 9.0) / dof
    root = wp.float64(1.0) - a + wp.float64(constants.CONSISTENT_QUANTILE) * wp.sqrt(a)
    return dof * root * root * root


@device_function
def stand_alone(model: Any, frame: Frame, memory: Any, world: int, i: int, tick: int, culprit: int):
    """Believe what landmarks alone say, and a culprit and all that contradict landmarks by themselves no more."""
    alone = memory.alone[world, i].estimate
    away = wp.length(alone.pose.p - memory.member[world, i, 0].pose.p)
    exchange_own(memory, world, i, alone)
    members = memory.belief[world, i].members
    others = memory.belief[world, i].others
    for k in range(1, members):
        for j in range(1, k):
            if j < others:
                memory.P[world, i, k, j] = mat66d()
                memory.P[world, i, j, k] = mat66d()
    begin_errors(model, memory, world, i)
    forget_evidence(memory, world, i)
    for k in range(others, members):
        if memory.member[world, i, k].considered == 0:
            noise = vec2d(wp.float64(0.0), away * away)
            memory.P[world, i, k, k] = with_noise(memory.P[world, i, k, k], noise)
    memory.belief[world, i].missed_share = wp.float64(0.0)
    set_anchor(memory, world, i, alone.P, tick)
    memory.alone[world, i].exposed = 0
    for n in range(frame.lines):
        if is_believed(memory, world, i, n):
            fits = innovation_squared(frame, memory, world, i, n) < wp.float64(constants.BEARING_GATE)
            member = memory.line[world, n].member
            if member == culprit or not fits:
                far = wp.length(memory.line[world, n].residual) * memory.line[world, n].distance
                distrust(model, memory, world, i, member, tick, far, False)


@device_function
def judge_accused(model: Any, frame: Frame, memory: Any, world: int, i: int, tick: int):
    """Believe a sender no more that bearings contradict, or else the one that it contradicts: who landmarks do."""
    accused = memory.belief[world, i].accused
    follow_alone(model, memory, world, i, tick)
    culprit, least, without, _ = find_culprit(frame, memory, world, i, accused)
    if wp.isfinite(without) and without - least > wp.float64(constants.DISPUTE_MARGIN):
        stand_alone(model, frame, memory, world, i, tick, culprit)
    else:
        followed = memory.belief[world, i].accused_followed == 1
        distrust(model, memory, world, i, accused, tick, memory.belief[world, i].accused_error, followed)


@device_function
def judge_belief(model: Any, frame: Frame, memory: Any, world: int, i: int, tick: int):
    """Leave the belief where it is not what landmarks alone say.

    But where several senders contradict that and hardly a landmark is in view, odometry may be wrong: that begins anew.
    """
    elapsed = follow_alone(model, memory, world, i, tick)
    landmarks = correct_alone(model, frame, memory, world, i, elapsed)
    exposed = memory.alone[world, i].exposed == 1
    pose = memory.member[world, i, 0].pose
    away = distance_squared(memory.alone[world, i].estimate, Estimate(pose, mat66d()))
    if exposed and landmarks > 0 and away > wp.float64(constants.SEPARATION_GATE):
        culprit, least, _, count = find_culprit(frame, memory, world, i, 0)
        alone = count == 0 or least <= consistent_cost(count - 1)
        if alone or landmarks >= constants.ENOUGH_LANDMARKS:
            stand_alone(model, frame, memory, world, i, tick, culprit)
        else:
            memory.alone[world, i].begun = 0


@device_function
def revise(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Believe others than so far where that explains this frame's bearings better."""
    frame, liar = find_liar(model, state, memory, world, i, now.tick, memory.alone[world, i].estimate)
    if liar == 0:
        return
    for n in range(frame.lines):
        k = memory.line[world, n].teller
        if k != liar and memory.member[world, i, k].distrusted == 1:
            believe_again(model, memory, world, i, k)
    period = time_between(model, state, world, i, now)
    frame = set_lines(model, state, memory, world, i, now.tick, period, TRACKING)
    stand_alone(model, frame, memory, world, i, now.tick, liar)
    if memory.member[world, i, liar].distrusted == 0:
        distrust(model, memory, world, i, liar, now.tick, wp.float64(0.0), False)


@device_function
def note_exposure(memory: Any, world: int, i: int):
    """Note whether any sender is believed: then the belief may be misled."""
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            memory.alone[world, i].exposed = 1


@device_function
def separate(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Judge whom this frame's bearings contradict, and now and then the belief as a whole."""
    if memory.search[world, i].active == 1:
        memory.alone[world, i].begun = 0
    elif now.due:
        if memory.alone[world, i].begun == 0:
            variances = vec2d(
                wp.float64(constants.KNOWN_ANGLE * constants.KNOWN_ANGLE),
                wp.float64(constants.KNOWN_POSITION * constants.KNOWN_POSITION),
            )
            pose = memory.member[world, i, 0].pose
            begin_alone(memory, world, i, Estimate(pose, with_noise(mat66d(), variances)), now.tick)
        note_exposure(memory, world, i)
        since = wp.float64(now.tick - memory.alone[world, i].tick) * model.camera_period
        looking = since > wp.float64(constants.ALONE_TIME - constants.SAME_TIME)
        if looking or memory.belief[world, i].accused > 0:
            period = time_between(model, state, world, i, now)
            frame = set_lines(model, state, memory, world, i, now.tick, period, TRACKING)
            if memory.belief[world, i].accused > 0:
                judge_accused(model, frame, memory, world, i, now.tick)
            else:
                judge_belief(model, frame, memory, world, i, now.tick)
                if memory.alone[world, i].begun == 1:
                    revise(model, state, memory, world, i, now)
    memory.belief[world, i].accused = 0
