"""What a driver is."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Policy(Protocol):
    """Maps what one vehicle observes to its action; the same object drives all vehicles."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, (2,) in [-1, 1], for one flat observation, (D,)."""
        ...
