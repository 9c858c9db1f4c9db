"""The hypotheses of a search: which costs least, and which are given up.

A hypothesis costs its normalised innovations squared, each limited, so that the difference of two costs is twice the
logarithm of their likelihoods' ratio.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import distance_squared
from coopenv.observers.robust.constants import MAX_BEST_COST, PRUNE_GAP, SAME_HYPOTHESIS


@wp.func
def costs_less(memory: Any, world: int, i: int, h: int, g: int) -> bool:
    """Return whether a hypothesis costs less than another one, or as much and is nearer to the prior."""
    a = memory.hypothesis[world, i, h].cost
    b = memory.hypothesis[world, i, g].cost
    if a == b:
        return memory.hypothesis[world, i, h].prior_distance < memory.hypothesis[world, i, g].prior_distance
    return a < b


@wp.func
def best_hypothesis(memory: Any, world: int, i: int) -> int:
    """Return the hypothesis that costs least, -1 if there is none."""
    best = int(-1)
    for h in range(memory.search[world, i].hypotheses):
        if best < 0 or costs_less(memory, world, i, h, best):
            best = h
    return best


@wp.func
def is_new(memory: Any, world: int, i: int, h: int, count: int) -> bool:
    """Return whether a hypothesis can be told apart from each of the first `count`."""
    for g in range(count):
        distance = distance_squared(memory.hypothesis[world, i, h].estimate, memory.hypothesis[world, i, g].estimate)
        if distance < wp.float64(SAME_HYPOTHESIS):
            return False
    return True


@wp.func
def sort_hypotheses(memory: Any, world: int, i: int):
    """Put those that cost least first."""
    count = memory.search[world, i].hypotheses
    for h in range(count):
        for g in range(h + 1, count):
            if costs_less(memory, world, i, g, h):
                other = memory.hypothesis[world, i, h]
                memory.hypothesis[world, i, h] = memory.hypothesis[world, i, g]
                memory.hypothesis[world, i, g] = other


@wp.func
def prune(memory: Any, world: int, i: int):
    """Give up what costs much more than the best, what is the same as a better one, and all if the best is not good."""
    sort_hypotheses(memory, world, i)
    least = memory.hypothesis[world, i, 0].cost
    expected = wp.float64(2.0) * wp.float64(memory.hypothesis[world, i, 0].bearings)
    kept = int(0)
    for h in range(memory.search[world, i].hypotheses):
        near = memory.hypothesis[world, i, h].cost <= least + wp.float64(PRUNE_GAP)
        if near and is_new(memory, world, i, h, kept):
            memory.hypothesis[world, i, kept] = memory.hypothesis[world, i, h]
            kept += 1
    if least > wp.float64(MAX_BEST_COST) + wp.float64(2.0) * expected:
        kept = 0
    memory.search[world, i].hypotheses = kept
