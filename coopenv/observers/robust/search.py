"""Finding one's pose from nothing: solutions of the P3P problem are followed until motion has told them apart.

Each hypothesis is a small filter of its own; one that predicts the bearings much worse than the best is given up. While
a vehicle searches it believes nothing, so that the belief's arrays serve to correct one hypothesis after the other.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import orthonormalise
from coopenv.observers.robust.algebra import distance_squared, is_known, left_error, transition, with_noise
from coopenv.observers.robust.belief import begin_belief
from coopenv.observers.robust.constants import (
    BEARING_GATE,
    CLEAR_TIME,
    MAX_BEARING_COST,
    MAX_HYPOTHESES,
    MAX_PRIOR_COST,
    MIN_SEARCH_TIME,
    PATIENCE,
    SAME_PRIOR,
)
from coopenv.observers.robust.hypotheses import prune, sort_hypotheses, store_hypothesis
from coopenv.observers.robust.measurements import (
    NOTHING,
    fitting_lines,
    iterated_update,
    linearise,
    normalised_innovation,
)
from coopenv.observers.robust.memory import Estimate, Search
from coopenv.observers.robust.sightings import next_triple, set_lines_to_known
from coopenv.observers.robust.solutions import solve_triple


@wp.func
def begin_search(memory: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Start from a prior, without hypotheses."""
    search = Search()
    search.active = 1
    search.prior = Estimate(R, p, P)
    memory.search[world, i] = search


@wp.func
def propagate_search(memory: Any, world: int, i: int, dR: Any, dp: Any, rotation: Any, translation: Any):
    """Carry the prior and all hypotheses through a tick's odometry."""
    F = transition(dR, dp)
    Ft = wp.transpose(F)
    R = memory.search[world, i].prior.R
    memory.search[world, i].prior.p = memory.search[world, i].prior.p + R * dp
    memory.search[world, i].prior.R = orthonormalise(R * dR)
    memory.search[world, i].prior.P = with_noise(F * memory.search[world, i].prior.P * Ft, rotation, translation)
    for h in range(memory.search[world, i].hypotheses):
        R = memory.hypothesis[world, i, h].R
        P = memory.hypothesis[world, i, h].P
        memory.hypothesis[world, i, h].p = memory.hypothesis[world, i, h].p + R * dp
        memory.hypothesis[world, i, h].R = orthonormalise(R * dR)
        memory.hypothesis[world, i, h].P = with_noise(F * P * Ft, rotation, translation)


@wp.func
def follow_hypothesis(model: Any, memory: Any, world: int, i: int, h: int, used: Any):
    """Add the frame's bearings, but those used already, to the cost of a hypothesis; correct it by those that fit."""
    R = memory.hypothesis[world, i, h].R
    begin_belief(memory, world, i, R, memory.hypothesis[world, i, h].p, memory.hypothesis[world, i, h].P)
    for n in range(model.target_count[i]):
        fitting = int(0)
        if memory.line[world, n].member != NOTHING and n != used[0] and n != used[1] and n != used[2]:
            cost = wp.float64(MAX_BEARING_COST)
            if linearise(model, memory, world, i, n):
                nis = normalised_innovation(memory, world, i, n)
                cost = wp.min(nis, cost)
                if nis < wp.float64(BEARING_GATE):
                    fitting = 1
            memory.hypothesis[world, i, h].cost = memory.hypothesis[world, i, h].cost + cost
            memory.hypothesis[world, i, h].bearings = memory.hypothesis[world, i, h].bearings + 1
        memory.line[world, n].fits = fitting
    if fitting_lines(memory, world, model.target_count[i]) > 0:
        iterated_update(model, memory, world, i)
        store_hypothesis(memory, world, i, h)


@wp.func
def distance_from_prior(memory: Any, world: int, i: int, h: int):
    """Return the squared distance of a hypothesis from the prior, in standard deviations."""
    R = memory.search[world, i].prior.R
    p = memory.search[world, i].prior.p
    e = left_error(R, p, memory.hypothesis[world, i, h].R, memory.hypothesis[world, i, h].p)
    return distance_squared(e, memory.search[world, i].prior.P + memory.hypothesis[world, i, h].P)


@wp.func
def confirms_prior(memory: Any, world: int, i: int) -> bool:
    """Return whether the first hypothesis is the prior, and the prior is certain enough to go on with."""
    known = is_known(memory.search[world, i].prior.P)
    return known and distance_from_prior(memory, world, i, 0) < wp.float64(SAME_PRIOR)


