"""Functions that compute all terms of a kind, built up term by term, each in a closure around the one before."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from coopenv.world.collision import UNDER_WAY


class Bound(NamedTuple):
    """A term as a kernel calls it."""

    index: int
    """Place among the terms of its kind."""
    function: wp.Function
    records: int
    """How many it takes: `Ego`, and the kind's second one."""
    size: int = 1
    """Entries of one value."""


class Terms(NamedTuple):
    """The terms of a scenario: fields of the observation, one value per vehicle, target or neighbour; and others."""

    vehicle_fields: tuple[Bound, ...]
    target_fields: tuple[Bound, ...]
    neighbour_fields: tuple[Bound, ...]
    rewards: tuple[Bound, ...]
    conditions: tuple[Bound, ...]


@wp.func
def put(out: wp.array3d(dtype=wp.float32), world: int, vehicle: int, index: int, value: Any, factor: wp.float32):
    """Write value x factor, clipped to [-1, 1]."""
    out[world, vehicle, index] = wp.clamp(wp.float32(value) * factor, -1.0, 1.0)


@cache
def vector_put(size: int) -> wp.Function:
    """Return what writes a field's vector of so many entries; one of another size does not compile."""

    def put_vector(
        out: wp.array3d(dtype=wp.float32),
        world: int,
        vehicle: int,
        index: int,
        value: wp.types.vector(length=size, dtype=wp.Float),
        factor: wp.float32,
    ):
        for axis in range(size):
            put(out, world, vehicle, index + axis, value[axis], factor)

    return wp.func(put_vector, name=f"put_{size}")


@wp.func
def no_field(out: Any, start: Any, factor: Any, world: int, vehicle: int, n: int, ego: Any, other: Any):
    """Write nothing."""


def with_field(rest: wp.Function, bound: Bound) -> wp.Function:
    """Return a function that writes what `rest` writes, and one more field."""
    function, index, size = bound.function, bound.index, bound.size
    put_value = put if size == 1 else vector_put(size)

    def of_ego(out: Any, start: Any, factor: Any, world: int, vehicle: int, n: int, ego: Any, other: Any):
        rest(out, start, factor, world, vehicle, n, ego, other)
        put_value(out, world, vehicle, start[index], function(ego), factor[index])

    def of_both(out: Any, start: Any, factor: Any, world: int, vehicle: int, n: int, ego: Any, other: Any):
        rest(out, start, factor, world, vehicle, n, ego, other)
        put_value(out, world, vehicle, start[index] + n * size, function(ego, other), factor[index])

    return wp.func(of_ego if bound.records == 1 else of_both, name=f"write_field_{index}")


@wp.func
def no_reward(terms: Any, weights: Any, world: int, vehicle: int, ego: Any, truth: Any):
    """Return the reward without any term."""
    return 0.0


def with_reward(rest: wp.Function, bound: Bound) -> wp.Function:
    """Return a function that writes one more reward term than `rest`, and returns their weighted sum."""
    function, index = bound.function, bound.index

    def of_ego(terms: Any, weights: Any, world: int, vehicle: int, ego: Any, truth: Any):
        total = rest(terms, weights, world, vehicle, ego, truth)
        value = wp.float32(function(ego))
        terms[world, vehicle, index] = value
        return total + weights[index] * value

    def of_both(terms: Any, weights: Any, world: int, vehicle: int, ego: Any, truth: Any):
        total = rest(terms, weights, world, vehicle, ego, truth)
        value = wp.float32(function(ego, truth))
        terms[world, vehicle, index] = value
        return total + weights[index] * value

    return wp.func(of_ego if bound.records == 1 else of_both, name=f"add_reward_{index}")


@wp.func
def no_condition(ego: Any, truth: Any):
    """Return the outcome without any condition."""
    return UNDER_WAY


def with_condition(rest: wp.Function, bound: Bound) -> wp.Function:
    """Return a function that gives the outcome of `rest`, or else of one more condition: its index."""
    function, outcome = bound.function, bound.index

    def of_ego(ego: Any, truth: Any):
        return choose(rest(ego, truth), function(ego), outcome)

    def of_both(ego: Any, truth: Any):
        return choose(rest(ego, truth), function(ego, truth), outcome)

    return wp.func(of_ego if bound.records == 1 else of_both, name=f"end_{outcome}")


@wp.func
def choose(outcome: int, fulfilled: Any, other: int) -> int:
    """Return an outcome if there is one already, else another if its condition is fulfilled."""
    if outcome == UNDER_WAY and fulfilled:
        return other
    return outcome
