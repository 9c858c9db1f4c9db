"""The hypotheses of a search: which has paid least, and which are given up. See observers/robust/search.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import distance_squared, left_error
from coopenv.observers.robust.reference.search import FLOOR, MARGIN, SAME
from coopenv.observers.robust.state import SPARE_PLACE

MOST_DEBT, CREDIT = wp.constant(MARGIN), wp.constant(FLOOR)
INDISTINCT = wp.constant(SAME)


@wp.func
def keep(mind: Any, world: int, i: int, h: int):
    """Put what is believed in the place of a hypothesis."""
    mind.bank_rotation[world, i, h] = mind.R[world, i, 0]
    mind.bank_position[world, i, h] = mind.p[world, i, 0]
    mind.bank_covariance[world, i, h] = mind.P[world, i, 0, 0]


@wp.func
def is_cheaper(mind: Any, world: int, i: int, h: int, g: int) -> bool:
    """Return whether a hypothesis has paid less than another one, or as much and is nearer to the prior."""
    if mind.paid[world, i, h] == mind.paid[world, i, g]:
        return mind.surprise[world, i, h] < mind.surprise[world, i, g]
    return mind.paid[world, i, h] < mind.paid[world, i, g]


@wp.func
def best_hypothesis(mind: Any, world: int, i: int) -> int:
    """Return the hypothesis that has paid least, -1 if there is none."""
    best = int(-1)
    for h in range(mind.hypotheses[world, i]):
        if best < 0 or is_cheaper(mind, world, i, h, best):
            best = h
    return best


@wp.func
def copy_hypothesis(mind: Any, world: int, i: int, h: int, to: int):
    """Put a hypothesis in the place of another one."""
    mind.bank_rotation[world, i, to] = mind.bank_rotation[world, i, h]
    mind.bank_position[world, i, to] = mind.bank_position[world, i, h]
    mind.bank_covariance[world, i, to] = mind.bank_covariance[world, i, h]
    mind.paid[world, i, to] = mind.paid[world, i, h]
    mind.surprise[world, i, to] = mind.surprise[world, i, h]
    mind.bearings[world, i, to] = mind.bearings[world, i, h]


@wp.func
def swap(mind: Any, world: int, i: int, h: int, g: int):
    """Exchange two hypotheses, by way of the place behind all."""
    copy_hypothesis(mind, world, i, h, SPARE_PLACE)
    copy_hypothesis(mind, world, i, g, h)
    copy_hypothesis(mind, world, i, SPARE_PLACE, g)


@wp.func
def are_same(mind: Any, world: int, i: int, h: int, g: int):
    """Return whether two hypotheses cannot be told apart."""
    R = mind.bank_rotation[world, i, h]
    P = mind.bank_covariance[world, i, h] + mind.bank_covariance[world, i, g]
    e = left_error(R, mind.bank_position[world, i, h], mind.bank_rotation[world, i, g], mind.bank_position[world, i, g])
    return distance_squared(e, P) < wp.float64(INDISTINCT)


@wp.func
def is_new(mind: Any, world: int, i: int, h: int, count: int) -> bool:
    """Return whether a hypothesis can be told apart from each of the first `count`."""
    for g in range(count):
        if are_same(mind, world, i, h, g):
            return False
    return True


@wp.func
def rank(mind: Any, world: int, i: int):
    """Put the cheapest first."""
    count = mind.hypotheses[world, i]
    for h in range(count):
        for g in range(h + 1, count):
            if is_cheaper(mind, world, i, g, h):
                swap(mind, world, i, h, g)


@wp.func
def prune(mind: Any, world: int, i: int):
    """Give up what pays much more than the best, what is the same as a better one, and all if none is good."""
    count = mind.hypotheses[world, i]
    rank(mind, world, i)
    least = mind.paid[world, i, 0]
    kept = int(0)
    for h in range(count):
        if mind.paid[world, i, h] <= least + wp.float64(MOST_DEBT) and is_new(mind, world, i, h, kept):
            copy_hypothesis(mind, world, i, h, kept)
            kept += 1
    if least > wp.float64(CREDIT) + wp.float64(4.0) * wp.float64(mind.bearings[world, i, 0]):
        kept = 0
    mind.hypotheses[world, i] = kept
