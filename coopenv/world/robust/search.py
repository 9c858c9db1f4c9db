"""Finding one's pose from nothing. See observers/robust/search.py.

While a vehicle searches it believes nothing, so that a hypothesis takes the belief's place to be corrected.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.observers.robust.search import (
    GATE,
    LEAST_TIME,
    MISS,
    MOST_SURPRISE,
    SAME_PRIOR,
)
from coopenv.estimation.so3 import orthonormalise
from coopenv.world.robust.algebra import (
    distance_squared,
    inverse6,
    is_known,
    is_regular,
    left_error,
    transition,
    with_noise,
)
from coopenv.world.robust.bank import keep, prune
from coopenv.world.robust.belief import begin
from coopenv.world.robust.lines import NOTHING, any_fits, draw, normalised, settle
from coopenv.world.robust.perspective import axes_of, distances_of, is_sound, polished, solves
from coopenv.world.robust.sightings import aim_at_sightings, next_triple
from coopenv.world.robust.state import MOST_SOLUTIONS
from coopenv.world.robust.types import mat66d, vec3d, wide_vector

FITTING = wp.constant(GATE)
MOST_PRICE = wp.constant(MISS)
MOST_PRIOR_PRICE = wp.constant(MOST_SURPRISE)
LEAST_AGE = wp.constant(LEAST_TIME)
CONFIRMING = wp.constant(SAME_PRIOR)
LEAST_INFORMATION = wp.constant(1e-12)
"""Of the weakest direction relative to the strongest."""


@wp.func
def begin_search(mind: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Start without hypotheses."""
    mind.searching[world, i] = 1
    mind.prior_rotation[world, i] = R
    mind.prior_position[world, i] = p
    mind.prior_covariance[world, i] = P
    mind.hypotheses[world, i] = 0
    mind.age[world, i] = wp.float64(0.0)
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
def follow(model: Any, mind: Any, world: int, i: int, h: int, n0: int, n1: int, n2: int):
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
        if mind.line_place[world, n] != NOTHING and n != n0 and n != n1 and n != n2:
            price = wp.float64(MOST_PRICE)
            if draw(model, mind, world, i, n):
                nis = normalised(mind, world, i, n)
                price = wp.min(nis, price)
                if nis < wp.float64(FITTING):
                    fitting = 1
            mind.paid[world, i, h] = mind.paid[world, i, h] + price
            mind.bearings[world, i, h] = mind.bearings[world, i, h] + 1
        mind.line_fits[world, n] = fitting
    if any_fits(mind, world, model.target_count[i]):
        settle(model, mind, world, i)
        keep(mind, world, i, h)


@wp.func
def suppose_prior(model: Any, mind: Any, world: int, i: int):
    """Take the prior into the empty bank if it is known well enough to be followed."""
    P = mind.prior_covariance[world, i]
    if not is_known(P):
        return
    begin(mind, world, i, mind.prior_rotation[world, i], mind.prior_position[world, i], P)
    keep(mind, world, i, 0)
    mind.hypotheses[world, i] = 1
    mind.paid[world, i, 0] = wp.float64(0.0)
    mind.surprise[world, i, 0] = wp.float64(0.0)
    mind.bearings[world, i, 0] = 0
    follow(model, mind, world, i, 0, -1, -1, -1)


@wp.func
def information_of(model: Any, mind: Any, world: int, i: int, n: int):
    """Return what a sighting says of the pose believed, H^T H over its variance."""
    draw(model, mind, world, i, n)
    H = mind.line_own[world, n]
    return (wp.transpose(H) * H) / mind.line_noise[world, n]


