"""Search for the pose beside the tracked estimate: solutions of the P3P problem compete until motion separates them.

Each hypothesis has a filter of its own. Its cost is the sum of its normalised innovations squared, each bounded. The
difference of two costs is twice the logarithm of the likelihood ratio, if both have the same noise; otherwise a vague
hypothesis with a large linearisation error would have the least cost. Hypotheses with a cost far above the least one
are pruned. The belief's arrays serve to correct one hypothesis after the other.

Noise can remove two close solutions of P3P. Every bearing, and every position that is not exactly known, is therefore
also perturbed by some standard deviations to each side.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import symmetric_part
from coopenv.observers.p3p import camera_pose, solve_triangle
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    Pose,
    PoseEstimate,
    carried,
    distance_squared,
    inverse6,
    is_known,
    is_regular,
    mat33d,
    mat66d,
)
from coopenv.observers.robust.correction import iterated_update
from coopenv.observers.robust.joint_state import begin_belief, own_estimate, set_block
from coopenv.observers.robust.linearisation import innovation_squared, innovation_with, linearise, tangent_basis
from coopenv.observers.robust.measurements import frames_in, set_bearing_measurements
from coopenv.observers.robust.memory import ERRORS, MOUNTING, BearingFrame, Hypothesis, Search
from coopenv.world.warp_internals import device_function, subroutine

PROBLEMS = 1 + 3 * 2 * 5
"""Problems of three bearings: as measured; each moved to either side along two axes across it, and its point along
three."""


@device_function
def next_triple(memory: Any, world: int, i: int, count: int, size: Any, number: int):
    """Return (bearings, size, number) of the triple that spans most after the one of this size and number.

    The size is twice the area that three bearings span; a good triple looks in three very different directions.
    """
    best = wp.vec3i(-1, -1, -1)
    best_size = wp.float64(-1.0)
    best_number = int(0)
    here = int(0)
    for n0 in range(count):
        for n1 in range(n0 + 1, count):
            for n2 in range(n1 + 1, count):
                a = memory.measurement[world, i, n0].bearing
                area = wp.length(
                    wp.cross(memory.measurement[world, i, n1].bearing - a, memory.measurement[world, i, n2].bearing - a)
                )
                later = area < size or (area == size and here > number)
                if later and area > best_size:
                    best = wp.vec3i(n0, n1, n2)
                    best_size = area
                    best_number = here
                here += 1
    return best, best_size, best_number


@subroutine
def is_determined(frame: BearingFrame, memory: Any, world: int, i: int, triple: Any, require_determined: bool) -> bool:
    """Return whether three bearings determine the present pose well enough, and set its covariance by them."""
    M = mat66d()
    for n in range(3):
        linearise(frame, memory, world, i, triple[n])
        H = memory.derivative[world, i, triple[n], 0].jacobian
        M += (wp.transpose(H) * (wp.float64(1.0) / memory.measurement[world, i, triple[n]].noise)) * H
    P = symmetric_part(inverse6(M))
    memory.P[world, i, 0, 0] = P
    if require_determined:
        return is_known(P)
    angles = wp.vec3d(P[0, 0], P[1, 1], P[2, 2])
    determined = wp.min(angles) > wp.float64(0.0) and wp.max(angles) <= wp.float64(1.0)
    return determined and is_regular(M, P, wp.float64(constants.MAX_CONDITION))


@device_function
def is_new(memory: Any, world: int, i: int, h: int, count: int) -> bool:
    """Return whether a hypothesis differs from each of the first `count`."""
    for g in range(count):
        distance = distance_squared(memory.hypothesis[world, i, h].estimate, memory.hypothesis[world, i, g].estimate)
        if distance < wp.float64(constants.POSE_GATE):
            return False
    return True


@subroutine
def add_hypothesis(memory: Any, world: int, i: int):
    """Add the present estimate as a hypothesis, unless there is one like it."""
    h = memory.search[world, i].hypotheses
    if h < constants.MAX_HYPOTHESES:
        memory.hypothesis[world, i, h] = Hypothesis()
        memory.hypothesis[world, i, h].estimate = own_estimate(memory, world, i)
        if is_new(memory, world, i, h, h):
            memory.search[world, i].hypotheses = h + 1


@device_function
def problem(frame: BearingFrame, memory: Any, world: int, i: int, triple: Any, number: int):
    """Return whether problem `number`, below `PROBLEMS`, exists, and its bearings and points, rows.

    The first is as measured. In the others a bearing is perturbed along an axis across it, or its point if that is not
    exactly known, to one side or the other.
    """
    b = mat33d()
    z = mat33d()
    for n in range(3):
        b[n] = memory.measurement[world, i, triple[n]].bearing
        z[n] = memory.measurement[world, i, triple[n]].point
    exists = bool(True)
    if number > 0:
        n = (number - 1) // 10
        axis = (number - 1) % 5
        side = wp.where((number - 1) // 5 % 2 == 1, wp.float64(-1.0), wp.float64(1.0))
        if axis < 2:
            across = side * wp.float64(constants.MARGIN) * wp.sqrt(frame.variance)
            b[n] = wp.normalize(b[n] + across * tangent_basis(b[n])[axis])
        else:
            variance = memory.measurement[world, i, triple[n]].variance  # `received_variance` has the squared margin
            z[n, axis - 2] = z[n, axis - 2] + side * wp.sqrt(variance)
            exists = variance > wp.float64(0.0)
    return exists, b, z


@subroutine
def solve_triple(
    frame: BearingFrame, memory: Any, world: int, i: int, triple: Any, require_determined: bool, tracking: bool
) -> bool:
    """Make hypotheses of the poses that agree with three bearings, in their order, if `tracking`.

    Return False if `require_determined` and a solution is not well determined.
    """
    memory.search[world, i].hypotheses = 0
    for number in range(PROBLEMS):
        exists, b, z = problem(frame, memory, world, i, triple, number)
        if not exists:
            continue
        count, distances = solve_triangle(b, z)
        for n in range(count):
            R, camera = camera_pose(b, z, distances[n])
            if wp.isfinite(wp.ddot(R, R) + wp.dot(camera, camera)):
                pose = Pose(R, camera - R * frame.lever)
                begin_belief(memory, world, i, PoseEstimate(pose, mat66d()))
                determined = is_determined(frame, memory, world, i, triple, require_determined)
                if require_determined and not determined:
                    return False
                if tracking and determined:
                    add_hypothesis(memory, world, i)
    return True


@device_function
def begin_search(memory: Any, world: int, i: int):
    """Begin a search without hypotheses."""
    memory.search[world, i] = Search()
    memory.search[world, i].active = 1
    memory.search[world, i].least_time = wp.float64(constants.SHORT_TIME)


@device_function
def propagate_search(memory: Any, world: int, i: int, step: Pose, noise: Any):
    """Carry all hypotheses through a tick's odometry."""
    for h in range(memory.search[world, i].hypotheses):
        memory.hypothesis[world, i, h].estimate = carried(memory.hypothesis[world, i, h].estimate, step, noise)


