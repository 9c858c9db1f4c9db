"""The plain policies of `coopenv run`, by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coopenv.errors import CoopenvError, suggest

Policy = Callable[[np.ndarray], np.ndarray]
"""Maps the observations of all vehicles, (N, D), to their actions in [-1, 1], (N, 2)."""


def zero_policy(seed: int) -> Policy:
    """Return the policy of action zero: straight on, at half of the speed range (or without acceleration)."""
    return lambda observations: np.zeros((len(observations), 2))


def random_policy(seed: int) -> Policy:
    """Return a policy that draws every action uniformly from [-1, 1], the same ones for the same seed."""
    generator = np.random.default_rng(seed % 2**64)
    return lambda observations: generator.uniform(-1.0, 1.0, (len(observations), 2))


POLICIES: dict[str, Callable[[int], Policy]] = {"zero": zero_policy, "random": random_policy}


def make_policy(name: str, seed: int) -> Policy:
    """Return a policy by name.

    Raises:
        CoopenvError: there is no such policy.
    """
    if name not in POLICIES:
        raise CoopenvError(f"unknown policy '{name}'{suggest(name, POLICIES)}; known: {', '.join(POLICIES)}")
    return POLICIES[name](seed)