@wp.func
def surprise_of(mind: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Return the squared distance of a pose from the prior, in standard deviations."""
    e = left_error(mind.prior_rotation[world, i], mind.prior_position[world, i], R, p)
    return distance_squared(e, mind.prior_covariance[world, i] + P)


@wp.func
def confirms_prior(mind: Any, world: int, i: int) -> bool:
    """Return whether the first hypothesis is the prior, the prior being certain enough to go on with."""
    if not is_known(mind.prior_covariance[world, i]):
        return False
    surprise = surprise_of(
        mind,
        world,
        i,
        mind.bank_rotation[world, i, 0],
        mind.bank_position[world, i, 0],
        mind.bank_covariance[world, i, 0],
    )
    return surprise < wp.float64(CONFIRMING)


@wp.func
def suppose(model: Any, mind: Any, world: int, i: int, n0: int, n1: int, n2: int, R: Any, p: Any):
    """Take a solution for three sightings into the bank, unless they do not tell it."""
    begin(mind, world, i, R, p, mat66d())
    M = information_of(model, mind, world, i, n0)
    M += information_of(model, mind, world, i, n1)
    M += information_of(model, mind, world, i, n2)
    if not is_regular(M, wp.float64(LEAST_INFORMATION)):
        return
    P = with_noise(inverse6(M), wp.float64(0.0), wp.float64(0.0))
    if not wp.max(wp.max(P[0, 0], P[1, 1]), P[2, 2]) < wp.float64(1.0):
        return
    mind.P[world, i, 0, 0] = P
    h = mind.hypotheses[world, i]
    keep(mind, world, i, h)
    surprise = surprise_of(mind, world, i, R, p, P)
    mind.hypotheses[world, i] = h + 1
    mind.paid[world, i, h] = wp.min(surprise, wp.float64(MOST_PRIOR_PRICE))
    mind.surprise[world, i, h] = surprise
    mind.bearings[world, i, h] = 0
    follow(model, mind, world, i, h, n0, n1, n2)


@wp.func
def solve_triple(model: Any, mind: Any, world: int, i: int, n0: int, n1: int, n2: int):
    """Add to the bank the poses that explain three sightings."""
    b0 = mind.line_bearing[world, n0]
    b1 = mind.line_bearing[world, n1]
    b2 = mind.line_bearing[world, n2]
    z0 = mind.line_point[world, n0]
    z1 = mind.line_point[world, n1]
    z2 = mind.line_point[world, n2]
    a = vec3d(wp.length_sq(z0 - z1), wp.length_sq(z0 - z2), wp.length_sq(z1 - z2))
    longest = wp.max(wp.max(a[0], a[1]), a[2])
    if not is_sound(b0, b1, b2, z0, z1, z2, longest):
        return
    a = a / longest
    gaps = vec3d(wp.length_sq(b0 - b1), wp.length_sq(b0 - b2), wp.length_sq(b1 - b2))
    solutions = distances_of(a, gaps)
    axes = axes_of(z0, z1, z2)
    third = wp.float64(1.0) / wp.float64(3.0)
    for n in range(MOST_SOLUTIONS):
        d = polished(solutions[n], gaps, a)
        if solves(d, gaps, a):
            d = d * wp.sqrt(longest)
            p0 = d[0] * b0
            p1 = d[1] * b1
            p2 = d[2] * b2
            R = axes * wp.transpose(axes_of(p0, p1, p2))
            camera = (z0 + z1 + z2) * third - R * ((p0 + p1 + p2) * third)
            if wp.isfinite(wp.ddot(R, R) + wp.dot(camera, camera)):
                p = camera - R * wide_vector(model.camera.position)
                suppose(model, mind, world, i, n0, n1, n2, R, p)


@wp.func
def solve_frame(model: Any, mind: Any, world: int, i: int, seen: int):
    """Fill the bank with the poses that explain three well placed sightings, other ones at every attempt."""
    triples = seen * (seen - 1) * (seen - 2) / 6
    n0 = int(0)
    n1 = int(0)
    n2 = int(0)
    size = wp.float64(wp.inf)
    number = int(-1)
    for _ in range(mind.attempts[world, i] % triples + 1):
        n0, n1, n2, size, number = next_triple(mind, world, model.target_count[i], size, number)
    suppose_prior(model, mind, world, i)
    solve_triple(model, mind, world, i, n0, n1, n2)
    mind.attempts[world, i] = mind.attempts[world, i] + 1


@wp.func
def look_around(model: Any, state: Any, mind: Any, world: int, i: int, tick: int) -> bool:
    """Take a frame's sightings; return whether one hypothesis alone is left after some frames."""
    seen = aim_at_sightings(model, state, mind, world, i, tick)
    if mind.hypotheses[world, i] == 0:
        mind.age[world, i] = wp.float64(0.0)
        if seen >= 3:
            solve_frame(model, mind, world, i, seen)
        return False
    mind.age[world, i] = mind.age[world, i] + model.camera_period
    for h in range(mind.hypotheses[world, i]):
        follow(model, mind, world, i, h, -1, -1, -1)
    prune(mind, world, i)
    return mind.hypotheses[world, i] == 1 and mind.age[world, i] >= wp.float64(LEAST_AGE)
