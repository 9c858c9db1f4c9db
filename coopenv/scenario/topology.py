"""Who may measure and hear whom, and in which order vehicles estimate: derived from a scenario."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

from coopenv.errors import suggest
from coopenv.scenario.fields import ScenarioFields


def neighbour_sets(scenario: ScenarioFields) -> list[list[int]]:
    """Return, per vehicle, the indices of the targets that it may measure.

    Without an explicit list these are all landmarks and, under the acyclic restriction, the vehicles before it
    (paper, Assumption 1: N_i within {1, ..., i-1}), otherwise all other vehicles.
    """
    landmarks = len(scenario.landmarks)
    targets = scenario.target_names
    result = []
    for i, vehicle in enumerate(scenario.vehicles):
        if vehicle.neighbours is None:
            others = range(i) if scenario.topology.acyclic else range(len(scenario.vehicles))
            result.append([*range(landmarks), *(landmarks + j for j in others if j != i)])
            continue
        where = f"vehicles.{i}.neighbours"
        for name in vehicle.neighbours:
            if name not in targets:
                raise ValueError(
                    f"{where}: unknown target '{name}'{suggest(name, targets)}; known: {', '.join(targets)}"
                )
            if name == f"vehicle_{i + 1}":
                raise ValueError(f"{where}: a vehicle cannot be its own neighbour")
        result.append(sorted({scenario.target_index(name) for name in vehicle.neighbours}))
    return result


def processing_order(scenario: ScenarioFields) -> list[int]:
    """Return vehicle indices so that leaders come before their followers.

    Raises:
        ValueError: the neighbour sets contain a cycle although `topology.acyclic` is set.
    """
    landmarks = len(scenario.landmarks)
    graph = {
        i: {j - landmarks for j in targets if j >= landmarks} for i, targets in enumerate(neighbour_sets(scenario))
    }
    if not scenario.topology.acyclic:
        return sorted(graph)
    sorter = TopologicalSorter(graph)
    try:
        sorter.prepare()
    except CycleError as error:
        cycle = " -> ".join(f"vehicle_{i + 1}" for i in error.args[1])
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