@device_function
def sort_hypotheses(memory: Any, world: int, i: int):
    """Sort hypotheses by ascending cost; equal costs by the distance to the prior."""
    count = memory.search[world, i].hypotheses
    for h in range(count):
        for g in range(h + 1, count):
            a = memory.hypothesis[world, i, h]
            b = memory.hypothesis[world, i, g]
            if b.cost < a.cost or (b.cost == a.cost and b.prior_distance < a.prior_distance):
                memory.hypothesis[world, i, h] = b
                memory.hypothesis[world, i, g] = a


@device_function
def prune(memory: Any, world: int, i: int):
    """Prune hypotheses with a large cost, duplicates of better ones, and all of them if the best one misfits."""
    sort_hypotheses(memory, world, i)
    least = memory.hypothesis[world, i, 0].cost
    misfit = memory.hypothesis[world, i, 0].misfit
    kept = int(0)
    for h in range(memory.search[world, i].hypotheses):
        near = memory.hypothesis[world, i, h].cost <= least + wp.float64(constants.PRUNE_GAP)
        if near and is_new(memory, world, i, h, kept):
            memory.hypothesis[world, i, kept] = memory.hypothesis[world, i, h]
            kept += 1
    if misfit > wp.float64(constants.MAX_MISFIT):
        kept = 0
    memory.search[world, i].hypotheses = kept


