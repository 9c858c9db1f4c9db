"""The comparison of rewards."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.reward import compared


def test_the_difference_of_two_arms_is_between_its_ends() -> None:
    world = np.repeat(np.arange(6), 10)
    arms = [[(level * (1.0 + 0.1 * np.sin(world + seed)), world) for seed in range(3)] for level in (0.1, 0.4)]
    values, low, high = compared(arms, 6, 0.95)
    assert values[0] == pytest.approx(0.11, abs=0.01) and values[2] == pytest.approx(-0.75)
    assert (low <= values).all() and (values <= high).all() and high[2] < -0.7
