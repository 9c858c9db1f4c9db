"""The kernels that terms run in, made for the terms that a scenario names: a term that is not named costs nothing.

Each combination of terms has a Warp module of its own, which is compiled once per machine and precision. Loops over
terms are written out (`unrolled.py`).
"""

import inspect
from collections.abc import Callable, Sequence
from functools import cache
from hashlib import sha256
from itertools import chain
from typing import Any

import warp as wp

from coopenv.api.step_results import assess, is_over, remember, set_flags
from coopenv.api.terms.binding import Bound, Terms
from coopenv.api.terms.map_view import MapLandmark, Nearest, map_record, next_nearest
from coopenv.api.terms.records import Ego, Neighbour, Target, Truth, neighbour_record, own_records, target_record
from coopenv.api.terms.unrolled import unrolled
from coopenv.api.terms.way import furthest_so_far, way_made
from coopenv.base.errors import CoopenvError
from coopenv.world import kernel_cache
from coopenv.world.collision import UNDER_WAY
from coopenv.world.launch import near_inlining
from coopenv.world.precision import Precision
from coopenv.world.route import remaining_way


@cache
def put(size: int, entries: tuple[int, ...], own: bool) -> wp.Function:
    """Return what writes entries of a value of `size`, (entry - center) factor, clipped to [-1, 1].

    NaN of own fields stays.
    """
    many, count = size > 1, len(entries)
    chosen = wp.types.vector(count, wp.int32)(*entries)

    def put_value(out: Any, world: int, vehicle: int, first: int, value: Any, center: wp.float32, factor: wp.float32):
        for place in range(wp.static(count)):
            entry = wp.float32(value[chosen[place]] if many else value)
            entry = (entry - center) * factor
            clipped = wp.clamp(entry, -1.0, 1.0)
            out[world, vehicle, first + place] = wp.where(wp.isnan(entry), entry, clipped) if own else clipped

    return wp.func(put_value)


@cache
def writer(field: Bound) -> wp.Function:
    """Return what writes a field's value into its place."""
    function, number, size, both = field.function, field.number, len(field.entries), field.records == 2
    put_value = put(field.size, field.entries, field.own)

    def write(out: Any, start: Any, center: Any, factor: Any, world: int, vehicle: int, n: int, ego: Ego, other: Any):
        value = function(ego, other) if both else function(ego)
        put_value(out, world, vehicle, start[number] + n * size, value, center[number], factor[number])

    return wp.func(write)


@cache
def value_of(term: Bound, kind: Any) -> wp.Function:
    """Return the function of a reward term (`kind`: float32) or a condition (bool) as one of two records."""
    function, both = term.function, term.records == 2

    def value(ego: Ego, truth: Truth):
        return kind(function(ego, truth) if both else function(ego))

    return wp.func(value)


@cache
def results_kernel(terms: Terms, p: Precision) -> wp.Kernel:
    """Return the kernel that fills the step results of every vehicle of the chosen worlds."""
    own, of_target, of_neighbour, of_landmark = ([writer(field) for field in fields] for fields in terms[:4])
    rewards = [value_of(term, wp.float32) for term in terms.rewards]

    def step_results(
        model: Any,
        state: Any,
        start: Any,
        center: Any,
        factor: Any,
        weight: Any,
        results: Any,
        fresh: wp.array(dtype=wp.int32),
        chosen: wp.array(dtype=wp.int32),
    ):
        """One thread per (world, vehicle).

        Vectors: `start`, `center` and `factor`, a field's first entry, what reads 0, and 1 / scale; `weight` of the
        reward terms. `fresh` marks worlds that have just been reset: they forget the last episode and earn no reward.
        """
        world, vehicle = wp.tid()
        if chosen[world] == 0:
            return
        way = remaining_way(model, state, world, vehicle)
        assess(model, state, results, world, vehicle)
        if fresh[world] != 0:
            made, _ = way_made(model, state, world, vehicle)
            remember(state, results, world, vehicle, way, made, 0)
        ended = state.ended[world, vehicle]
        set_flags(results, world, vehicle, ended, is_over(model, state, world), model.horizon_ticks)
        ego, truth = own_records(model, state, results, world, vehicle, way)
        furthest = furthest_so_far(state, results, world, vehicle) + type(way)(ego.metres_gained)
        remember(state, results, world, vehicle, way, furthest, state.tick[world])
        total = float(0.0)
        for k in range(wp.static(len(rewards))):
            value = wp.static(rewards[k])(ego, truth)
            results.terms[world, vehicle, k] = value
            total += weight[k] * value
        earns = results.alive[world, vehicle] and fresh[world] == 0
        results.reward[world, vehicle] = wp.where(earns, total, 0.0)

        out = results.observation
        for k in range(wp.static(len(own))):
            wp.static(own[k])(out, start, center, factor, world, vehicle, 0, ego, ego)
        for n in range(wp.static(int(len(of_target) > 0)) * model.agents):
            target = target_record(model, state, world, vehicle, n)
            for k in range(wp.static(len(of_target))):
                wp.static(of_target[k])(out, start, center, factor, world, vehicle, n, ego, target)
        for n in range(wp.static(int(len(of_neighbour) > 0)) * (model.vehicles - 1)):
            sender = wp.where(n >= vehicle, n + 1, n)
            neighbour = neighbour_record(model, state, world, vehicle, sender)
            for k in range(wp.static(len(of_neighbour))):
                wp.static(of_neighbour[k])(out, start, center, factor, world, vehicle, n, ego, neighbour)
        nearest = Nearest(-1, -1.0)
        for n in range(wp.static(int(len(of_landmark) > 0)) * model.map_size):
            nearest = next_nearest(model, state, world, vehicle, nearest)
            landmark = map_record(model, state, world, vehicle, nearest)
            for k in range(wp.static(len(of_landmark))):
                wp.static(of_landmark[k])(out, start, center, factor, world, vehicle, n, ego, landmark)

    loops = {"own": own, "of_target": of_target, "of_neighbour": of_neighbour, "of_landmark": of_landmark}
    source = unrolled(step_results, rewards=rewards, **loops)
    return _kernel(step_results, p.name, [*chain(*terms[:5])], source)


