"""What a policy is, and those that look at nothing: the neutral action, and random ones."""

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from coopenv.errors import CoopenvError


class Policy(Protocol):
    """Maps what vehicles observe to their actions; a function, or an object that can be called."""

    def __call__(self, observations: np.ndarray, /) -> np.ndarray:
        """Return the actions, (N, 2) in [-1, 1], for flat observations, (N, D), one row per vehicle."""


def decide(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Return the actions that a policy chooses, (N, 2) in float64, clipped to [-1, 1].

    Raises:
        CoopenvError: the policy returned something of another shape.
    """
    actions = np.asarray(policy(observations), dtype=np.float64)
    if actions.shape != (len(observations), 2):
        raise CoopenvError(f"the policy returned actions of shape {actions.shape}, expected {(len(observations), 2)}")
    return np.clip(actions, -1.0, 1.0)


def act(policy: Policy, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the action of every agent of a `ParallelEnv` that a policy chooses from its flat observations."""
    actions = policy(np.stack(list(observations.values())))
    return dict(zip(observations, actions, strict=True))


def zero_policy(seed: int = 0) -> Policy:
    """Return the policy of action zero: straight on, at half of the speed range (or without acceleration)."""
    return lambda observations: np.zeros((len(observations), 2))


def random_policy(seed: int) -> Policy:
    """Return a policy that draws every action uniformly from [-1, 1], the same ones for the same seed."""
    generator = np.random.default_rng(seed % 2**64)
    return lambda observations: generator.uniform(-1.0, 1.0, (len(observations), 2))


PLAIN: dict[str, Callable[[int], Policy]] = {"zero": zero_policy, "random": random_policy}
