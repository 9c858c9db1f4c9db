"""What a policy is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np


class Policy(Protocol):
    """Maps what vehicles observe to their actions; a function, or an object that can be called."""

    def __call__(self, observations: np.ndarray, /) -> np.ndarray:
        """Return the actions, (N, 2) in [-1, 1], for flat observations, (N, D), one row per vehicle."""
        ...


def act(policy: Policy, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the action of every agent of a `ParallelEnv` that a policy chooses from its flat observations."""
    actions = policy(np.stack(list(observations.values())))
    return dict(zip(observations, actions, strict=True))