@cache
def endings_kernel(conditions: tuple[Bound, ...], p: Precision) -> wp.Kernel:
    """Return the kernel that ends the episodes of vehicles which fulfil a condition of the scenario's own."""
    fulfilled = [value_of(condition, wp.bool) for condition in conditions]

    def end_episodes(model: Any, state: Any, results: Any):
        """One thread per (world, vehicle). Conditions count after a decision, not right after a reset."""
        world, vehicle = wp.tid()
        tick = state.tick[world]
        decided = tick > 0 and (tick % model.ticks_per_decision == 0 or tick == model.horizon_ticks)
        if decided and state.ended[world, vehicle] == UNDER_WAY:
            assess(model, state, results, world, vehicle)
            way = remaining_way(model, state, world, vehicle)
            ego, truth = own_records(model, state, results, world, vehicle, way)
            for k in range(wp.static(len(fulfilled))):
                if state.ended[world, vehicle] == UNDER_WAY and wp.static(fulfilled[k])(ego, truth):
                    state.ended[world, vehicle] = wp.static(conditions[k].number)

    return _kernel(end_episodes, p.name, conditions, unrolled(end_episodes, fulfilled=fulfilled))


def check_own_terms(terms: Terms, device: str) -> None:
    """Compile every term that is not coopenv's by itself, so that what is wrong with it can be said.

    Raises:
        CoopenvError: Warp cannot compile its function, or it returns something else than its row says.
    """
    for of_kind, record in zip(terms, (Ego, Target, Neighbour, MapLandmark, Truth, Truth), strict=True):
        for term in of_kind:
            if term.own and of_kind is terms.conditions:
                _check(term, record, wp.bool, "true or false", device)
            elif term.own and term.size == 1:
                _check(term, record, wp.float32, "a number", device)
            elif term.own:
                _check(term, record, wp.types.vector(term.size, wp.float32), f"a vector of {term.size}", device)


def _check(term: Bound, record: Any, returned: Any, expected: str, device: str) -> None:
    function, both, many = term.function, term.records == 2, term.size > 1

    def call(out: wp.array(dtype=returned)):
        """Use the function's value as the kernels do."""
        value = function(Ego(), record()) if both else function(Ego())
        out[0] = returned(value)
        out[1] = returned(value[0] if many else value)

    try:
        out = wp.empty(2, dtype=returned, device=device)
        kernel_cache.launch(_kernel(call, record.key, [term]), dim=1, inputs=[out], device=device, record_cmd=True)
    except kernel_cache.KernelCacheError:
        raise
    except Exception as error:  # Warp raises what it has
        said = " ".join(part for part in str(error).split("\n;") if 'function "call"' not in part)
        raise CoopenvError(f"{term.title}: Warp cannot compile its function to return {expected}: {said}") from None


def _source(term: Bound) -> str:
    return inspect.getsource(term.function.func)


def _kernel(function: Callable[..., None], name: str, terms: Sequence[Bound], source: str | None = None) -> wp.Kernel:
    """Return a kernel in a module that is named after its terms, the same in every process."""
    parts = [f"{t.number} {t.size} {t.entries} {t.own} {t.function.key} {_source(t)}" for t in terms]
    fingerprint = sha256("\n".join(parts).encode()).hexdigest()[:12]
    module = wp.get_module(f"{__name__}.{function.__name__}.{name}.{fingerprint}")
    module.options.update({"enable_backward": False, **near_inlining()})
    return wp.Kernel(func=function, key=function.__name__, module=module, source=source)
