"""Who may measure and hear whom, and in which order vehicles estimate: derived from a scenario."""

from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter

from coopenv.base.errors import listed, shown, suggest
from coopenv.scenario.fields import ScenarioFields


def neighbour_sets(scenario: ScenarioFields) -> list[list[int]]:
    """Return, per vehicle, the indices of the targets that it may measure.

    Without an explicit list these are all landmarks and, under the acyclic restriction, the vehicles before it
    (paper, Assumption 1: N_i within {1, ..., i-1}), otherwise all other vehicles.
    """
    landmarks, vehicles = len(scenario.landmarks), len(scenario.vehicles)
    index = {name: target for target, name in enumerate(scenario.target_names)}
    result = []
    for i, vehicle in enumerate(scenario.vehicles):
        own = landmarks + i
        if vehicle.neighbours is None:
            last = own if scenario.topology.acyclic else landmarks + vehicles
            result.append([*range(own), *range(own + 1, last)])
            continue
        where = f"vehicles.{i}.neighbours"
        for name in vehicle.neighbours:
            if name not in index:
                known = f"{suggest(name, index)}; known: {listed([*index])}"
                raise ValueError(f"{where}: unknown target {shown(name)}{known}")
            if index[name] == own:
                raise ValueError(f"{where}: a vehicle cannot be its own neighbour")
        result.append(sorted({index[name] for name in vehicle.neighbours}))
    return result


def processing_order(scenario: ScenarioFields, neighbours: Sequence[Sequence[int]]) -> list[int]:
    """Return vehicle indices so that leaders come before their followers, from the scenario's `neighbour_sets`.

    Raises:
        ValueError: the neighbour sets contain a cycle although `topology.acyclic` is set.
    """
    landmarks = len(scenario.landmarks)
    if not scenario.topology.acyclic:
        return list(range(len(neighbours)))
    leaders = [[j - landmarks for j in targets if j >= landmarks] for targets in neighbours]
    sorter = TopologicalSorter(dict(enumerate(leaders)))
    try:
        sorter.prepare()
    except CycleError as error:
        names = [f"vehicle_{i + 1}" for i in error.args[1]]
        cycle = " -> ".join(names if len(names) <= 8 else [*names[:6], f"{len(names) - 7} more", names[-1]])
        raise ValueError(
            f"topology: the neighbours form a cycle ({cycle}); the paper's Assumption 1 needs an acyclic order "
            "(or set topology.acyclic = false)"
        ) from None
    order: list[int] = []
    while sorter.is_active():
        ready = sorted(sorter.get_ready())
        order += ready
        sorter.done(*ready)
    return order
