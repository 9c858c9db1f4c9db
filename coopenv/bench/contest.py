"""Drivers on the same held-out worlds, and their results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from coopenv.api.engine import Engine
from coopenv.backends.sources import open_simulation
from coopenv.base.errors import CoopenvError
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import Agent, Policy, agents_for, find_agent
from coopenv.scenario import Scenario

BASELINE, IDEAL = "route_follower", "ideal_sensing"
"""Reference of all comparisons, and the name of the same driver under ideal sensing."""
IDEAL_SENSING: Mapping[str, Any] = {"sensing": "ideal"}


@dataclass(frozen=True)
class Entrant:
    """A driver, and the world it drives in."""

    agent: Agent
    name: str
    kind: str
    scenario: Scenario
    policy: Policy


@dataclass(frozen=True)
class Evaluation:
    """Results of a contest, by the names of the drivers."""

    environment: str
    block: int
    entrants: tuple[Entrant, ...]
    episodes: Mapping[str, Episodes]
    results: Mapping[str, Sequence[Result]]
    reference: str
    """Driver that the differences are to."""
    differences: Mapping[str, Sequence[Difference]]

    @property
    def worlds(self) -> int:
        """Number of worlds of every driver."""
        return next(iter(self.episodes.values())).worlds

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row per driver and metric."""
        return [
            {"agent": entrant.name, "kind": entrant.kind, "environment": self.environment, **asdict(result)}
            for entrant in self.entrants
            for result in self.results[entrant.name]
        ]

    def difference_rows(self) -> list[dict[str, Any]]:
        """Return one flat row per driver that was compared with the reference, and metric."""
        return [
            {"agent": name, "reference": self.reference, "environment": self.environment, **asdict(difference)}
            for name, differences in self.differences.items()
            for difference in differences
        ]


def enter(
    environment: str, name: str, overrides: Mapping[str, Any], agents: Sequence[str], ideal: bool
) -> list[Entrant]:
    """Return the drivers of a contest, built.

    Args:
        environment: name or TOML file.
        name: what the environment is called.
        overrides: dotted keys of the scenario.
        agents: what `find_agent` takes; none: every shipped driver that was made for the environment.
        ideal: let the baseline drive under ideal sensing, too.

    Raises:
        CoopenvError: an agent does not exist or cannot drive here, two have one name, or nothing is driven here.
    """
    scenario = open_simulation(environment, overrides)
    if not scenario.driven:
        raise CoopenvError(f"{environment}: all motion here is prescribed, there is nothing to drive")
    found = [find_agent(text) for text in agents or agents_for(name)]
    if not found:
        raise CoopenvError(f"no agent of agents/ was made for {name}; name some with --agents A,B")
    entrants = [Entrant(agent, agent.name, agent.kind, scenario, agent.policy(scenario)) for agent in found]
    names = [entrant.name for entrant in entrants]
    for twice in (word for word in names if names.count(word) > 1 or (ideal and word == IDEAL)):
        raise CoopenvError(f"--agents: two are called '{twice}'")
    if ideal:
        agent, seeing = find_agent(BASELINE), open_simulation(environment, {**overrides, **IDEAL_SENSING})
        entrants.append(Entrant(agent, IDEAL, "reference", seeing, agent.policy(seeing)))
    return entrants


def contest(
    environment: str,
    entrants: Sequence[Entrant],
    worlds: int,
    block: int,
    on_progress: Callable[[float, str], None] = lambda done, name: None,
) -> Evaluation:
    """Let every entrant drive an episode in each of the same worlds, and judge them.

    Args:
        environment: its name.
        entrants: those of one environment.
        worlds: how many.
        block: number of the block of held-out seeds.
        on_progress: called with the number of drivers that are done, shares included, and the driver's name.
    """
    seeds, episodes = held_out_seeds(block, worlds), {}
    engines: list[tuple[Scenario, Engine]] = []
    try:
        for place, entrant in enumerate(entrants):
            known = [engine for scenario, engine in engines if scenario is entrant.scenario]
            if not known:
                known = [Engine(entrant.scenario, worlds)]
                engines.append((entrant.scenario, known[0]))
                known[0].load()
            report = _report(on_progress, place, entrant.name)
            episodes[entrant.name] = drive(known[0], entrant.policy, seeds, report)
    finally:
        for _, engine in engines:
            engine.close()
    results = {name: score(own, block) for name, own in episodes.items()}
    reference = BASELINE if BASELINE in episodes else entrants[0].name
    others = {
        name: compare_paired(own, episodes[reference], block) for name, own in episodes.items() if name != reference
    }
    return Evaluation(environment, block, tuple(entrants), episodes, results, reference, others)


def _report(on_progress: Callable[[float, str], None], place: int, name: str) -> Callable[[float], None]:
    return lambda share: on_progress(place + share, name)