@device_function
def set_common_noise(frame: BearingFrame, memory: Any, world: int, i: int):
    """Set the noise of every bearing for comparisons: the largest for any hypothesis."""
    for n in range(frame.bearings):
        memory.measurement[world, i, n].common_noise = wp.float64(0.0)
    for h in range(memory.search[world, i].hypotheses):
        begin_belief(memory, world, i, memory.hypothesis[world, i, h].estimate)
        for n in range(frame.bearings):
            linearise(frame, memory, world, i, n)
            noise = memory.measurement[world, i, n].noise
            memory.measurement[world, i, n].common_noise = wp.max(memory.measurement[world, i, n].common_noise, noise)


@device_function
def expected_of(frame: BearingFrame, memory: Any, world: int, i: int, n: int):
    """Return the expected normalised innovation squared of a bearing for the true hypothesis.

    Noise beyond the camera's stands for a correlated error, multiplied by the number of frames in its correlation time.
    """
    time = wp.float64(constants.LINEARISATION_TIME)
    if memory.measurement[world, i, n].variance > wp.float64(0.0):
        time = wp.float64(constants.MEAN_TIME)
    noise = memory.measurement[world, i, n].noise
    persistent = (noise - frame.variance) / frames_in(time, frame.period)
    return wp.float64(2.0) * (frame.variance + persistent) / noise


@device_function
def track_hypothesis(frame: BearingFrame, memory: Any, world: int, i: int, h: int, used: Any):
    """Add the frame's unused bearings to the cost of a hypothesis; correct it by the bearings that fit."""
    begin_belief(memory, world, i, memory.hypothesis[world, i, h].estimate)
    fitting = int(0)
    for n in range(frame.bearings):
        fits = int(0)
        if n != used[0] and n != used[1] and n != used[2]:
            nis = innovation_squared(frame, memory, world, i, n)
            if nis < wp.float64(constants.BEARING_GATE):
                fits = 1
            cost = nis
            if wp.isfinite(nis):
                cost = innovation_with(memory, world, i, n, memory.measurement[world, i, n].common_noise)
            memory.hypothesis[world, i, h].cost += wp.min(cost, wp.float64(constants.BEARING_GATE))
            memory.hypothesis[world, i, h].misfit += wp.min(nis, wp.float64(constants.BEARING_GATE))
            memory.hypothesis[world, i, h].misfit -= wp.float64(2.0) * expected_of(frame, memory, world, i, n)
        memory.measurement[world, i, n].fits = fits
        fitting += fits
    if fitting > 0:
        iterated_update(frame, memory, world, i)
        memory.hypothesis[world, i, h].estimate = own_estimate(memory, world, i)


@device_function
def add_prior(memory: Any, world: int, i: int):
    """Add the tracked estimate as a hypothesis if it is known; the others have the distance to it as a cost."""
    h = memory.search[world, i].hypotheses
    for g in range(h):
        distance = distance_squared(memory.search[world, i].prior, memory.hypothesis[world, i, g].estimate)
        memory.hypothesis[world, i, g].cost = wp.min(distance, wp.float64(constants.MAX_PRIOR_COST))
        memory.hypothesis[world, i, g].prior_distance = distance
    if is_known(memory.search[world, i].prior.P):
        memory.hypothesis[world, i, h] = Hypothesis()
        memory.hypothesis[world, i, h].estimate = memory.search[world, i].prior
        memory.search[world, i].hypotheses = h + 1


@device_function
def chosen_triple(frame: BearingFrame, memory: Any, world: int, i: int):
    """Return three well placed bearings, different ones at every attempt."""
    triples = frame.bearings * (frame.bearings - 1) * (frame.bearings - 2) // 6
    triple = wp.vec3i(0, 0, 0)
    size = wp.float64(wp.inf)
    number = int(-1)
    for _ in range(memory.search[world, i].attempts % triples + 1):
        triple, size, number = next_triple(memory, world, i, frame.bearings, size, number)
    return triple


