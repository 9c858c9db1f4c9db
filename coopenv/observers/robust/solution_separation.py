"""Solution separation: the belief against the solution from landmarks and odometry alone.

The landmark-only solution fuses no message. It takes the calibration states, if there are any, from the belief. Its
covariance is larger, but a faulty sender hardly affects it, and all its information is also in a correct belief. A
correct belief is therefore nearly always within its covariance. Two events start a leave-one-out test over all senders
in view: the belief leaves that covariance, or bearings contradict a sender. The sender without which the remaining
bearings agree best with landmarks is excluded, and the belief is reset to the landmark-only solution.
Source: Brown and McBurney, Self-contained GPS integrity check using maximum solution separation, Navigation 35(1),
1988.

Retest of exclusions. If the first received sender is faulty, the own pose is fitted to its reports, and correct senders
then contradict the own pose. Within the belief this fault cannot be detected. From the landmark-only solution, the
bearings to all senders are explained anew, at a cost of `MAX_BEARING_COST` for every sender left out. If one other
sender left out explains them better than the present exclusions, and at another pose, that sender is excluded and the
others are readmitted. Two kinds of senders are not readmitted this way. The first were excluded because their reports
contradict their odometry: two colluding senders explain as much as two correct ones. The second have been excluded more
than `MAX_RETESTED_EXCLUSIONS` times, which bounds the number of changes.
Source: the cost of an outlier is that of Torr and Zisserman, MLESAC, Computer Vision and Image Understanding 78(1),
2000.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    KNOWN_ANGLE_VARIANCE,
    KNOWN_POSITION_VARIANCE,
    between,
    carried,
    distance_squared,
    position_variance,
    with_noise,
)
from coopenv.observers.robust.belief import index_of, own_estimate, put_own, set_anchor, set_block
from coopenv.observers.robust.correction import correct_by_bearings, iterated_update, store_poses
from coopenv.observers.robust.correlated_fusion import by_clocks, set_to_report
from coopenv.observers.robust.correlations import clear_broadcasts
from coopenv.observers.robust.measurements import (
    TRACKING,
    bearing_variance,
    innovation_squared,
    is_received,
    linearise,
    set_bearing_measurement,
    set_bearing_measurements,
)
from coopenv.observers.robust.memory import (
    BearingFrame,
    LandmarkOnlySolution,
    PoseEstimate,
    SenderMonitor,
    mat66d,
    vec2d,
    vec3d,
)
from coopenv.observers.robust.propagation import begin_errors, increment_noise, mounting_variances
from coopenv.observers.robust.sender_monitor import exclude, reset_monitors
from coopenv.world.camera import VISIBLE, body_bearing
from coopenv.world.warp_internals import device_function


@device_function
def isolate_own(memory: Any, world: int, i: int):
    """Reduce the belief to the own pose, without calibration states; return the belief and the own estimate."""
    belief = memory.belief[world, i]
    memory.belief[world, i].members = 1
    memory.belief[world, i].others = 1
    return belief, own_estimate(memory, world, i)


@device_function
def is_disputed(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether member n is excluded because of bearings, and its exclusion may still be retested."""
    monitor = memory.monitor[world, i, memory.member[world, i, n].vehicle]
    may_be_right = monitor.self_inconsistent == 0 and monitor.exclusions <= constants.MAX_RETESTED_EXCLUSIONS
    return memory.member[world, i, n].excluded == 1 and may_be_right


@device_function
def readmit(model: Any, memory: Any, world: int, i: int, n: int):
    """Readmit member n at its reported pose; the number of its exclusions and its drift are kept."""
    sender = memory.member[world, i, n].vehicle
    monitor = SenderMonitor()
    monitor.drift = memory.monitor[world, i, sender].drift
    monitor.slow_drift = memory.monitor[world, i, sender].slow_drift
    monitor.exclusions = memory.monitor[world, i, sender].exclusions
    memory.monitor[world, i, sender] = monitor
    memory.member[world, i, n].excluded = 0
    depends_on = memory.member[world, i, n].report.depends_on
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on
    set_to_report(model, memory, world, i, n)


