"""Finding one's pose from nothing: solutions of the P3P problem are followed until motion has told them apart.

Each hypothesis is a small filter of its own; one that predicts the bearings much worse than the best is given up. It
costs its normalised innovations squared, each limited, so that the difference of two costs is twice the logarithm of
their likelihoods' ratio; those that cost least come first. For that their noise must be the same: a vague hypothesis,
whose linearisation leaves more out, would win by its noise. While a vehicle searches it believes nothing, so that the
belief's arrays serve to correct one hypothesis after the other.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import carried, distance_squared, is_known
from coopenv.observers.robust.belief import begin_belief, own_estimate
from coopenv.observers.robust.correction import iterated_update
from coopenv.observers.robust.measurements import SEARCH, innovation_squared, innovation_with, linearise, set_lines
from coopenv.observers.robust.memory import Estimate, Frame, Hypothesis, Pose, Search
from coopenv.observers.robust.solutions import is_new, next_triple, solve_triple
from coopenv.world.device_function import device_function


@device_function
def begin_search(memory: Any, world: int, i: int, prior: Estimate):
    """Start from a prior, without hypotheses."""
    memory.search[world, i] = Search()
    memory.search[world, i].active = 1
    memory.search[world, i].prior = prior
    memory.search[world, i].least_time = wp.float64(constants.MIN_SEARCH_TIME)


@device_function
def propagate_search(memory: Any, world: int, i: int, step: Pose, noise: Any):
    """Carry the prior and all hypotheses through a tick's odometry."""
    memory.search[world, i].prior = carried(memory.search[world, i].prior, step, noise)
    for h in range(memory.search[world, i].hypotheses):
        memory.hypothesis[world, i, h].estimate = carried(memory.hypothesis[world, i, h].estimate, step, noise)


@device_function
def costs_less(memory: Any, world: int, i: int, h: int, g: int) -> bool:
    """Return whether a hypothesis costs less than another one, or as much and is nearer to the prior."""
    a = memory.hypothesis[world, i, h].cost
    b = memory.hypothesis[world, i, g].cost
    if a == b:
        return memory.hypothesis[world, i, h].prior_distance < memory.hypothesis[world, i, g].prior_distance
    return a < b


@device_function
def sort_hypotheses(memory: Any, world: int, i: int):
    """Put those that cost least first."""
    count = memory.search[world, i].hypotheses
    for h in range(count):
        for g in range(h + 1, count):
            if costs_less(memory, world, i, g, h):
                other = memory.hypothesis[world, i, h]
                memory.hypothesis[world, i, h] = memory.hypothesis[world, i, g]
                memory.hypothesis[world, i, g] = other


@device_function
def prune(memory: Any, world: int, i: int):
    """Give up what costs much more than the best, what is the same as a better one, and all if the best is not good."""
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
def set_common_noise(frame: Frame, memory: Any, world: int, i: int):
    """Set for every line the largest noise that it has for any hypothesis, by which all of them are compared."""
    for n in range(frame.lines):
        memory.line[world, n].common_noise = wp.float64(0.0)
    for h in range(memory.search[world, i].hypotheses):
        begin_belief(memory, world, i, memory.hypothesis[world, i, h].estimate)
        for n in range(frame.lines):
            linearise(frame, memory, world, i, n)
            noise = memory.line[world, n].noise
            memory.line[world, n].common_noise = wp.max(memory.line[world, n].common_noise, noise)


@device_function
def expected_of(frame: Frame, memory: Any, world: int, n: int):
    """Return the normalised innovation squared of a line that is expected of a true hypothesis.

    Noise that is not the camera's stands for an error that is the same for a while, times the frames in that.
    """
    time = wp.float64(constants.BEND_TIME)
    if memory.line[world, n].variance > wp.float64(0.0):
        time = wp.float64(constants.CORRELATION_TIME)
    noise = memory.line[world, n].noise
    lasting = (noise - frame.variance) / wp.max(time / frame.period, wp.float64(1.0))
    return wp.float64(2.0) * (frame.variance + lasting) / noise


@device_function
def follow_hypothesis(frame: Frame, memory: Any, world: int, i: int, h: int, used: Any):
    """Add the frame's bearings, but those used already, to the cost of a hypothesis; correct it by those that fit."""
    begin_belief(memory, world, i, memory.hypothesis[world, i, h].estimate)
    fitting = int(0)
    for n in range(frame.lines):
        fits = int(0)
        if n != used[0] and n != used[1] and n != used[2]:
            nis = innovation_squared(frame, memory, world, i, n)
            if nis < wp.float64(constants.BEARING_GATE):
                fits = 1
            cost = nis
            if wp.isfinite(nis):
                more = memory.line[world, n].common_noise - memory.line[world, n].noise
                cost = innovation_with(memory, world, n, more)
            memory.hypothesis[world, i, h].cost += wp.min(cost, wp.float64(constants.MAX_BEARING_COST))
            memory.hypothesis[world, i, h].misfit += wp.min(nis, wp.float64(constants.MAX_BEARING_COST))
            memory.hypothesis[world, i, h].misfit -= wp.float64(2.0) * expected_of(frame, memory, world, n)
        memory.line[world, n].fits = fits
        fitting += fits
    if fitting > 0:
        iterated_update(frame, memory, world, i)
        memory.hypothesis[world, i, h].estimate = own_estimate(memory, world, i)


