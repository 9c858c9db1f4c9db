"""Another driver for vehicles whose radio is silent: a team's policy would wait for messages that never come."""

import numpy as np

from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import check_one_of
from coopenv.base.installation import list_agents
from coopenv.policies.base import decide, restart
from coopenv.policies.loader import load_agent
from coopenv.scenario import Scenario

PATIENCE = 1.0
"""Time (s) since the start of an episode from which on a vehicle that has received no message drives alone."""


class Alone:
    """Lets another agent drive the vehicles that have received no message since their episode began."""

    def __init__(self, scenario: Scenario, agent: str) -> None:
        """Load an agent that ships with coopenv.

        Raises:
            CoopenvError: there is no such agent, or it cannot drive here.
            ValueError: the observation has no messages.
        """
        check_one_of("unknown agent", agent, list_agents())
        received = observation_layout(scenario).get("message_mask")
        if received is None:
            raise ValueError("the observation lacks message_mask")
        self._received, self._driver = slice(received.start, received.stop), load_agent(agent, scenario)
        self._decisions = round(PATIENCE * scenario.rates.decision)
        self._waited = np.zeros(0)  # decisions so far without a message; -inf: there was one
        self.agents = list(getattr(self._driver, "agents", ())) or list(scenario.vehicle_names)

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the rows of a mask (rows,), bool."""
        restart(self._driver, mask)
        self._waited = np.where(mask, 0.0, self._waited) if len(mask) == len(self._waited) else np.zeros(len(mask))

    def __call__(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return actions (rows, A) for observations (rows, D), those of the agent for vehicles that are alone."""
        if len(observations) != len(self._waited):
            self.reset(np.ones(len(observations), dtype=bool))
        self._waited += 1.0
        self._waited[observations[:, self._received].any(axis=1)] = -np.inf
        alone = self._waited > self._decisions
        if not alone.any():
            return actions
        if (begin := self._waited == self._decisions + 1.0).any():
            restart(self._driver, begin)  # what it remembers of them depends on other rows
        return np.where(alone[:, None], decide(self._driver, observations, actions.shape[1]), actions)
