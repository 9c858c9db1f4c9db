"""The kernels that terms run in, made for the terms that a scenario names: a term that is not named costs nothing.

Each combination of terms has a Warp module of its own, which is compiled once per machine and precision.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import cache, reduce
from hashlib import sha256
from itertools import chain
from typing import Any

import warp as wp

from coopenv.api.step_results import assess, is_over, remember, set_flags
from coopenv.api.terms.chains import (
    Bound,
    Terms,
    no_condition,
    no_field,
    no_reward,
    with_condition,
    with_field,
    with_reward,
)
from coopenv.api.terms.records import fill_neighbour, fill_own, fill_target, records
from coopenv.world.collision import UNDER_WAY, goal_distance
from coopenv.world.precision import Precision


@cache
def results_kernel(terms: Terms, p: Precision) -> wp.Kernel:
    """Return the kernel that fills the step results of every vehicle of the chosen worlds."""
    Ego, Truth, Target, Neighbour = records(p)
    write_own = reduce(with_field, terms.vehicle_fields, no_field)
    write_of_target = reduce(with_field, terms.target_fields, no_field)
    write_of_neighbour = reduce(with_field, terms.neighbour_fields, no_field)
    add_rewards = reduce(with_reward, terms.rewards, no_reward)

    def step_results(
        model: Any,
        state: Any,
        start: Any,
        factor: Any,
        weight: Any,
        results: Any,
        fresh: wp.array(dtype=wp.int32),
        chosen: wp.array(dtype=wp.int32),
    ):
        """One thread per (world, vehicle).

        Vectors: `start` and `factor`, a field's first entry and 1 / scale; `weight` of the reward terms. `fresh` marks
        worlds that have just been reset: they forget the last episode and earn no reward.
        """
        world, vehicle = wp.tid()
        if chosen[world] == 0:
            return
        distance = goal_distance(model, state, world, vehicle)
        if fresh[world] != 0:
            remember(results, world, vehicle, distance, UNDER_WAY, 0)
        ended = state.ended[world, vehicle]
        set_flags(results, world, vehicle, ended, is_over(model, state, world), model.horizon_ticks)
        assess(model, state, results, world, vehicle)
        ego, truth = fill_own(Ego(), Truth(), model, state, results, world, vehicle, distance)
        remember(results, world, vehicle, distance, ended, state.tick[world])
        total = add_rewards(results.terms, weight, world, vehicle, ego, truth)
        earns = results.alive[world, vehicle] and fresh[world] == 0
        results.reward[world, vehicle] = wp.where(earns, total, 0.0)

        out = results.observation
        write_own(out, start, factor, world, vehicle, 0, ego, ego)
        for n in range(model.agents):
            target = fill_target(Target(), model, state, world, vehicle, n)
            write_of_target(out, start, factor, world, vehicle, n, ego, target)
        for n in range(model.vehicles - 1):
            sender = wp.where(n >= vehicle, n + 1, n)
            neighbour = fill_neighbour(Neighbour(), model, state, world, vehicle, sender)
            write_of_neighbour(out, start, factor, world, vehicle, n, ego, neighbour)

    return _kernel(step_results, p, [*chain(*terms[:4])])


@cache
def endings_kernel(conditions: tuple[Bound, ...], p: Precision) -> wp.Kernel:
    """Return the kernel that ends the episodes of vehicles which fulfil a condition of the scenario's own."""
    Ego, Truth, _, _ = records(p)
    outcome_of = reduce(with_condition, conditions, no_condition)

    def end_episodes(model: Any, state: Any, results: Any):
        """One thread per (world, vehicle). Conditions count after a decision, not right after a reset."""
        world, vehicle = wp.tid()
        tick = state.tick[world]
        decided = tick > 0 and (tick % model.ticks_per_decision == 0 or tick == model.horizon_ticks)
        if decided and state.ended[world, vehicle] == UNDER_WAY:
            assess(model, state, results, world, vehicle)
            distance = goal_distance(model, state, world, vehicle)
            ego, truth = fill_own(Ego(), Truth(), model, state, results, world, vehicle, distance)
            state.ended[world, vehicle] = outcome_of(ego, truth)

    return _kernel(end_episodes, p, conditions)


def _kernel(function: Callable[..., None], p: Precision, terms: Sequence[Bound]) -> wp.Kernel:
    """Return a kernel in a module that is named after its terms, the same in every process."""
    parts = [f"{t.index} {t.size} {t.function.key} {inspect.getsource(t.function.func)}" for t in terms]
    fingerprint = sha256("\n".join(parts).encode()).hexdigest()[:12]
    module = wp.get_module(f"{__name__}.{function.__name__}.{p.name}.{fingerprint}")
    module.options["enable_backward"] = False
    return wp.Kernel(func=function, key=function.__name__, module=module)
