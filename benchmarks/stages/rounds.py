"""Alternating rounds: medians, and how far they can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np


def alternate(steps: Sequence[Callable[[], float]], rounds: int) -> np.ndarray:
    """Return (rounds, n): what each step returned in each round, one after the other."""
    return np.array([[step() for step in steps] for _ in range(rounds)])


def ratio(above: np.ndarray, below: np.ndarray) -> tuple[float, float, float]:
    """Return the ratio of the medians, and the lowest and highest ratio of the middle half of the rounds."""
    low, high = np.quantile(above / below, (0.25, 0.75))
    return float(np.median(above) / np.median(below)), float(low), float(high)
