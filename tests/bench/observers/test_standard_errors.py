"""Standard errors of root means and their ratios, against many repetitions of the same experiment."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.bench.observers.rows import UNKNOWN, mean_root, ratio

EXPERIMENTS, SEEDS, VEHICLES = 2000, 40, 3


def squares(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return (E, S, N) mean squares of an observer and of a worse one, which shares most of its errors."""
    common = generator.gamma(6.0, 1.0, (EXPERIMENTS, SEEDS, 1)) * np.array([1.0, 2.0, 5.0])
    own, other = (common * generator.gamma(30.0, 1 / 30.0, (EXPERIMENTS, SEEDS, VEHICLES)) for _ in range(2))
    return own, 4.0 * other


def test_standard_errors_are_the_spread_of_repetitions() -> None:
    one, two = squares(np.random.default_rng(0))
    roots = [mean_root(s) for s in one]
    assert np.mean([r.error for r in roots]) == pytest.approx(np.std([r.value for r in roots]), rel=0.06)
    ratios = [ratio(b, a) for a, b in zip(one, two, strict=True)]
    assert np.mean([r.value for r in ratios]) == pytest.approx(2.0, rel=0.01)
    assert np.mean([r.error for r in ratios]) == pytest.approx(np.std([r.value for r in ratios]), rel=0.06)
    unpaired = np.hypot(roots[0].error / roots[0].value, mean_root(two[0]).error / mean_root(two[0]).value) * 2.0
    assert ratios[0].error < 0.6 * unpaired  # what both share cancels


def test_values() -> None:
    found = mean_root(np.array([[1.0, 4.0], [9.0, 16.0]]))
    assert found.value == pytest.approx((np.sqrt(5.0) + np.sqrt(10.0)) / 2)
    assert mean_root(np.array([[9.0]])).value == 3.0 and np.isnan(mean_root(np.array([[9.0]])).error)
    same = np.array([[1.0], [2.0]])
    assert ratio(same, same) == (1.0, 0.0)
    assert mean_root(np.zeros((3, 2))) == (0.0, 0.0)
    assert ratio(same, 0.0 * same) is UNKNOWN and ratio(same, np.nan * same) is UNKNOWN