@device_function
def add_prior(memory: Any, world: int, i: int):
    """Add the prior as a hypothesis if it is known well enough to be followed."""
    prior = memory.search[world, i].prior
    if is_known(prior.P):
        h = memory.search[world, i].hypotheses
        memory.hypothesis[world, i, h] = Hypothesis()
        memory.hypothesis[world, i, h].estimate = prior
        memory.search[world, i].hypotheses = h + 1


@device_function
def chosen_triple(frame: Frame, memory: Any, world: int, i: int):
    """Return three well placed bearings, others at every attempt."""
    triples = frame.lines * (frame.lines - 1) * (frame.lines - 2) // 6
    lines = wp.vec3i(0, 0, 0)
    size = wp.float64(wp.inf)
    number = int(-1)
    for _ in range(memory.search[world, i].attempts % triples + 1):
        lines, size, number = next_triple(memory, world, frame.lines, size, number)
    return lines


@device_function
def wait(memory: Any, world: int, i: int, period: Any) -> bool:
    """Count the time of a frame; return whether to look at it: not soon after one that was in doubt."""
    memory.search[world, i].waited_time += period
    memory.search[world, i].clear_time += period
    patient = memory.search[world, i].waited_time < wp.float64(constants.PATIENCE)
    return not patient or memory.search[world, i].clear_time > wp.float64(-constants.SAME_TIME)


@device_function
def solve_chosen(frame: Frame, memory: Any, world: int, i: int, lines: Any, period: Any) -> bool:
    """Solve a triple; return whether its solutions are hypotheses now: if for a while all were well determined.

    Where two solutions nearly meet, the region where they may be is no ellipsoid, and noise makes them come and go;
    meanwhile a follower's leaders improve, which sets them apart.
    """
    clear = wp.max(memory.search[world, i].clear_time, period)
    patient = memory.search[world, i].waited_time < wp.float64(constants.PATIENCE)
    following = not patient or clear >= wp.float64(constants.CLEAR_TIME)
    if not solve_triple(frame, memory, world, i, lines, patient, following):
        clear = wp.float64(-constants.DOUBT_TIME)
        following = False
    if following:
        for h in range(memory.search[world, i].hypotheses):
            distance = distance_squared(memory.search[world, i].prior, memory.hypothesis[world, i, h].estimate)
            memory.hypothesis[world, i, h].cost = wp.min(distance, wp.float64(constants.MAX_PRIOR_COST))
            memory.hypothesis[world, i, h].prior_distance = distance
            memory.hypothesis[world, i, h].misfit = wp.float64(0.0)
        clear = wp.float64(0.0)
        least = wp.where(patient, wp.float64(constants.MIN_SEARCH_TIME), wp.float64(constants.MIN_DOUBTFUL_TIME))
        memory.search[world, i].least_time = least
    memory.search[world, i].clear_time = clear
    return following


@device_function
def begin_hypotheses(frame: Frame, memory: Any, world: int, i: int, period: Any):
    """Begin with a known prior at first, then with a frame's solutions, too; every attempt takes other bearings.

    Return the bearings that have been used, and for how many hypotheses.
    """
    lines = wp.vec3i(-1, -1, -1)
    solved = int(0)
    following = memory.search[world, i].attempts == 0 and is_known(memory.search[world, i].prior.P)
    if not following:
        if wait(memory, world, i, period):
            lines = chosen_triple(frame, memory, world, i)
            following = solve_chosen(frame, memory, world, i, lines, period)
            solved = memory.search[world, i].hypotheses
    if following:
        add_prior(memory, world, i)
        memory.search[world, i].attempts += 1
        memory.search[world, i].followed_time = wp.float64(0.0)
    return lines, solved


@device_function
def put_off(memory: Any, world: int, i: int):
    """Follow the hypothesis that is left for some more frames: this one has not told the pose well enough."""
    memory.search[world, i].least_time = memory.search[world, i].followed_time + wp.float64(constants.DOUBT_TIME)


@device_function
def advance_search(model: Any, state: Any, memory: Any, world: int, i: int, now: Any) -> bool:
    """Take a frame's bearings; return whether one hypothesis alone is left after some frames."""
    frame = set_lines(model, state, memory, world, i, now.tick, now.period, SEARCH)
    beginning = memory.search[world, i].hypotheses == 0
    lines = wp.vec3i(-1, -1, -1)
    solved = int(0)
    if beginning:
        if frame.lines < 3:
            return False
        lines, solved = begin_hypotheses(frame, memory, world, i, now.period)
    set_common_noise(frame, memory, world, i)
    for h in range(memory.search[world, i].hypotheses):
        used = wp.vec3i(-1, -1, -1)
        if h < solved:
            used = lines
        follow_hypothesis(frame, memory, world, i, h, used)
    if beginning:
        sort_hypotheses(memory, world, i)
        memory.search[world, i].hypotheses = wp.min(memory.search[world, i].hypotheses, constants.MAX_HYPOTHESES)
        return False
    memory.search[world, i].followed_time += now.period
    prune(memory, world, i)
    alone = memory.search[world, i].hypotheses == 1
    return alone and memory.search[world, i].followed_time >= memory.search[world, i].least_time
