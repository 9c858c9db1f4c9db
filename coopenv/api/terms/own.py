"""User terms: observation fields, reward terms and conditions from outside coopenv, each in a kernel of its own.

Such a kernel reads the records that the results kernel wrote and applies one function. It compiles in a fraction of a
second, once for both precisions.
"""

import inspect
import linecache
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from coopenv.api.arguments import check_finite
from coopenv.api.terms.layout import Layout, entries_of, included_fields, row_counts
from coopenv.api.terms.records import Ego, FleetRecord, MapLandmark, Neighbour, Target, TruthRecord
from coopenv.api.terms.results import Records, write_records
from coopenv.base import installation
from coopenv.base.errors import CoopenvError
from coopenv.estimation import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.own_terms import record_count
from coopenv.scenario.terms import OBSERVATION_FIELDS, READINGS, REWARD_TERMS, TERMINATION_CONDITIONS, Registry, TermRow
from coopenv.world import launch
from coopenv.world.launch import PerWorld, compiler_options
from coopenv.world.route import UNDER_WAY
from coopenv.world.state import allocate
from coopenv.world.world import World

SECOND = {"vehicle": Target, "target": Target, "neighbour": Neighbour, "landmark": MapLandmark}
"""The second record of a field; one per vehicle has none and leaves it unread."""


class OwnTerm(NamedTuple):
    """A user term, bound to its function."""

    title: str
    """Kind and name, for errors."""
    function: wp.Function
    records: int
    """Number of records that the function takes."""
    kernel: Callable[["OwnTerm"], wp.Kernel]
    place: int
    """First entry in the observation, place among the reward terms, or outcome of a condition."""
    returns: str = "a number"
    """Expected return value of the function."""
    weight: float = 0.0
    """Weight of a reward term."""
    per: str = "vehicle"
    size: int = 1
    """Entries of one value."""
    entries: tuple[int, ...] = (0,)
    """Indices of the entries that the observation holds."""
    center: float = 0.0
    scale: float = 1.0


class OwnTerms:
    """The user terms of a scenario, their records and their launches."""

    def __init__(self, scenario: Scenario, world: World, layout: Layout, results: Any) -> None:
        """Load and compile all functions.

        Raises:
            CoopenvError: a function does not exist, cannot be loaded or compiled, takes or returns something else than
                its row says, or uses the truth where the scenario does not say so.
        """
        self._world, self._results, model = world, results, world.model
        terms = [*_own_terms(scenario, layout)]
        self._terms = [term for term in terms if term.kernel is not condition_kernel]
        self._conditions = [term for term in terms if term.kernel is condition_kernel]
        needed = {term.per for term in terms if term.kernel is field_kernel and term.records > 1}
        many = row_counts(scenario)
        self._many = {per: number if per in needed else 0 for per, number in many.items()}
        sizes = {"W": world.worlds, "N": model.vehicles if terms else 0}
        sizes.update(zip("TML", self._many.values(), strict=True))
        self.records = allocate(Records, sizes, world.device)
        """Filled by the results kernel; empty arrays where no user term reads them."""
        nowhere = wp.zeros(world.worlds, dtype=wp.int32, device=world.device)
        for term in terms:
            self._check_function(
                term, [a.value if isinstance(a, PerWorld) else a for a in self._arguments(term, nowhere, nowhere)]
            )

    def end_episodes(self) -> None:
        """End the episodes of vehicles that fulfil a condition."""
        if self._conditions:
            world = self._world
            arguments = [world.model, *map(PerWorld, (world.state, self.records, self._results))]
            world.launch.by_vehicle("records", write_records, arguments, world.model.vehicles)
            self._launch("condition", self._conditions)

    def fill(self, key: str, fresh: Any, chosen: Any) -> None:
        """Add fields and reward terms to the results of the worlds in `chosen` (W,), see `Engine`."""
        self._launch(key, self._terms, fresh, chosen)

    def check(self, view: Callable[[str], np.ndarray]) -> None:
        """Make sure that all values are finite. Raises CoopenvError: one is not."""
        for term in self._terms:
            name, width = "terms", 1
            if term.kernel is field_kernel:
                name, width = "observation", self._many.get(term.per, 1) * len(term.entries)
            check_finite(term.title, view(name)[..., term.place : term.place + width])

    def _launch(self, key: str, terms: list[OwnTerm], fresh: Any = None, chosen: Any = None) -> None:
        for k, term in enumerate(terms):
            more = (self._many.get(term.per, 1),) if term.kernel is field_kernel else ()
            inner = (self._world.model.vehicles, *more)
            self._world.launch((key, k), term.kernel(term), self._arguments(term, fresh, chosen), inner=inner)

    def _arguments(self, term: OwnTerm, fresh: Any, chosen: Any) -> list[Any]:
        """Return the arguments of a term's kernel."""
        results, records, state, model = self._results, self.records, self._world.state, self._world.model
        arrays: tuple[Any, ...] = (records.ego, records.truth, state.tick, state.ended)
        numbers: tuple[float, ...] = (model.ticks_per_decision, model.horizon_ticks, term.place)
        if term.kernel is field_kernel:
            other = getattr(records, "target" if term.per == "vehicle" else term.per)
            arrays, numbers = (
                (records.ego, other, results.observation, chosen),
                (term.place, term.center, 1.0 / term.scale),
            )
        elif term.kernel is reward_kernel:
            arrays = (records.ego, records.truth, results.alive, results.terms, results.reward, fresh, chosen)
            numbers = term.place, term.weight
        return [*map(PerWorld, arrays), *numbers]

    def _check_function(self, term: OwnTerm, inputs: list[Any]) -> None:
        """Compile a term's kernel without running it."""
        dim = (1, 1, 1) if term.kernel is field_kernel else (1, 1)
        try:
            launch.launch(term.kernel(term), dim=dim, inputs=inputs, device=self._world.device, record_cmd=True)
        except launch.KernelCacheError:
            raise
        except Exception as error:  # Warp raises various types
            reason = " ".join(part for part in str(error).split("\n;") if 'function "apply"' not in part)
            raise CoopenvError(
                f"{term.title}: Warp cannot compile its function to return {term.returns}: {reason}"
            ) from None


