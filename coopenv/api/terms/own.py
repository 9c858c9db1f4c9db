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

from coopenv.api.reward import check_finite
from coopenv.api.terms.layout import Layout, entries_of, included_fields
from coopenv.api.terms.records import Ego, MapLandmark, Neighbour, Target, Truth
from coopenv.api.terms.results import Records, write_records
from coopenv.base import installation
from coopenv.base.errors import CoopenvError
from coopenv.estimation.outcomes import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.own_terms import record_count
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS, TERMINATION_CONDITIONS, Registry, Row
from coopenv.world import launch
from coopenv.world.dynamics import UNDER_WAY
from coopenv.world.launch import PerWorld, compiler_options
from coopenv.world.state import allocate
from coopenv.world.world import World

SECOND = {"vehicle": Target, "target": Target, "neighbour": Neighbour, "landmark": MapLandmark}
"""The second record of a field; one per vehicle has none and leaves it unread."""


class OwnTerm(NamedTuple):
    """A user term, bound to its function."""

    title: str
    """Kind and name, for errors."""
    function: wp.Function
    both: bool
    """Whether it takes a second record."""
    place: int
    """First entry in the observation, place among the reward terms, or outcome of a condition."""
    weight: float = 0.0
    """Of a reward term."""
    per: str = "vehicle"
    size: int = 1
    """Entries of one value."""
    entries: tuple[int, ...] = (0,)
    """Those that the observation holds."""
    center: float = 0.0
    scale: float = 1.0

    @property
    def result(self) -> tuple[Any, str]:
        """The type of a number that the function returns, and its name."""
        if self.size == 1:
            return wp.float32, "a number"
        return wp.types.vector(self.size, wp.float32), f"a vector of {self.size}"


class OwnTerms:
    """The user terms of a scenario, their records and their launches."""

    def __init__(self, scenario: Scenario, world: World, layout: Layout, results: Any) -> None:
        """Load and compile all functions.

        Raises:
            CoopenvError: a function does not exist, cannot be loaded or compiled, takes or returns something else than
                its row says, or uses the truth where the scenario does not say so.
        """
        self._world, self._results = world, results
        self._fields = [*_own_fields(scenario, layout)]
        self._rewards = [*_own_rewards(scenario)]
        self.conditions = [*_own_conditions(scenario)]
        needed = {field.per for field in self._fields if field.both}
        vehicles = len(scenario.vehicles) if self._fields or self._rewards or self.conditions else 0
        sizes = {"W": world.worlds, "N": vehicles}
        many = {"target": world.model.agents, "neighbour": world.model.vehicles - 1, "landmark": world.model.map_size}
        self._many = {per: number if per in needed else 0 for per, number in many.items()}
        sizes.update(zip("TML", self._many.values(), strict=True))
        self.records = allocate(Records, sizes, world.device)
        """Filled by the results kernel; empty arrays where no user term reads them."""
        nowhere = wp.zeros(world.worlds, dtype=wp.int32, device=world.device)
        for term in self._fields:
            self._check(term, field_kernel, term.result[1], self._field_arguments(term, nowhere))
        for term in self._rewards:
            self._check(term, reward_kernel, term.result[1], self._reward_arguments(term, nowhere, nowhere))
        for term in self.conditions:
            self._check(term, condition_kernel, "true or false", self._condition_arguments(term))

    def end_episodes(self) -> None:
        """End the episodes of vehicles that fulfil a condition."""
        if not self.conditions:
            return
        state, records = PerWorld(self._world.state), PerWorld(self.records)
        self._launch("records", write_records, [self._world.model, state, records, PerWorld(self._results)])
        for k, term in enumerate(self.conditions):
            self._launch(("condition", k), condition_kernel(term), self._condition_arguments(term))

    def fill(self, key: str, fresh: Any, chosen: Any) -> None:
        """Add fields and reward terms to the results of the worlds in `chosen` (W,), see `Report.fill`."""
        for k, term in enumerate(self._fields):
            arguments = self._field_arguments(term, chosen)
            self._launch(("field", key, k), field_kernel(term), arguments, (self._many.get(term.per, 1),))
        for k, term in enumerate(self._rewards):
            self._launch(("reward", key, k), reward_kernel(term), self._reward_arguments(term, fresh, chosen))

    def check(self, view: Callable[[str], np.ndarray]) -> None:
        """Make sure that all values are finite. Raises CoopenvError: one is not."""
        for term in self._fields:
            check_finite(term.title, view("observation")[..., term.place : term.place + self._width(term)])
        for term in self._rewards:
            check_finite(term.title, view("terms")[..., term.place])

    def _width(self, term: OwnTerm) -> int:
        return self._many.get(term.per, 1) * len(term.entries)

    def _launch(self, key: Any, kernel: Any, arguments: list[Any], more: tuple[int, ...] = ()) -> None:
        self._world.launch(key, kernel, arguments, inner=(self._world.model.vehicles, *more))

    def _field_arguments(self, term: OwnTerm, chosen: Any) -> list[Any]:
        other = getattr(self.records, "target" if term.per == "vehicle" else term.per)
        arrays = (self.records.ego, other, self._results.observation, chosen)
        return [*map(PerWorld, arrays), term.place, term.center, 1.0 / term.scale]

    def _reward_arguments(self, term: OwnTerm, fresh: Any, chosen: Any) -> list[Any]:
        results, records = self._results, self.records
        arrays = (records.ego, records.truth, results.alive, results.terms, results.reward, fresh, chosen)
        return [*map(PerWorld, arrays), term.place, term.weight]

    def _condition_arguments(self, term: OwnTerm) -> list[Any]:
        state, model = self._world.state, self._world.model
        arrays = (self.records.ego, self.records.truth, state.tick, state.ended)
        return [*map(PerWorld, arrays), model.ticks_per_decision, model.horizon_ticks, term.place]

    def _check(self, term: OwnTerm, factory: Callable[[OwnTerm], Any], expected: str, arguments: list[Any]) -> None:
        """Compile a term's kernel without running it."""
        device = self._world.device
        inputs = [a.value if isinstance(a, PerWorld) else a for a in arguments]
        dim = (1, 1, 1) if factory is field_kernel else (1, 1)
        try:
            launch.launch(factory(term), dim=dim, inputs=inputs, device=device, record_cmd=True)
        except launch.KernelCacheError:
            raise
        except Exception as error:  # Warp raises various types
            reason = " ".join(part for part in str(error).split("\n;") if 'function "apply"' not in part)
            raise CoopenvError(
                f"{term.title}: Warp cannot compile its function to return {expected}: {reason}"
            ) from None


