"""Drivers, and the held-out worlds in which each of them drives; worlds that are harder or easier to sense."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from coopenv.api.engine import Engine
from coopenv.base.errors import ActionError, CoopenvError
from coopenv.base.seeds import checked_seed
from coopenv.evaluation import Episodes, drive, held_out_seeds
from coopenv.policies import Agent, Policy, agents_for, find_agent
from coopenv.scenario import Scenario, ScenarioLike, scenario_name
from coopenv.sources.sources import open_simulation

BASELINE, IDEAL = "route_follower", "ideal_sensing"
"""Reference of all comparisons, and the name of the same driver under ideal sensing."""
IDEAL_SENSING: Mapping[str, Any] = {"sensing": "ideal"}


OF_MESSAGES: dict[str, dict[str, Any]] = {
    "60 % of messages lost": {"v2x.loss": 0.6},
    "vehicle_1 lies": {"vehicles.0.faults.lie": {"kind": "jump", "start": 2.0, "offset": 3.0}},
}


BACK = 1.2
"""Factor by which landmarks are set back from the origin."""


def stress(scenario: Scenario) -> dict[str, dict[str, Any]]:
    """Return overrides for worlds that are harder or easier to sense than a scenario's, by what is changed."""
    noise, camera = scenario.noise, scenario.camera
    lenses = (0.6, 1.5) if camera.model == "pinhole" else ()
    boxes = {f"landmark_groups.{i}.boxes": group.boxes for i, group in enumerate(scenario.landmark_groups)}
    back = {key: [{"center": [BACK * x for x in b.center], "half": b.half} for b in own] for key, own in boxes.items()}
    one = {
        key: [b for b in own if all(x * y >= 0 for x, y in zip(b.center, own[0].center, strict=True))]
        for key, own in boxes.items()
    }
    corner = {key: [b.model_dump() for b in own] for key, own in one.items() if len(own) < len(boxes[key])}
    return {
        "ideal sensing": dict(IDEAL_SENSING),
        "all-round cameras": {"camera.model": "omnidirectional"},
        "twice the range": {"randomisation.camera_range": [2.0, 2.0]},
        "3/4 of the range": {"randomisation.camera_range": [0.75, 0.75]},
        "half of the landmarks": {"randomisation.landmark_presence": [0.5, 0.5]},
        "a third of the landmarks": {"randomisation.landmark_presence": [0.333, 0.333]},
        "bearing noise x 5": {"noise.bearing.scale": 5.0 * noise.bearing.scale},
        "odometry noise x 4": {
            "noise.velocity": 4.0 * noise.velocity,
            "noise.angular_velocity": 4.0 * noise.angular_velocity,
            "noise.odometry_scale": 0.03,
            "noise.gyro_bias": [0.0, 0.0, 0.0087],
        },
        **{f"initial error x {by:g}": {"randomisation.initial_error": [by, by]} for by in (2.0, 3.0)},
        **{f"focal length x {by:g}": {"camera.focal_length": [by * f for f in camera.focal_length]} for by in lenses},
        "mounting error 2 deg": {"camera.extrinsics_error": math.radians(2.0)},
        **({f"landmarks {BACK:g} x as far out": back} if any(back.values()) else {}),
        **({"landmarks in one corner": corner} if corner else {}),
        **(OF_MESSAGES if len(scenario.vehicles) > 1 else {}),
    }


@dataclass(frozen=True)
class Entrant:
    """A driver, and the world it drives in."""

    agent: Agent
    name: str
    kind: str
    scenario: Scenario
    policy: Policy


@dataclass(frozen=True, eq=False)
class Contest:
    """Drivers, and the held-out worlds that each of them drives in."""

    environment: str
    overrides: Mapping[str, Any]
    """Dotted keys of the scenario."""
    entrants: tuple[Entrant, ...]
    worlds: int
    block: int
    """Number of the block of held-out seeds."""

    @classmethod
    def of(
        cls,
        environment: ScenarioLike,
        overrides: Mapping[str, Any],
        agents: Sequence[str | Callable[..., Any]],
        worlds: int,
        block: int = 0,
        ideal: bool = False,
        stressed: bool = False,
    ) -> "Contest":
        """Build the drivers.

        Args:
            environment: as for `load_scenario`.
            overrides: dotted keys of the scenario.
            agents: agents as for `find_agent`; none: every shipped driver that was made for the environment.
            worlds: number of worlds.
            block: number of the block of held-out seeds.
            ideal: let the baseline drive under ideal sensing, too.
            stressed: let the drivers drive in the worlds of `stress`, too.

        Raises:
            CoopenvError: an agent does not exist or cannot drive here, two have one name, or nothing is driven here.
        """
        worlds, block = checked_seed(worlds, "worlds"), checked_seed(block, "seed_block")
        if worlds < 1:
            raise CoopenvError(f"worlds must be at least 1, got {worlds}")
        scenario, name = open_simulation(environment, overrides), scenario_name(environment)
        if not any(scenario.acting):
            why = "every driven vehicle has a driver" if scenario.driven else "all motion here is prescribed"
            raise CoopenvError(f"{name}: {why}, there is nothing to drive")
        found = [find_agent(text) for text in agents or agents_for(name)]
        if not found:
            raise CoopenvError(f"no agent of agents/ was made for {name}; name some with --agents A,B")
        entrants = [Entrant(agent, agent.name, agent.kind, scenario, agent.policy(scenario)) for agent in found]
        for row, changed in stress(scenario).items() if stressed else ():
            other = open_simulation(environment, {**overrides, **changed})
            entrants += [Entrant(a, f"{a.name}, {row}", a.kind, other, a.policy(other)) for a in found]
        names = [entrant.name for entrant in entrants]
        for twice in (word for word in names if names.count(word) > 1 or (ideal and word == IDEAL)):
            raise CoopenvError(f"agents: two are called '{twice}'")
        if ideal:
            agent, seeing = find_agent(BASELINE), open_simulation(environment, {**overrides, **IDEAL_SENSING})
            entrants.append(Entrant(agent, IDEAL, "reference", seeing, agent.policy(seeing)))
        return cls(name, overrides, tuple(entrants), worlds, block)

    def drive(self, on_progress: Callable[[float, str], None] = lambda done, name: None) -> dict[str, Episodes]:
        """Return the episodes of every driver, one in each of the same worlds, by name.

        `on_progress` is called with the number of drivers that are done, shares included, and the driver's name.
        """
        seeds, episodes = held_out_seeds(self.block, self.worlds), dict[str, Episodes]()
        for _, group in groupby(enumerate(self.entrants), lambda row: id(row[1].scenario)):
            here = list(group)
            with closing(Engine(here[0][1].scenario, self.worlds)) as engine:
                engine.load()
                for place, entrant in here:

                    def report(share: float, place: int = place, name: str = entrant.name) -> None:
                        on_progress(place + share, name)

                    try:
                        episodes[entrant.name] = drive(engine, entrant.policy, seeds, report)
                    except ActionError as error:
                        raise ActionError(f"agent {entrant.name}: {error}") from error
        return episodes
