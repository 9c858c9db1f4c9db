"""The bootstrap over worlds agrees with resampling done by hand, and its intervals hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.evaluation.metrics import Quantile, Ratio, interval, resamples

WORLDS = 12


def sample(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return values and their worlds: as many as they like, around a level of each world's own."""
    rng = np.random.default_rng(seed)
    world = rng.integers(0, WORLDS, 9000)
    return np.exp(rng.normal(size=9000) + 0.5 * rng.normal(size=WORLDS)[world]), world


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_quantiles_of_resampled_worlds(share: float) -> None:
    values, world = sample()
    counts = resamples(WORLDS, 3, count=50)
    by_hand = [np.quantile(np.repeat(values, row[world].astype(int)), share) for row in counts]
    found = Quantile(values, world, WORLDS, share)
    assert found.value == np.quantile(values, share)
    np.testing.assert_allclose(found.resampled(counts), by_hand, rtol=0.02)


def test_means_and_root_mean_squares_of_resampled_worlds() -> None:
    values, world = sample()
    counts = resamples(WORLDS, 3, count=50)
    total, squares, number = (np.bincount(world, w, WORLDS) for w in (values, values**2, np.ones(9000)))
    repeated = [np.repeat(values, row[world].astype(int)) for row in counts]
    np.testing.assert_allclose(Ratio(total, number).resampled(counts), [v.mean() for v in repeated])
    rms = Ratio(squares, number, root=True)
    np.testing.assert_allclose(rms.resampled(counts), [np.sqrt((v**2).mean()) for v in repeated])
    assert rms.value == pytest.approx(np.sqrt((values**2).mean()))


def test_values_that_are_all_the_same_and_none_at_all() -> None:
    counts = resamples(3, 0, count=20)
    same = Quantile(np.full(9, 2.5), np.repeat(np.arange(3), 3), 3, 0.95)
    assert same.value == 2.5 and (same.resampled(counts) == 2.5).all() and same.worlds == 3
    none = Quantile(np.empty(0), np.empty(0, dtype=int), 3, 0.5)
    assert np.isnan(none.value) and np.isnan(none.resampled(counts)).all() and none.worlds == 0
    assert np.isnan(interval(none.resampled(counts))).all()
    one = Quantile(np.array([1.0]), np.array([1]), 3, 0.5)
    assert one.worlds == 1
    np.testing.assert_array_equal(np.isnan(one.resampled(counts)), counts[:, 1] == 0)


def test_resamples_are_of_as_many_worlds_and_repeatable() -> None:
    counts = resamples(WORLDS, 5, count=400)
    assert (counts.sum(axis=1) == WORLDS).all() and counts.mean(axis=0) == pytest.approx(np.ones(WORLDS), abs=0.2)
    np.testing.assert_array_equal(counts, resamples(WORLDS, 5, count=400))
    assert (counts != resamples(WORLDS, 6, count=400)).any()


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    """Means of 40 worlds with levels of their own: 95 % intervals, 300 experiments."""
    rng, held = np.random.default_rng(1), 0
    counts = resamples(40, 0, count=400)
    for _ in range(300):
        level = rng.normal(size=40)
        values = level + 0.1 * rng.normal(size=(25, 40))
        low, high = interval(Ratio(values.sum(axis=0), np.full(40, 25.0)).resampled(counts))
        held += low <= 0.0 <= high
    assert 0.89 <= held / 300 <= 0.99
