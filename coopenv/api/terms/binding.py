"""The terms that a scenario names, bound to their Warp functions."""

import inspect
import linecache
from collections.abc import Callable, Mapping
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import warp as wp

from coopenv.api.terms.layout import Layout, entries_of, included_fields
from coopenv.base import user_code
from coopenv.base.errors import CoopenvError
from coopenv.estimation.outcomes import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.own_terms import record_count
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS, TERMINATION_CONDITIONS, Registry, Row, Term


class Bound(NamedTuple):
    """A term as a kernel calls it."""

    title: str
    """Kind and name, for errors."""
    own: bool
    """Whether it is not coopenv's."""
    number: int
    """Place among the terms of its kind; of a condition: the outcome."""
    function: wp.Function
    records: int
    """How many it takes: `Ego`, and the kind's second one."""
    size: int = 1
    """Entries of one value."""
    entries: tuple[int, ...] = (0,)
    """Those of them that the observation holds."""


class Terms(NamedTuple):
    """The terms of a scenario: fields of the observation, with one value per vehicle, target, ...; and others."""

    vehicle_fields: tuple[Bound, ...]
    target_fields: tuple[Bound, ...]
    neighbour_fields: tuple[Bound, ...]
    landmark_fields: tuple[Bound, ...]
    rewards: tuple[Bound, ...]
    conditions: tuple[Bound, ...]


def bound_terms(scenario: Scenario) -> Terms:
    """Return the functions of the scenario's observation fields, reward terms, and conditions of its own.

    Raises:
        CoopenvError: a function does not exist, cannot be loaded, takes something else than its row says, or uses the
            truth where the scenario does not say so.
    """
    fields: dict[str, list[Bound]] = {"vehicle": [], "target": [], "neighbour": [], "landmark": []}
    for i, (name, row) in enumerate(included_fields(scenario).items()):
        bound = _bound(OBSERVATION_FIELDS, name, row, i, (1 if row.per == "vehicle" else 2,))
        fields[row.per].append(bound._replace(size=row.size, entries=entries_of(row, scenario)))
    rewards = _all_bound(REWARD_TERMS, scenario.reward.by_name, scenario.reward, 0)
    switches = dict.fromkeys(scenario.termination.own, True)
    conditions = _all_bound(TERMINATION_CONDITIONS, switches, scenario.termination, len(Outcome))
    of_vehicle, of_target, of_neighbour, of_landmark = map(tuple, fields.values())
    return Terms(of_vehicle, of_target, of_neighbour, of_landmark, rewards, conditions)


def own_places(terms: Terms, layout: Layout) -> list[tuple[str, str, slice]]:
    """Return (title, field of the step results, entries) of every term that is not coopenv's and has values there."""
    fields, places = [*chain(*terms[:4])], [*layout.values()]
    observed = [(field.title, "observation", places[field.number].slice) for field in fields if field.own]
    return observed + [(t.title, "terms", slice(t.number, t.number + 1)) for t in terms.rewards if t.own]


def _all_bound(kind: Registry[Term], used: Mapping[str, float], part: Any, first: int) -> tuple[Bound, ...]:
    known, result = kind.known(part.custom), []
    for i, (name, weight) in enumerate(used.items(), first):
        if name not in known:
            raise CoopenvError(f"{kind.kind} '{name}' is not registered in this process; see docs/terms.md")
        bound = _bound(kind, name, known[name], i, (1, 2))
        if weight and bound.records == 2 and not part.privileged:
            raise CoopenvError(f"{bound.title} uses the truth: {type(part).__name__.lower()}.privileged must be true")
        result.append(bound)
    return tuple(result)


def _bound(kind: Registry[Any], name: str, row: Row, number: int, records: tuple[int, ...]) -> Bound:
    title, function = f"{kind.kind} '{name}'", row.function
    if isinstance(function, str):
        if name not in kind.built_in:
            linecache.checkcache()  # Warp reads the source of a file that may have changed
        try:
            function = user_code.load(function)
        except CoopenvError as error:
            raise CoopenvError(f"{title}: {error}") from None
    taken = record_count(title, function, records)
    try:
        return Bound(title, name not in kind.built_in, number, _warp_function(function), taken)
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