@cache
def field_kernel(term: OwnTerm) -> wp.Kernel:
    """Return the kernel of an observation field: one thread per (world, vehicle, target, neighbour or landmark)."""
    function, both, many = term.function, term.records > 1, term.size > 1
    returned = wp.types.vector(term.size, wp.float32) if many else wp.float32
    width, entries = len(term.entries), wp.types.vector(len(term.entries), wp.int32)(*term.entries)

    def apply(
        ego: wp.array2d(dtype=Ego),
        other: wp.array3d(dtype=SECOND[term.per]),
        observation: wp.array3d(dtype=wp.float32),
        chosen: wp.array(dtype=wp.int32),
        place: int,
        center: wp.float32,
        factor: wp.float32,
    ):
        """Write (value - center) factor, clipped to [-1, 1]; NaN stays."""
        world, vehicle, n = wp.tid()
        if chosen[world] == 0:
            return
        value = function(ego[world, vehicle], other[world, vehicle, n]) if both else function(ego[world, vehicle])
        returned(value)  # Warp compiles it for a value of this size only
        for k in range(width):
            entry = (wp.float32(value[entries[k]] if many else value) - center) * factor
            clipped = wp.clamp(entry, -1.0, 1.0)
            observation[world, vehicle, place + n * width + k] = wp.where(wp.isnan(entry), entry, clipped)

    return _kernel(apply)


@wp.func
def fleet_of(ego: wp.array(dtype=Ego), truth: wp.array(dtype=TruthRecord), alive: wp.array(dtype=wp.bool)):
    """Return the figures of a world's vehicles under way from their records (N,)."""
    fleet = FleetRecord()
    for vehicle in range(ego.shape[0]):
        if alive[vehicle]:
            fleet.vehicles += 1
            share = 1.0 / wp.float32(fleet.vehicles)
            error, std = truth[vehicle].position_error, ego[vehicle].position_std
            fleet.mean_error += share * (error - fleet.mean_error)
            fleet.mean_std += share * (std - fleet.mean_std)
            fleet.worst_error = wp.max(error, fleet.worst_error)
            fleet.worst_std = wp.max(std, fleet.worst_std)
    return fleet


@cache
def reward_kernel(term: OwnTerm) -> wp.Kernel:
    """Return the kernel of a reward term: one thread per (world, vehicle)."""
    function, both, fleet = term.function, term.records > 1, term.records > 2

    def apply(
        ego: wp.array2d(dtype=Ego),
        truth: wp.array2d(dtype=TruthRecord),
        alive: wp.array2d(dtype=wp.bool),
        terms: wp.array3d(dtype=wp.float32),
        reward: wp.array2d(dtype=wp.float32),
        fresh: wp.array(dtype=wp.int32),
        chosen: wp.array(dtype=wp.int32),
        place: int,
        weight: wp.float32,
    ):
        """Write the term's value and add it to the reward of vehicles under way."""
        world, vehicle = wp.tid()
        if chosen[world] == 0:
            return
        if fleet:
            value = wp.float32(
                function(ego[world, vehicle], truth[world, vehicle], fleet_of(ego[world], truth[world], alive[world]))
            )
        else:
            value = wp.float32(
                function(ego[world, vehicle], truth[world, vehicle]) if both else function(ego[world, vehicle])
            )
        terms[world, vehicle, place] = value
        if alive[world, vehicle] and fresh[world] == 0:
            reward[world, vehicle] = reward[world, vehicle] + weight * value

    return _kernel(apply)


