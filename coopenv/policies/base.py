"""The interface of a policy, and policies without observations: the neutral action, and random ones."""

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from coopenv.base import installation
from coopenv.base.errors import ActionError, shown


class Policy(Protocol):
    """Maps observations of vehicles to their actions; a function, or an object that can be called.

    It chooses for all rows of a batch at once, each from its own observation alone. A policy with
    memory also has a method `reset(mask)`, see `restart`, and gets the same rows, in the same order, every time.
    """

    def __call__(self, observations: np.ndarray, /) -> np.ndarray:
        """Return the actions, (rows, A) in [-1, 1], for flat observations, (rows, D)."""


def restart(policy: Policy, mask: np.ndarray) -> None:
    """Reset a policy with memory in rows of a mask (rows,), bool, where a new episode begins."""
    reset = getattr(policy, "reset", None)
    if callable(reset):
        with installation.blamed("the policy's reset"):
            reset(mask)


def decide(policy: Policy, observations: np.ndarray, width: int = 2) -> np.ndarray:
    """Return the actions that a policy chooses, (rows, width) in float64, clipped to [-1, 1].

    Raises:
        ActionError: the policy raised something, or returned no numbers, another shape or what is not finite.
    """
    with installation.blamed("the policy", ActionError):
        returned = policy(observations)
    try:
        actions = np.asarray(returned, dtype=np.float64)
    except (RuntimeError, TypeError, ValueError):  # such as of a tensor that requires a gradient
        raise ActionError(f"the policy returned no array of numbers, but {shown(returned)}") from None
    if actions.shape != (len(observations), width):
        raise ActionError(
            f"the policy returned actions of shape {actions.shape}, expected {(len(observations), width)}"
        )
    if not np.isfinite(actions).all():
        row = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
        raise ActionError(f"the policy returned an action that is not finite for row {row}: {actions[row].tolist()}")
    return np.clip(actions, -1.0, 1.0)


def act(policy: Policy, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the action of every agent of a `ParallelEnv` that a policy chooses from its flat observations.

    A policy with an attribute `agents` (their names in order) gets a row for each of them, 0 for those that have ended.

    Raises:
        ActionError: the observations are no vectors of one length by agent.
    """
    rows = [*observations.values()] if isinstance(observations, Mapping) else []
    if not rows or any(not isinstance(row, np.ndarray) or row.ndim != 1 or len(row) != len(rows[0]) for row in rows):
        raise ActionError(f"expected flat observations by agent, got {shown(observations)}")
    agents = list(getattr(policy, "agents", ()))
    names = agents if {*observations} <= {*agents} else list(observations)
    ended = np.zeros_like(rows[0])
    actions = policy(np.stack([observations.get(name, ended) for name in names]))
    return {name: action for name, action in zip(names, actions, strict=True) if name in observations}


def zero_policy(seed: int = 0, width: int = 2) -> Policy:
    """Return the policy of action zero: straight on, at half of the speed range (or without acceleration)."""
    return lambda observations: np.zeros((len(observations), width))


def random_policy(seed: int, width: int = 2) -> Policy:
    """Return a policy that draws every action uniformly from [-1, 1], the same ones for the same seed."""
    generator = np.random.default_rng(seed % 2**64)
    return lambda observations: generator.uniform(-1.0, 1.0, (len(observations), width))


def played_back(actions: np.ndarray) -> Policy:
    """Return the policy that takes actions, (decisions, rows, A), in turn, whatever is observed; then the last ones."""
    decisions = iter(actions)
    return lambda observations: next(decisions, actions[-1])


PLAIN: dict[str, Callable[[int, int], Policy]] = {"zero": zero_policy, "random": random_policy}
"""Policies by name, made from a seed and the length of an action."""