@device_function
def is_rejected(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether member n is excluded, or most bearings to it fail the gate."""
    share = memory.monitor[world, i, memory.member[world, i, n].vehicle].rejected_share
    return memory.member[world, i, n].excluded == 1 or share > wp.float64(constants.LOST_SHARE)


@device_function
def set_report_measurements(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Set the bearings to members in view, at their last reported positions, as measurements; return their frame."""
    frame = BearingFrame()
    mounting = mounting_variances(model, i)
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        sender = target - model.landmarks
        if state.sight[world, i, target] == VISIBLE and is_received(model, state, memory, world, i, sender, tick):
            member = index_of(memory, world, i, sender)
            if member > 0:
                if memory.member[world, i, member].excluded == 0 or is_disputed(memory, world, i, member):
                    report = memory.inbox[world, i, sender]
                    gone = wp.float64(constants.MAX_SPEED) * wp.float64(tick - report.tick) * model.camera_period
                    P = mat66d(report.P) + by_clocks(model, memory, world, i, member)
                    variance = wp.float64(constants.THIRD) * position_variance(P) + gone * gone + mounting[1]
                    b = vec3d(body_bearing(model, state, world, i, target))
                    set_bearing_measurement(memory, world, frame.bearings, 0, b, report.pose.p, variance)
                    memory.measurement[world, frame.bearings].reported_by = member
                    frame.bearings += 1
    frame.lever = vec3d(model.camera[i].position)
    frame.variance = bearing_variance(model, i) + mounting[0]
    frame.period = wp.float64(constants.LINEARISATION_TIME)  # for which the linearisation error counts once
    return frame


@device_function
def cost_of(frame: BearingFrame, memory: Any, world: int, i: int, landmark_only: PoseEstimate):
    """Return the joint cost of an estimate and of the measurements that fit; set the own pose to their optimum.

    The cost is infinite if a target is behind the camera. Every other measurement costs as much as an outlier.
    """
    put_own(memory, world, i, landmark_only)
    cost = wp.float64(0.0)
    fitting = int(0)
    for n in range(frame.bearings):
        if memory.measurement[world, n].fits == 1:
            fitting += 1
            if not innovation_squared(frame, memory, world, i, n) < wp.float64(wp.inf):
                return wp.float64(wp.inf)
        else:
            cost += wp.float64(constants.MAX_BEARING_COST)
    if fitting > 0:
        iterated_update(frame, memory, world, i)
    for n in range(frame.bearings):
        if memory.measurement[world, n].fits == 1:
            if not linearise(frame, memory, world, i, n):
                return wp.float64(wp.inf)
            cost += wp.length_sq(memory.measurement[world, n].residual) / memory.measurement[world, n].noise
    return cost + distance_squared(landmark_only, PoseEstimate(memory.member[world, i, 0].pose, mat66d()))


@device_function
def least_cost(frame: BearingFrame, memory: Any, world: int, i: int, landmark_only: PoseEstimate):
    """Return the member whose omission leaves the least cost, that cost, and the own pose at it."""
    faulty = int(0)
    least = wp.float64(wp.inf)
    pose = landmark_only.pose
    for n in range(frame.bearings):
        for m in range(frame.bearings):
            memory.measurement[world, m].fits = wp.where(m == n, 0, 1)
        cost = cost_of(frame, memory, world, i, landmark_only)
        if cost < least:
            least = cost
            faulty = memory.measurement[world, n].reported_by
            pose = memory.member[world, i, 0].pose
    return faulty, least, pose


@device_function
def find_alternative_hypothesis(
    model: Any, state: Any, memory: Any, world: int, i: int, tick: int, landmark_only: PoseEstimate
):
    """Return the frame and the index of the member to exclude in place of the present exclusions.

    The index is 0 if no exclusion lowers the cost enough. The own pose is restored before returning.
    """
    frame = set_report_measurements(model, state, memory, world, i, tick)
    rejected = int(0)
    for n in range(frame.bearings):
        fits = wp.where(is_rejected(memory, world, i, memory.measurement[world, n].reported_by), 0, 1)
        memory.measurement[world, n].fits = fits
        rejected += 1 - fits
    if rejected == 0:
        return frame, int(0)
    belief, own = isolate_own(memory, world, i)
    cost = cost_of(frame, memory, world, i, landmark_only)
    faulty, least, pose = least_cost(frame, memory, world, i, landmark_only)
    memory.belief[world, i] = belief
    put_own(memory, world, i, own)
    elsewhere = distance_squared(own, PoseEstimate(pose, mat66d())) > wp.float64(constants.SEPARATION_GATE)
    convincing = cost - least > wp.float64(constants.RETEST_MARGIN)
    return frame, wp.where(elsewhere and convincing, faulty, 0)


LASTING_FRAME = constants.LINEARISATION_TIME / constants.CONSIDERED_LINEARISATION_TIME
"""Factor of a frame's period, by which its linearisation error is correlated for longer."""


@device_function
def begin_landmark_only(memory: Any, world: int, i: int, estimate: PoseEstimate, tick: int):
    """Begin the landmark-only solution with an estimate at a tick."""
    exposed = memory.landmark_only[world, i].exposed
    memory.landmark_only[world, i] = LandmarkOnlySolution(1, exposed, tick, memory.belief[world, i].odometry, estimate)


@device_function
def begin_broadcasts(model: Any, memory: Any, world: int, i: int):
    """Clear all messages; begin the landmark-only solution with the initial estimate, unless a search is active.

    A search may use every sender. An initial estimate depends on no sender.
    """
    clear_broadcasts(memory, world, i)
    memory.landmark_only[world, i] = LandmarkOnlySolution()
    if memory.search[world, i].active == 0:
        memory.belief[world, i].depends_on = wp.uint64(0)
        begin_landmark_only(memory, world, i, own_estimate(memory, world, i), 0)


@device_function
def propagate_landmark_only(model: Any, memory: Any, world: int, i: int, tick: int):
    """Propagate the landmark-only solution by odometry; return the time since the last propagation, s."""
    landmark_only = memory.landmark_only[world, i]
    elapsed = wp.float64(tick - landmark_only.tick) * model.camera_period
    step = between(landmark_only.odometry, memory.belief[world, i].odometry)
    noise = wp.float64(constants.LANDMARK_ONLY_NOISE) * increment_noise(model, memory, world, i, step, elapsed)
    begin_landmark_only(memory, world, i, carried(landmark_only.estimate, step, noise), tick)
    return elapsed


@device_function
def correct_landmark_only(model: Any, frame: BearingFrame, memory: Any, world: int, i: int, elapsed: Any) -> int:
    """Correct the landmark-only solution by a frame, `elapsed` (s) after the last one; return how many landmarks fit.

    If landmarks are in view and none fits, the solution begins anew. It takes the belief's place during the correction.
    Errors that are the same in all frames count as one measurement.
    """
    belief, own = isolate_own(memory, world, i)
    put_own(memory, world, i, memory.landmark_only[world, i].estimate)
    frames = wp.max(wp.float64(constants.CONSIDERED_LINEARISATION_TIME) / elapsed, wp.float64(1.0))
    mounting = wp.float64(constants.LANDMARK_ONLY_NOISE) * frames * mounting_variances(model, i)
    variance = wp.float64(constants.LANDMARK_ONLY_NOISE) * frame.variance + mounting[0]
    inflated = BearingFrame()
    inflated.bearings = frame.bearings
    inflated.lever = frame.lever
    inflated.variance = variance
    inflated.period = wp.float64(LASTING_FRAME) * elapsed
    fitting = int(0)
    landmarks = int(0)
    for n in range(inflated.bearings):
        fits = int(0)
        if memory.measurement[world, n].member == 0:
            landmarks += 1
            memory.measurement[world, n].variance = mounting[1]
            if innovation_squared(inflated, memory, world, i, n) < wp.float64(constants.BEARING_GATE):
                fits = 1
        memory.measurement[world, n].fits = fits
        fitting += fits
    if fitting > 0:
        iterated_update(inflated, memory, world, i)
        memory.landmark_only[world, i].estimate = own_estimate(memory, world, i)
    elif landmarks > 0:
        memory.landmark_only[world, i].begun = 0
    memory.belief[world, i] = belief
    put_own(memory, world, i, own)
    return fitting


@device_function
def exchange_own(memory: Any, world: int, i: int, estimate: PoseEstimate):
    """Set the own pose to an estimate that depends on no sender; keep its cross-covariances in `scratch.row`."""
    put_own(memory, world, i, estimate)
    for k in range(1, memory.belief[world, i].members):
        memory.scratch[world, k].row = memory.P[world, i, 0, k]
        set_block(memory, world, i, 0, k, mat66d())


@device_function
def restore_own(memory: Any, world: int, i: int, estimate: PoseEstimate):
    """Restore the own pose and its cross-covariances."""
    put_own(memory, world, i, estimate)
    for k in range(1, memory.belief[world, i].members):
        set_block(memory, world, i, 0, k, memory.scratch[world, k].row)


@device_function
def is_fused_sender(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether the n-th bearing is to a sender whose reports are fused."""
    member = memory.measurement[world, n].member
    return member > 0 and memory.member[world, i, member].considered == 1


@device_function
def cost_without(memory: Any, world: int, i: int, bearings: int, without: int):
    """Return the cost of the bearings to all fused senders except the one of measurement `without`."""
    for n in range(bearings):
        fits = int(0)
        if n != without and is_fused_sender(memory, world, i, n):
            fits = 1
        memory.measurement[world, n].fits = fits
    return correct_by_bearings(memory, world, i, bearings, False)


@device_function
def find_fault_hypothesis(frame: BearingFrame, memory: Any, world: int, i: int, suspect: int):
    """Return (member, its cost, cost without the suspect, bearings): the member whose omission leaves the least cost.

    The member is 0 if no fused sender is in view. Costs are normalised innovations squared of the other bearings, about
    the landmark-only solution. The cost without the suspect is infinite if the suspect is out of view.
    """
    own = own_estimate(memory, world, i)
    exchange_own(memory, world, i, memory.landmark_only[world, i].estimate)
    faulty = int(0)
    least = wp.float64(wp.inf)
    without = wp.float64(wp.inf)
    count = int(0)
    for n in range(frame.bearings):
        if not innovation_squared(frame, memory, world, i, n) < wp.float64(wp.inf):
            memory.measurement[world, n].residual = vec2d(wp.float64(constants.NOT_AHEAD))
    store_poses(memory, world, i)
    for n in range(frame.bearings):
        if is_fused_sender(memory, world, i, n):
            count += 1
            cost = cost_without(memory, world, i, frame.bearings, n)
            member = memory.measurement[world, n].member
            if cost < least:
                faulty = member
                least = cost
            if member == suspect:
                without = cost
    restore_own(memory, world, i, own)
    return faulty, least, without, count


@wp.func
def consistent_cost(bearings: int):
    """Return the largest cost of consistent bearings: the 0.999 quantile of chi-square, by Wilson and Hilferty.

    Source: Wilson and Hilferty, The distribution of chi-square, Proc. National Academy of Sciences 17(12), 1931.
    """
    dof = wp.float64(2.0) * wp.float64(bearings)
    if bearings == 0:
        return wp.float64(0.0)
    a = wp.float64(2.0 / 9.0) / dof
    root = wp.float64(1.0) - a + wp.float64(constants.CONSISTENT_QUANTILE) * wp.sqrt(a)
    return dof * root * root * root


@device_function
def revert_to_landmark_only(model: Any, frame: BearingFrame, memory: Any, world: int, i: int, tick: int, faulty: int):
    """Reset the belief to the landmark-only solution; exclude the faulty member and all that contradict landmarks."""
    landmark_only = memory.landmark_only[world, i].estimate
    away = wp.length(landmark_only.pose.p - memory.member[world, i, 0].pose.p)
    exchange_own(memory, world, i, landmark_only)
    members = memory.belief[world, i].members
    others = memory.belief[world, i].others
    for k in range(1, members):
        for j in range(1, wp.min(k, others)):
            set_block(memory, world, i, k, j, mat66d())
    begin_errors(model, memory, world, i)
    reset_monitors(memory, world, i)
    for k in range(others, members):
        if memory.member[world, i, k].considered == 0:
            noise = vec2d(wp.float64(0.0), away * away)
            memory.P[world, i, k, k] = with_noise(memory.P[world, i, k, k], noise)
    memory.belief[world, i].rejected_share = wp.float64(0.0)
    set_anchor(memory, world, i, landmark_only.P, tick)
    memory.landmark_only[world, i].exposed = 0
    for n in range(frame.bearings):
        if is_fused_sender(memory, world, i, n):
            fits = innovation_squared(frame, memory, world, i, n) < wp.float64(constants.BEARING_GATE)
            member = memory.measurement[world, n].member
            if member == faulty or not fits:
                far = wp.length(memory.measurement[world, n].residual) * memory.measurement[world, n].distance
                exclude(model, memory, world, i, member, tick, far, False)


@device_function
def test_suspect(model: Any, frame: BearingFrame, memory: Any, world: int, i: int, tick: int):
    """Exclude the suspect, or another sender if landmarks contradict that one more clearly."""
    suspect = memory.belief[world, i].suspect
    propagate_landmark_only(model, memory, world, i, tick)
    faulty, least, without, _ = find_fault_hypothesis(frame, memory, world, i, suspect)
    if wp.isfinite(without) and without - least > wp.float64(constants.DISPUTE_MARGIN):
        revert_to_landmark_only(model, frame, memory, world, i, tick, faulty)
    else:
        fused = memory.belief[world, i].suspect_fused == 1
        exclude(model, memory, world, i, suspect, tick, memory.belief[world, i].suspect_error, fused)


@device_function
def test_separation(model: Any, frame: BearingFrame, memory: Any, world: int, i: int, tick: int):
    """Reset the belief if it is separated from the landmark-only solution.

    If several senders contradict that solution and few landmarks are in view, its odometry may be wrong. The solution
    then begins anew instead.
    """
    elapsed = propagate_landmark_only(model, memory, world, i, tick)
    landmarks = correct_landmark_only(model, frame, memory, world, i, elapsed)
    exposed = memory.landmark_only[world, i].exposed == 1
    pose = memory.member[world, i, 0].pose
    away = distance_squared(memory.landmark_only[world, i].estimate, PoseEstimate(pose, mat66d()))
    if exposed and landmarks > 0 and away > wp.float64(constants.SEPARATION_GATE):
        faulty, least, _, count = find_fault_hypothesis(frame, memory, world, i, 0)
        consistent = count == 0 or least <= consistent_cost(count - 1)
        if consistent or landmarks >= constants.ENOUGH_LANDMARKS:
            revert_to_landmark_only(model, frame, memory, world, i, tick, faulty)
        else:
            memory.landmark_only[world, i].begun = 0


@device_function
def retest_exclusion(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Exclude another sender and readmit excluded ones, if that explains this frame's bearings better."""
    frame, faulty = find_alternative_hypothesis(
        model, state, memory, world, i, now.tick, memory.landmark_only[world, i].estimate
    )
    if faulty == 0:
        return
    for n in range(frame.bearings):
        k = memory.measurement[world, n].reported_by
        if k != faulty and memory.member[world, i, k].excluded == 1:
            readmit(model, memory, world, i, k)
    frame = set_bearing_measurements(model, state, memory, world, i, now, TRACKING)
    revert_to_landmark_only(model, frame, memory, world, i, now.tick, faulty)
    if memory.member[world, i, faulty].excluded == 0:
        exclude(model, memory, world, i, faulty, now.tick, wp.float64(0.0), False)


@device_function
def note_exposure(memory: Any, world: int, i: int):
    """Note whether the belief has fused any sender."""
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            memory.landmark_only[world, i].exposed = 1


@device_function
def separate(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Test the frame's suspect, or, every `LANDMARK_ONLY_PERIOD`, the belief as a whole."""
    if memory.search[world, i].active == 1:
        memory.landmark_only[world, i].begun = 0
    elif now.due:
        if memory.landmark_only[world, i].begun == 0:
            variances = vec2d(wp.float64(KNOWN_ANGLE_VARIANCE), wp.float64(KNOWN_POSITION_VARIANCE))
            pose = memory.member[world, i, 0].pose
            begin_landmark_only(memory, world, i, PoseEstimate(pose, with_noise(mat66d(), variances)), now.tick)
        note_exposure(memory, world, i)
        since = wp.float64(now.tick - memory.landmark_only[world, i].tick) * model.camera_period
        looking = since > wp.float64(constants.LANDMARK_ONLY_PERIOD - constants.SAME_TIME)
        if looking or memory.belief[world, i].suspect > 0:
            frame = set_bearing_measurements(model, state, memory, world, i, now, TRACKING)
            if memory.belief[world, i].suspect > 0:
                test_suspect(model, frame, memory, world, i, now.tick)
            else:
                test_separation(model, frame, memory, world, i, now.tick)
                if memory.landmark_only[world, i].begun == 1:
                    retest_exclusion(model, state, memory, world, i, now)
    memory.belief[world, i].suspect = 0
