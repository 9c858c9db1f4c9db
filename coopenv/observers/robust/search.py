"""Finding one's pose from nothing. See observers/robust/search.py.

While a vehicle searches it believes nothing, so that a hypothesis takes the belief's place to be corrected.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import orthonormalise
from coopenv.observers.robust.algebra import distance_squared, is_known, left_error, transition, with_noise
from coopenv.observers.robust.belief import begin
from coopenv.observers.robust.hypotheses import keep, prune, rank
from coopenv.observers.robust.measurements import NOTHING, draw, fitting_lines, normalised, settle
from coopenv.observers.robust.reference.search import (
    CLEAR_TIME,
    GATE,
    LEAST_TIME,
    MISS,
    MOST_SURPRISE,
    PATIENCE,
    SAME_PRIOR,
)
from coopenv.observers.robust.sightings import aim_at_sightings, next_triple
from coopenv.observers.robust.solutions import explain
from coopenv.observers.robust.state import MOST_SUPPOSED

FITTING = wp.constant(GATE)
MOST_PRICE = wp.constant(MISS)
MOST_PRIOR_PRICE = wp.constant(MOST_SURPRISE)
LEAST_AGE, LEAST_CLEAR, MOST_PATIENCE = wp.constant(LEAST_TIME), wp.constant(CLEAR_TIME), wp.constant(PATIENCE)
CONFIRMING = wp.constant(SAME_PRIOR)


@wp.func
def begin_search(mind: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Start without hypotheses."""
    mind.searching[world, i] = 1
    mind.prior_rotation[world, i] = R
    mind.prior_position[world, i] = p
    mind.prior_covariance[world, i] = P
    mind.hypotheses[world, i] = 0
    mind.age[world, i] = wp.float64(0.0)
    mind.waited[world, i] = wp.float64(0.0)
    mind.clear[world, i] = wp.float64(0.0)
    mind.attempts[world, i] = 0


@wp.func
def move_search(mind: Any, world: int, i: int, dR: Any, dp: Any, rotation: Any, translation: Any):
    """Carry the prior and all hypotheses through a tick's odometry."""
    F = transition(dR, dp)
    Ft = wp.transpose(F)
    R = mind.prior_rotation[world, i]
    mind.prior_position[world, i] = mind.prior_position[world, i] + R * dp
    mind.prior_rotation[world, i] = orthonormalise(R * dR)
    mind.prior_covariance[world, i] = with_noise(F * mind.prior_covariance[world, i] * Ft, rotation, translation)
    for h in range(mind.hypotheses[world, i]):
        R = mind.bank_rotation[world, i, h]
        mind.bank_position[world, i, h] = mind.bank_position[world, i, h] + R * dp
        mind.bank_rotation[world, i, h] = orthonormalise(R * dR)
        mind.bank_covariance[world, i, h] = with_noise(
            F * mind.bank_covariance[world, i, h] * Ft, rotation, translation
        )


@wp.func
def follow(model: Any, mind: Any, world: int, i: int, h: int, used: Any):
    """Let a hypothesis pay for the frame's sightings but three, and learn from those that fit."""
    begin(
        mind,
        world,
        i,
        mind.bank_rotation[world, i, h],
        mind.bank_position[world, i, h],
        mind.bank_covariance[world, i, h],
    )
    for n in range(model.target_count[i]):
        fitting = int(0)
        if mind.line_place[world, n] != NOTHING and n != used[0] and n != used[1] and n != used[2]:
            price = wp.float64(MOST_PRICE)
            if draw(model, mind, world, i, n):
                nis = normalised(mind, world, i, n)
                price = wp.min(nis, price)
                if nis < wp.float64(FITTING):
                    fitting = 1
            mind.paid[world, i, h] = mind.paid[world, i, h] + price
            mind.bearings[world, i, h] = mind.bearings[world, i, h] + 1
        mind.line_fits[world, n] = fitting
    if fitting_lines(mind, world, model.target_count[i]) > 0:
        settle(model, mind, world, i)
        keep(mind, world, i, h)


@wp.func
def surprise_at(mind: Any, world: int, i: int, h: int):
    """Return the squared distance of a hypothesis from the prior, in standard deviations."""
    R = mind.prior_rotation[world, i]
    p = mind.prior_position[world, i]
    e = left_error(R, p, mind.bank_rotation[world, i, h], mind.bank_position[world, i, h])
    return distance_squared(e, mind.prior_covariance[world, i] + mind.bank_covariance[world, i, h])