@cache
def field_kernel(term: OwnTerm) -> wp.Kernel:
    """Return the kernel of an observation field: one thread per (world, vehicle, target, neighbour or landmark)."""
    function, both, returned, many = term.function, term.both, term.result[0], term.size > 1
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


@cache
def reward_kernel(term: OwnTerm) -> wp.Kernel:
    """Return the kernel of a reward term: one thread per (world, vehicle)."""
    function, both = term.function, term.both

    def apply(
        ego: wp.array2d(dtype=Ego),
        truth: wp.array2d(dtype=Truth),
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
    function, both = term.function, term.both

    def apply(
        ego: wp.array2d(dtype=Ego),
        truth: wp.array2d(dtype=Truth),
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


def _own_fields(scenario: Scenario, layout: Layout) -> Iterator[OwnTerm]:
    for name, row in included_fields(scenario).items():
        if name not in OBSERVATION_FIELDS.built_in:
            term, field = _bound(OBSERVATION_FIELDS, name, row, (1 if row.per == "vehicle" else 2,)), layout[name]
            term = term._replace(place=field.start, center=field.center, scale=field.scale)
            yield term._replace(per=row.per, size=row.size, entries=entries_of(row, scenario))


def _own_rewards(scenario: Scenario) -> Iterator[OwnTerm]:
    known = REWARD_TERMS.known(scenario.reward.custom)
    for place, (name, weight) in enumerate(scenario.reward.by_name.items()):
        if name not in REWARD_TERMS.built_in:
            term = _bound(REWARD_TERMS, name, known.get(name), (1, 2))
            if weight and term.both and not scenario.reward.privileged:
                raise CoopenvError(f"{term.title} uses the truth: reward.privileged must be true")
            yield term._replace(place=place, weight=weight)


def _own_conditions(scenario: Scenario) -> Iterator[OwnTerm]:
    known = TERMINATION_CONDITIONS.known(scenario.termination.custom)
    for place, name in enumerate(scenario.termination.own, len(Outcome)):
        term = _bound(TERMINATION_CONDITIONS, name, known.get(name), (1, 2))
        if term.both and not scenario.termination.privileged:
            raise CoopenvError(f"{term.title} uses the truth: termination.privileged must be true")
        yield term._replace(place=place)


def _bound(kind: Registry[Any], name: str, row: Row | None, records: tuple[int, ...]) -> OwnTerm:
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
        return OwnTerm(title, _warp_function(function), taken == 2, 0)
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
