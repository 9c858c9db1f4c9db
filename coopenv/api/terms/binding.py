"""The terms that a scenario names, bound to their functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

from coopenv.api.terms.chains import Bound, Terms
from coopenv.api.terms.functions import term_function
from coopenv.api.terms.layout import included_fields
from coopenv.errors import CoopenvError
from coopenv.estimation.trajectory import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.term_tables import REWARD_TERMS, TERMINATION_CONDITIONS
from coopenv.scenario.terms import Registry, TruthTerm

Row = TypeVar("Row", bound=TruthTerm)


def bound_terms(scenario: Scenario) -> Terms:
    """Return the functions of the scenario's observation fields and reward terms.

    Raises:
        CoopenvError: a function does not exist, cannot be loaded, or takes something else than its row says.
    """
    fields: dict[str, list[Bound]] = {"vehicle": [], "target": [], "neighbour": []}
    for i, (name, field) in enumerate(included_fields(scenario).items()):
        records = 1 if field.per == "vehicle" else 2
        function = term_function(f"observation field '{name}'", field, records)
        fields[field.per].append(Bound(i, function, records, field.size))
    rewards = _bound(REWARD_TERMS, scenario.reward.by_name, scenario.reward.custom, 0)
    conditions = _bound(TERMINATION_CONDITIONS, scenario.termination.own, scenario.termination.custom, len(Outcome))
    by_record = (tuple(fields["vehicle"]), tuple(fields["target"]), tuple(fields["neighbour"]))
    return Terms(*by_record, rewards, conditions)


def _bound(kind: Registry[Row], names: Iterable[str], custom: Mapping[str, Row], first: int) -> tuple[Bound, ...]:
    known = kind.known(custom)
    bound = []
    for i, name in enumerate(names, first):
        what = f"{kind.kind} '{name}'"
        if name not in known:
            raise CoopenvError(f"{what} is not registered in this process; see docs/terms.md")
        records = 2 if known[name].privileged else 1
        bound.append(Bound(i, term_function(what, known[name], records), records))
    return tuple(bound)
