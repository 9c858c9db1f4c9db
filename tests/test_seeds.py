"""Seeds of worlds: keys, training and evaluation, batches and single worlds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.base.seeds import training_seed, world_keys

NAME = "urban_crossing"
WORD = 2**32


@given(
    a=st.tuples(st.integers(0, WORD - 1), st.integers(0, WORD - 1)),
    b=st.tuples(st.integers(0, WORD - 1), st.integers(0, WORD - 1)),
)
def test_a_key_is_that_of_one_seed_and_world(a: tuple[int, int], b: tuple[int, int]) -> None:
    keys = [world_keys(seed, 1, world)[0] for seed, world in (a, b)]
    assert (keys[0] == keys[1]) == (a == b)
    assert keys[0] < 2**64
    assert (keys[0] >> 31) % 2 == (a[0] in coopenv.EVALUATION_SEEDS)


@given(st.integers(WORD, 2**200))
def test_larger_seeds_are_for_training(seed: int) -> None:
    (key,) = world_keys(seed)
    assert key not in coopenv.EVALUATION_SEEDS
    assert key < 2**31
    assert world_keys(seed, 3) == [key, key + WORD, key + 2 * WORD]


def test_larger_seeds_differ() -> None:
    assert len({world_keys(WORD + k)[0] for k in range(1000)}) == 1000


def test_evaluation_seeds() -> None:
    assert [coopenv.evaluation_seed(k) for k in (0, 1, 2**31 - 1)] == [2**31, 2**31 + 1, 2**32 - 1]
    for wrong in (-1, 2**31, 1.0, None):
        with pytest.raises(CoopenvError, match="seed"):
            coopenv.evaluation_seed(wrong)  # type: ignore[arg-type]


def test_batches_of_different_seeds_have_no_world_in_common() -> None:
    env = coopenv.make_vec(NAME, num_worlds=32)
    drawn = [env.world_major(env.reset(seed=seed)[0]).reshape(32, -1) for seed in (*range(6), WORD - 1)]
    assert len(np.unique(np.concatenate(drawn), axis=0)) == 7 * 32


@pytest.fixture(scope="module")
def single() -> Any:
    return coopenv.parallel_env(NAME)


def first(env: Any, **arguments: Any) -> np.ndarray:
    return np.stack(list(env.reset(**arguments)[0].values()))


def present(batch: Any, observations: np.ndarray) -> list[np.ndarray]:
    """Return the observations by world of the vehicles that are there."""
    there = batch.engine.view("alive")
    return [rows[alive] for rows, alive in zip(batch.world_major(observations), there, strict=True)]


def test_a_world_of_a_batch_alone(single: Any) -> None:
    batch = coopenv.make_vec(NAME, num_worlds=3)
    rows = present(batch, batch.reset(seed=7)[0])
    for world in range(3):
        np.testing.assert_array_equal(first(single, seed=7, options={"world": world}), rows[world])
    np.testing.assert_array_equal(first(single, seed=7), rows[0])


def test_a_sequence_of_seeds_is_of_single_worlds_and_none_goes_on(single: Any) -> None:
    batch = coopenv.make_vec(NAME, num_worlds=3)
    rows = present(batch, batch.reset(seed=[5, None, 9])[0])
    np.testing.assert_array_equal(first(single, seed=5), rows[0])
    np.testing.assert_array_equal(first(single, seed=9), rows[2])
    keys = batch.engine.view("seed").copy()
    assert keys[1] % WORD < 2**31
    again = present(batch, batch.reset(seed=[None, 4, 9])[0])
    assert batch.engine.view("seed").tolist() == [5, 4, 9]
    first(single, seed=5)
    np.testing.assert_array_equal(first(single), again[0])
    np.testing.assert_array_equal(first(single, seed=4), again[1])
    np.testing.assert_array_equal(again[2], rows[2])


def test_without_a_seed_worlds_are_for_training() -> None:
    assert all(training_seed() < 2**31 for _ in range(100))
    env = coopenv.make_vec(NAME, num_worlds=4)
    env.reset()
    keys = env.engine.view("seed")
    assert len({int(key) % WORD for key in keys}) == 1
    assert int(keys[0]) < 2**31


@pytest.mark.parametrize("world", [-1, WORD, 1.0, "2", True])
def test_wrong_worlds(single: Any, world: Any) -> None:
    with pytest.raises(CoopenvError, match="option 'world' must be a whole number"):
        single.reset(seed=0, options={"world": world})
