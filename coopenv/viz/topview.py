"""Top view (placeholder while being built)."""

from __future__ import annotations

from typing import Any

import numpy as np


class TopView:
    """Draws one world from above."""

    def __init__(self, scenario: Any) -> None:
        self.scenario = scenario

    def draw(self, engine: Any) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of world 0."""
        return np.zeros((8, 8, 3), dtype=np.uint8)

    def show(self, picture: np.ndarray) -> None:
        """Show a picture in a window."""

    def close(self) -> None:
        """Close the window."""
