"""The policies that `coopenv run` knows by name: two plain ones, and the agents of `agents/`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from coopenv.api.layout import Field
from coopenv.errors import CoopenvError, suggest
from coopenv.policies import load_agent
from coopenv.shipped import list_agents

Policy = Callable[[np.ndarray], np.ndarray]
"""Maps the observations of all vehicles, (N, D), to their actions in [-1, 1], (N, 2)."""


def zero_policy(seed: int) -> Policy:
    """Return the policy of action zero: straight on, at half of the speed range (or without acceleration)."""
    return lambda observations: np.zeros((len(observations), 2))


def random_policy(seed: int) -> Policy:
    """Return a policy that draws every action uniformly from [-1, 1], the same ones for the same seed."""
    generator = np.random.default_rng(seed % 2**64)
    return lambda observations: generator.uniform(-1.0, 1.0, (len(observations), 2))


PLAIN: dict[str, Callable[[int], Policy]] = {"zero": zero_policy, "random": random_policy}


def make_policy(name: str, seed: int, layout: Mapping[str, Field]) -> Policy:
    """Return a policy by name: `zero`, `random`, or an agent.

    Raises:
        CoopenvError: there is no such policy, or the agent cannot drive with observations of this layout.
    """
    if name in PLAIN:
        return PLAIN[name](seed)
    if name not in list_agents():
        known = [*PLAIN, *list_agents()]
        raise CoopenvError(f"unknown policy '{name}'{suggest(name, known)}; known: {', '.join(known)}")
    agent = load_agent(name, layout)
    return lambda observations: np.stack([agent.act(row) for row in observations])