@wp.func
def set_prior_cost(memory: Any, world: int, i: int, h: int):
    """Begin the cost of a new hypothesis with its distance from the prior."""
    distance = distance_from_prior(memory, world, i, h)
    memory.hypothesis[world, i, h].cost = wp.min(distance, wp.float64(MAX_PRIOR_COST))
    memory.hypothesis[world, i, h].prior_distance = distance
    memory.hypothesis[world, i, h].bearings = 0


@wp.func
def add_prior(model: Any, memory: Any, world: int, i: int):
    """Add the prior as a hypothesis if it is known well enough to be followed."""
    P = memory.search[world, i].prior.P
    if not is_known(P):
        return
    h = memory.search[world, i].hypotheses
    begin_belief(memory, world, i, memory.search[world, i].prior.R, memory.search[world, i].prior.p, P)
    store_hypothesis(memory, world, i, h)
    memory.search[world, i].hypotheses = h + 1
    memory.hypothesis[world, i, h].cost = wp.float64(0.0)
    memory.hypothesis[world, i, h].prior_distance = wp.float64(0.0)
    memory.hypothesis[world, i, h].bearings = 0
    follow_hypothesis(model, memory, world, i, h, wp.vec3i(-1, -1, -1))


@wp.func
def chosen_triple(model: Any, memory: Any, world: int, i: int, seen: int):
    """Return three well placed bearings, others at every attempt."""
    triples = seen * (seen - 1) * (seen - 2) // 6
    n0 = int(0)
    n1 = int(0)
    n2 = int(0)
    size = wp.float64(wp.inf)
    number = int(-1)
    for _ in range(memory.search[world, i].attempts % triples + 1):
        n0, n1, n2, size, number = next_triple(memory, world, model.target_count[i], size, number)
    return wp.vec3i(n0, n1, n2)


@wp.func
def solve_frame(model: Any, memory: Any, world: int, i: int, seen: int, period: Any):
    """Follow a known prior at first; then a frame's solutions, too, if for a while all were well determined.

    Every attempt takes other bearings. Where two solutions nearly meet, the region where they may be is no ellipsoid,
    and noise makes them come and go; meanwhile a follower's leaders improve, which sets them apart.
    """
    if memory.search[world, i].attempts == 0 and is_known(memory.search[world, i].prior.P):
        add_prior(model, memory, world, i)
        memory.search[world, i].attempts = 1
        memory.search[world, i].followed_time = wp.float64(0.0)
        return
    lines = chosen_triple(model, memory, world, i, seen)
    waited = memory.search[world, i].waited_time + period
    clear = memory.search[world, i].clear_time + period
    patient = waited < wp.float64(PATIENCE)
    following = not patient or clear >= wp.float64(CLEAR_TIME)
    if not solve_triple(model, memory, world, i, lines, patient, following):
        clear = wp.float64(0.0)
        following = False
    if following:
        for h in range(memory.search[world, i].hypotheses):
            set_prior_cost(memory, world, i, h)
            follow_hypothesis(model, memory, world, i, h, lines)
        add_prior(model, memory, world, i)
        sort_hypotheses(memory, world, i)
        memory.search[world, i].hypotheses = wp.min(memory.search[world, i].hypotheses, MAX_HYPOTHESES)
        memory.search[world, i].attempts = memory.search[world, i].attempts + 1
        memory.search[world, i].followed_time = wp.float64(0.0)
        clear = wp.float64(0.0)
    memory.search[world, i].waited_time = waited
    memory.search[world, i].clear_time = clear


@wp.func
def advance_search(model: Any, state: Any, memory: Any, world: int, i: int, now: Any) -> bool:
    """Take a frame's bearings; return whether one hypothesis alone is left after some frames."""
    seen = set_lines_to_known(model, state, memory, world, i, now.tick)
    if memory.search[world, i].hypotheses == 0:
        if seen >= 3:
            solve_frame(model, memory, world, i, seen, now.period)
        return False
    memory.search[world, i].followed_time = memory.search[world, i].followed_time + now.period
    for h in range(memory.search[world, i].hypotheses):
        follow_hypothesis(model, memory, world, i, h, wp.vec3i(-1, -1, -1))
    prune(memory, world, i)
    alone = memory.search[world, i].hypotheses == 1
    return alone and memory.search[world, i].followed_time >= wp.float64(MIN_SEARCH_TIME)
