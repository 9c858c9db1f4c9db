"""Policies that look at nothing: the neutral action, and random ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coopenv.policies.base import Policy


def zero_policy(seed: int = 0) -> Policy:
    """Return the policy of action zero: straight on, at half of the speed range (or without acceleration)."""
    return lambda observations: np.zeros((len(observations), 2))


def random_policy(seed: int) -> Policy:
    """Return a policy that draws every action uniformly from [-1, 1], the same ones for the same seed."""
    generator = np.random.default_rng(seed % 2**64)
    return lambda observations: generator.uniform(-1.0, 1.0, (len(observations), 2))


PLAIN: dict[str, Callable[[int], Policy]] = {"zero": zero_policy, "random": random_policy}
