"""The backend `highway`."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np

from coopenv.backends.highway.roads import drawn_roads
from coopenv.backends.highway.simulation import Simulation
from coopenv.backends.moved import MovedWorld
from coopenv.backends.simulated import Simulated
from coopenv.base.errors import CoopenvError
from coopenv.scenario import Scenario
from coopenv.world.collision import UNDER_WAY
from coopenv.world.command import SPEED, STEERING


class HighwayWorld(MovedWorld):
    """Worlds of which each has an environment of highway-env, stepped one after the other."""

    def __init__(self, scenario: Scenario, *arguments: Any, **options: Any) -> None:
        """Build the arrays and the environments; arguments and errors as for `World` and `make_environment`."""
        super().__init__(scenario, *arguments, **options)
        self._simulations = [Simulation(scenario) for _ in range(self.worlds)]

    def restart(self) -> None:
        """Start the next episode in the worlds of `self.mask`, see `World.restart`."""
        seeds, episodes = self.view("seed"), self.view("episode")
        for w in np.flatnonzero(self.mask.numpy()).tolist():
            key = [int(seeds[w]), (int(episodes[w]) + 1) % 2**32]
            self.place(w, self._simulations[w].reset(int(np.random.SeedSequence(key).generate_state(1)[0])))
        super().restart()

    def fetch(self) -> bool:
        """Drive to the next tick in the worlds that are not over.

        Who has ended brakes with its wheels straight: here it still rolls, and its action must not steer it.
        """
        commands, k = np.array(self.view("command"), dtype=float), self.view("tick")
        ended = self.view("ended") != UNDER_WAY
        commands[ended, SPEED] = commands[ended, STEERING] = 0.0
        present = self.view("present")[:, self.model.landmarks :]
        for w in np.flatnonzero((self.mask.numpy() == 0) & (k < self.model.horizon_ticks)).tolist():
            self.move(w, self._simulations[w].drive(commands[w], present[w]))
        return True

    def source_state(self) -> dict[str, Any]:
        """Return copies of the environments, which are objects."""
        return {"highway": deepcopy(self._simulations)}

    def set_source_state(self, values: Mapping[str, Any]) -> None:
        """Go on with copies of environments. Raises CoopenvError: they are not of these worlds."""
        given: Any = values.get("highway")
        if not isinstance(given, list) or [type(simulation) for simulation in given] != [Simulation] * self.worlds:
            raise CoopenvError("state: no environments of highway-env in it")
        self._simulations = deepcopy(given)
        for w, simulation in enumerate(self._simulations):
            if simulation.begun:
                self.remember(w, simulation.poses())


class Highway(Simulated):
    """Worlds of highway-env: many at once on the CPU, or one of them tick by tick."""

    kind = HighwayWorld

    def __init__(self, scenario: Scenario) -> None:
        """Make one environment, whose roads are drawn; errors as for `make_environment`."""
        road = Simulation(scenario).environment.road
        roads = scenario.roads or drawn_roads(road.network, scenario)
        super().__init__(scenario.model_copy(update={"roads": roads}))
