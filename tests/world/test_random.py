"""Philox in the kernels: known answers, distributions, and streams that do not repeat one another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy import stats

from coopenv.world import random
from tests.helpers.warp_calls import DTYPES, Calls
from tests.oracles import philox

LARGEST = 2**32 - 1
call = Calls(
    __name__,
    {random.uniform: "u 1 > 1"},
    {
        random.philox: "u4 u u > u4",
        random.random_words: "U u i i u > u4",
        random.gaussian_pair: "u u 1 > 1 1",
        random.unit_vector: "u u 3 > 3",
    },
)
ONE = [1.0]


def draws(counters: ArrayLike, keys: ArrayLike) -> np.ndarray:
    key0, key1 = np.asarray(keys, np.uint32).T
    return call(random.philox, "float64", np.asarray(counters, np.uint32), key0, key1)


def gaussian_pairs(dtype: str, words: np.ndarray) -> np.ndarray:
    return np.column_stack(call(random.gaussian_pair, dtype, *words.astype(np.uint32).T, ONE))


def test_known_answers() -> None:
    counters, keys, expected = zip(*philox.KNOWN_ANSWERS, strict=True)
    np.testing.assert_array_equal(draws(counters, keys), np.array(expected, dtype=np.uint32))


def test_random_counters() -> None:
    rng = np.random.default_rng(0)
    counters = rng.integers(0, 2**32, (2000, 4), dtype=np.uint64)
    keys = rng.integers(0, 2**32, (2000, 2), dtype=np.uint64)
    np.testing.assert_array_equal(draws(counters, keys), philox.philox4x32_array(counters, keys))


def test_draw_packs_what_it_depends_on() -> None:
    seed = np.array([0, 5, 2**63 + 12345, 2**64 - 1], dtype=np.uint64)
    episode, index = np.array([0, 1, 7, LARGEST]), np.array([0, 1, 36000, 2**31 - 1])
    subject, stream = np.array([0, 3, 65536 * 4 + 7, 1]), np.array([1, 2, 3, 7])
    given = ((episode, "u4"), (index, "i4"), (subject, "i4"), (stream, "u4"))
    counters = np.column_stack([index, subject, stream, episode])
    keys = np.column_stack([seed & np.uint64(LARGEST), seed >> np.uint64(32)])
    np.testing.assert_array_equal(
        call(random.random_words, "float64", seed, *(x.astype(t) for x, t in given)),
        philox.philox4x32_array(counters, keys),
    )


def words(count: int, columns: int = 4) -> np.ndarray:
    """Return consecutive draws of one stream, as the world takes them tick by tick."""
    counters = np.zeros((count, 4), dtype=np.uint64)
    counters[:, 0], counters[:, 2] = np.arange(count), 6
    return philox.philox4x32_array(counters, np.array([11, 0]))[:, :columns]


@pytest.mark.parametrize("dtype", DTYPES)
def test_uniform_stays_inside_the_open_interval(dtype: str) -> None:
    edges = np.array([0, 1, 2, 2**31, LARGEST - 200, LARGEST - 128, LARGEST - 1, LARGEST])
    u = call(random.uniform, dtype, edges.astype(np.uint32), ONE)
    assert (u > 0.0).all()
    assert (u < 1.0).all()


def test_uniform_is_uniform() -> None:
    u = call(random.uniform, "float64", words(50000).ravel().astype(np.uint32), ONE)
    assert stats.kstest(u, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 0.01


def test_gaussian_pairs_are_independent_standard_normals() -> None:
    pairs = gaussian_pairs("float64", words(100000, 2))
    for column in pairs.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
        assert abs(stats.kurtosis(column)) < 0.05
    x, y = pairs.T
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.013
    assert abs(np.corrcoef(x**2, y**2)[0, 1]) < 0.013
    assert stats.kstest(np.arctan2(y, x) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert np.abs(pairs).max() > 4.0


def test_gaussian_is_finite_at_the_extremes() -> None:
    ends = np.array([[a, b] for a in (0, 1, LARGEST - 1, LARGEST) for b in (0, 1, 2, 3, LARGEST)])
    assert np.isfinite(gaussian_pairs("float64", ends)).all()


def test_directions_are_uniform_on_the_sphere() -> None:
    u = call(random.unit_vector, "float64", *words(50000, 2).T.astype(np.uint32), np.zeros((1, 3)))
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, atol=1e-6)
    for axis in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, 0.8]):  # Archimedes: each height is uniform
        assert stats.kstest((u @ axis + 1) / 2, "uniform").pvalue > 1e-3
    np.testing.assert_allclose(u.T @ u / len(u), np.eye(3) / 3, atol=0.01)