@cache
def condition_kernel(term: OwnTerm) -> wp.Kernel:
    """Return the kernel of a condition: one thread per (world, vehicle)."""
    function, both = term.function, term.records > 1

    def apply(
        ego: wp.array2d(dtype=Ego),
        truth: wp.array2d(dtype=TruthRecord),
        ticks: wp.array(dtype=wp.int32),
        ended: wp.array2d(dtype=wp.int32),
        ticks_per_decision: int,
        horizon_ticks: int,
        outcome: int,
    ):
        """End the episode of a vehicle. Conditions count after a decision, not right after a reset."""
        world, vehicle = wp.tid()
        tick = ticks[world]
        decided = tick > 0 and (tick % ticks_per_decision == 0 or tick == horizon_ticks)
        if decided and ended[world, vehicle] == UNDER_WAY:
            if wp.bool(function(ego[world, vehicle], truth[world, vehicle]) if both else function(ego[world, vehicle])):
                ended[world, vehicle] = outcome

    return _kernel(apply)


def _kernel(function: Callable[..., None]) -> wp.Kernel:
    return wp.kernel(function, module="unique", module_options={"enable_backward": False, **compiler_options()})


def _own_terms(scenario: Scenario, layout: Layout) -> Iterator[OwnTerm]:
    """Yield the user terms of a scenario: fields, reward terms, and conditions."""
    for name, row in included_fields(scenario).items():
        if name not in OBSERVATION_FIELDS.built_in and row.group != READINGS:
            field, returns = layout[name], "a number" if row.size == 1 else f"a vector of {row.size}"
            bound = _bound(OBSERVATION_FIELDS, name, row, (1 if row.per == "vehicle" else 2,))
            term = OwnTerm(*bound, field_kernel, field.start, returns, center=field.center, scale=field.scale)
            yield term._replace(per=row.per, size=row.size, entries=entries_of(row, scenario))
    rewards = REWARD_TERMS.known(scenario.reward.custom)
    for place, (name, weight) in enumerate(scenario.reward.by_name.items()):
        if name not in REWARD_TERMS.built_in:
            bound = _bound(REWARD_TERMS, name, rewards.get(name), (1, 2, 3))
            if weight and bound[2] > 1 and not scenario.reward.privileged:
                raise CoopenvError(f"{bound[0]} uses the truth: reward.privileged must be true")
            yield OwnTerm(*bound, reward_kernel, place, weight=weight)
    conditions = TERMINATION_CONDITIONS.known(scenario.termination.custom)
    for place, name in enumerate(scenario.termination.own, len(Outcome)):
        bound = _bound(TERMINATION_CONDITIONS, name, conditions.get(name), (1, 2))
        if bound[2] > 1 and not scenario.termination.privileged:
            raise CoopenvError(f"{bound[0]} uses the truth: termination.privileged must be true")
        yield OwnTerm(*bound, condition_kernel, place, "true or false")


def _bound(
    kind: Registry[Any], name: str, row: TermRow | None, records: tuple[int, ...]
) -> tuple[str, wp.Function, int]:
    """Return title and function of a term, and how many records it takes."""
    title = f"{kind.kind} '{name}'"
    if row is None:
        raise CoopenvError(f"{title} is not registered in this process; see docs/terms.md")
    function = row.function
    if isinstance(function, str):
        linecache.checkcache()  # Warp reads the source of a file that may have changed
        try:
            function = installation.load_reference(function)
        except CoopenvError as error:
            raise CoopenvError(f"{title}: {error}") from None
    taken = record_count(title, function, records)
    try:
        return title, _warp_function(function), taken
    except RuntimeError as error:  # Warp reads the source, which a program of text does not have
        raise CoopenvError(f"{title}: {error}") from None


@cache
def _warp_function(function: Callable[..., Any]) -> Any:
    if isinstance(function, wp.Function):
        return function
    if function.__code__.co_filename == "<string>":  # of which Python 3.13 may find another program's source
        raise RuntimeError("its source is not known; please save it to a file")
    for name in inspect.signature(function).parameters:
        function.__annotations__.setdefault(name, Any)
    return wp.func(function)