@device_function
def solve_chosen(
    frame: BearingFrame, memory: Any, world: int, i: int, triple: Any, period: Any, require_determined: bool
) -> bool:
    """Solve a triple; return whether its solutions are hypotheses now: if all were well determined for some time.

    Near a double solution the error has no ellipsoidal region, and noise makes the solutions appear and vanish. With
    time the estimates of a follower's leaders improve, which separates the solutions.
    """
    determined = wp.max(memory.search[world, i].determined_time, period)
    tracking = not require_determined or determined >= wp.float64(constants.NEWS_TIME)
    if not solve_triple(frame, memory, world, i, triple, require_determined, tracking):
        determined = wp.float64(-constants.NEWS_TIME)
        tracking = False
    if tracking:
        determined = wp.float64(0.0)
        least = wp.where(require_determined, wp.float64(constants.SHORT_TIME), wp.float64(constants.LONG_TIME))
        memory.search[world, i].least_time = least
    else:
        memory.search[world, i].hypotheses = 0
    memory.search[world, i].determined_time = determined
    return tracking


@subroutine
def begin_hypotheses(frame: BearingFrame, memory: Any, world: int, i: int, period: Any):
    """Begin with the solutions of three bearings, others in each attempt, and the tracked estimate if it is known.

    Return the used bearings, and for how many hypotheses.
    """
    triple = wp.vec3i(-1, -1, -1)
    solved = int(0)
    memory.search[world, i].waited_time += period
    memory.search[world, i].determined_time += period
    require_determined = memory.search[world, i].waited_time < wp.float64(constants.LONG_TIME)
    tracking = bool(False)
    # not soon after a frame that did not determine the pose
    if not require_determined or memory.search[world, i].determined_time > wp.float64(-constants.SAME_TIME):
        triple = chosen_triple(frame, memory, world, i)
        tracking = solve_chosen(frame, memory, world, i, triple, period, require_determined)
        solved = memory.search[world, i].hypotheses
    if tracking:
        add_prior(memory, world, i)
        memory.search[world, i].attempts += 1
        memory.search[world, i].tracked_time = wp.float64(0.0)
    return triple, solved


@subroutine
def update_hypotheses(model: Any, state: Any, memory: Any, world: int, i: int, now: Any) -> bool:
    """Update the hypotheses by a frame; return whether a single one is left after some frames."""
    frame = set_bearing_measurements(model, state, memory, world, i, now, True)
    beginning = memory.search[world, i].hypotheses == 0
    triple = wp.vec3i(-1, -1, -1)
    solved = int(0)
    if beginning:
        if frame.bearings < 3:
            return False
        triple, solved = begin_hypotheses(frame, memory, world, i, now.period)
    set_common_noise(frame, memory, world, i)
    for h in range(memory.search[world, i].hypotheses):
        used = wp.vec3i(-1, -1, -1)
        if h < solved:
            used = triple
        track_hypothesis(frame, memory, world, i, h, used)
    if beginning:
        sort_hypotheses(memory, world, i)
        memory.search[world, i].hypotheses = wp.min(memory.search[world, i].hypotheses, constants.MAX_HYPOTHESES)
        return False
    memory.search[world, i].tracked_time += now.period
    prune(memory, world, i)
    single = memory.search[world, i].hypotheses == 1
    return single and memory.search[world, i].tracked_time >= memory.search[world, i].least_time


@subroutine
def advance_search(model: Any, state: Any, memory: Any, world: int, i: int, now: Any) -> bool:
    """Update the hypotheses by a frame; return whether a single one is left after some frames.

    The belief's arrays serve one hypothesis after the other, and then hold the tracked estimate again.
    """
    members = memory.belief[world, i].members
    tracked = own_estimate(memory, world, i)
    memory.search[world, i].prior = tracked
    with_errors = memory.P[world, i, 0, ERRORS]
    with_mounting = memory.P[world, i, 0, MOUNTING]
    of_calibration = memory.P[world, i, ERRORS, MOUNTING]
    single = update_hypotheses(model, state, memory, world, i, now)
    memory.belief[world, i].members = members
    memory.member[world, i, 0].pose = tracked.pose
    memory.P[world, i, 0, 0] = tracked.P
    set_block(memory, world, i, 0, ERRORS, with_errors)
    set_block(memory, world, i, 0, MOUNTING, with_mounting)
    set_block(memory, world, i, ERRORS, MOUNTING, of_calibration)
    return single