@wp.func
def confirms_prior(mind: Any, world: int, i: int) -> bool:
    """Return whether the first hypothesis is the prior, the prior being certain enough to go on with."""
    return is_known(mind.prior_covariance[world, i]) and surprise_at(mind, world, i, 0) < wp.float64(CONFIRMING)


@wp.func
def price(mind: Any, world: int, i: int, h: int):
    """Let a new hypothesis pay for being far from the prior."""
    surprise = surprise_at(mind, world, i, h)
    mind.paid[world, i, h] = wp.min(surprise, wp.float64(MOST_PRIOR_PRICE))
    mind.surprise[world, i, h] = surprise
    mind.bearings[world, i, h] = 0


@wp.func
def suppose_prior(model: Any, mind: Any, world: int, i: int):
    """Take the prior into the bank if it is known well enough to be followed."""
    P = mind.prior_covariance[world, i]
    if not is_known(P):
        return
    h = mind.hypotheses[world, i]
    begin(mind, world, i, mind.prior_rotation[world, i], mind.prior_position[world, i], P)
    keep(mind, world, i, h)
    mind.hypotheses[world, i] = h + 1
    mind.paid[world, i, h] = wp.float64(0.0)
    mind.surprise[world, i, h] = wp.float64(0.0)
    mind.bearings[world, i, h] = 0
    follow(model, mind, world, i, h, wp.vec3i(-1, -1, -1))


@wp.func
def chosen_triple(model: Any, mind: Any, world: int, i: int, seen: int):
    """Return three well placed sightings, other ones at every attempt."""
    triples = seen * (seen - 1) * (seen - 2) / 6
    n0 = int(0)
    n1 = int(0)
    n2 = int(0)
    size = wp.float64(wp.inf)
    number = int(-1)
    for _ in range(mind.attempts[world, i] % triples + 1):
        n0, n1, n2, size, number = next_triple(mind, world, model.target_count[i], size, number)
    return wp.vec3i(n0, n1, n2)


@wp.func
def solve_frame(model: Any, mind: Any, world: int, i: int, seen: int, period: Any):
    """Follow a known prior at first; then a frame's solutions, too, if for a while all were well determined."""
    if mind.attempts[world, i] == 0 and is_known(mind.prior_covariance[world, i]):
        suppose_prior(model, mind, world, i)
        mind.attempts[world, i] = 1
        mind.age[world, i] = wp.float64(0.0)
        return
    lines = chosen_triple(model, mind, world, i, seen)
    waited = mind.waited[world, i] + period
    clear = mind.clear[world, i] + period
    patient = waited < wp.float64(MOST_PATIENCE)
    following = not patient or clear >= wp.float64(LEAST_CLEAR)
    if not explain(model, mind, world, i, lines, patient, following):
        clear = wp.float64(0.0)
        following = False
    if following:
        for h in range(mind.hypotheses[world, i]):
            price(mind, world, i, h)
            follow(model, mind, world, i, h, lines)
        suppose_prior(model, mind, world, i)
        rank(mind, world, i)
        mind.hypotheses[world, i] = wp.min(mind.hypotheses[world, i], MOST_SUPPOSED)
        mind.attempts[world, i] = mind.attempts[world, i] + 1
        mind.age[world, i] = wp.float64(0.0)
        clear = wp.float64(0.0)
    mind.waited[world, i] = waited
    mind.clear[world, i] = clear


@wp.func
def look_around(model: Any, state: Any, mind: Any, world: int, i: int, now: Any) -> bool:
    """Take a frame's sightings; return whether one hypothesis alone is left after some frames."""
    seen = aim_at_sightings(model, state, mind, world, i, now.tick)
    if mind.hypotheses[world, i] == 0:
        if seen >= 3:
            solve_frame(model, mind, world, i, seen, now.period)
        return False
    mind.age[world, i] = mind.age[world, i] + now.period
    for h in range(mind.hypotheses[world, i]):
        follow(model, mind, world, i, h, wp.vec3i(-1, -1, -1))
    prune(mind, world, i)
    return mind.hypotheses[world, i] == 1 and mind.age[world, i] >= wp.float64(LEAST_AGE)
