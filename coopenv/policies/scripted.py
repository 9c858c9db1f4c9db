"""Vehicles that agents drive in place of actions: `motion.driver` of a scenario."""

from copy import deepcopy

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.policies.base import Policy, decide, restart
from coopenv.policies.loader import load_agent
from coopenv.scenario import Scenario


class ScriptedVehicles:
    """The drivers of a batch of worlds, one policy per agent that the scenario names."""

    def __init__(self, scenario: Scenario) -> None:
        """Load the agents. Raises CoopenvError: there is no such agent, or it cannot drive in this scenario."""
        self.policies: dict[str, Policy] = {}
        self._vehicles: dict[str, list[int]] = {}
        for i, driver in enumerate(scenario.drivers):
            if driver is None:
                continue
            self._vehicles.setdefault(driver, []).append(i)
            try:
                self.policies.setdefault(driver, load_agent(driver, scenario))
            except CoopenvError as error:
                raise CoopenvError(f"vehicles.{i}.motion.driver: {error}") from None

    def restart(self, worlds: np.ndarray, vehicles: int) -> None:
        """Begin new episodes in the worlds of a mask (W,), bool."""
        for policy in self.policies.values():
            restart(policy, np.repeat(worlds, vehicles))

    def act(self, observations: np.ndarray, actions: np.ndarray) -> None:
        """Write the actions (W, N, A) of the scripted vehicles for observations (W, N, D).

        A policy gets the rows of all vehicles, since the place of a row tells it which vehicle it drives.
        """
        rows = observations.reshape(-1, observations.shape[-1]).copy()
        for driver, policy in self.policies.items():
            chosen = decide(policy, rows, actions.shape[-1]).reshape(actions.shape)
            actions[:, self._vehicles[driver]] = chosen[:, self._vehicles[driver]]

    def get_state(self) -> dict[str, Policy]:
        """Return copies of the policies, which may have a memory."""
        return deepcopy(self.policies)

    def set_state(self, state: object) -> None:
        """Restore what `get_state` returned. Raises CoopenvError: it is of other drivers; nothing has changed then."""
        if not isinstance(state, dict) or [*state] != [*self.policies]:
            raise CoopenvError("state: no drivers of the scripted vehicles in it")
        self.policies = deepcopy(state)
