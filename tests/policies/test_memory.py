"""The memory of a learned policy, beside the equations of a gated recurrent unit, number by number."""

from __future__ import annotations

import math

import numpy as np
import pytest

from coopenv.policies.memory import MEMORY, PARTS, Memory

READS, WIDTH = 3, 2


def tensors(seed: int = 0) -> dict[str, np.ndarray]:
    shapes = ((3 * WIDTH, READS), (3 * WIDTH, WIDTH), (3 * WIDTH,), (3 * WIDTH,))
    draw = np.random.default_rng(seed).standard_normal
    return {f"{MEMORY}{part}": draw(shape).astype(np.float32) for part, shape in zip(PARTS, shapes, strict=True)}


def by_the_book(own: dict[str, np.ndarray], seen: list[float], state: list[float]) -> list[float]:
    """Return the next state of one row (Cho et al. 2014, with the reset gate behind the product, as torch has it)."""
    read, keep, bias, kept_bias = (own[f"{MEMORY}{part}"].tolist() for part in PARTS)

    def reads(i: int) -> float:
        return math.fsum([bias[i], *(w * x for w, x in zip(read[i], seen, strict=True))])

    def keeps(i: int) -> float:
        return math.fsum([kept_bias[i], *(w * h for w, h in zip(keep[i], state, strict=True))])

    found = []
    for i in range(WIDTH):
        reset, update = (1.0 / (1.0 + math.exp(-reads(j) - keeps(j))) for j in (i, WIDTH + i))
        new = math.tanh(reads(2 * WIDTH + i) + reset * keeps(2 * WIDTH + i))
        found.append((1.0 - update) * new + update * state[i])
    return found


def test_states_are_those_of_the_equations_in_every_row() -> None:
    own, memory = tensors(), Memory(tensors())
    rows = np.random.default_rng(1).standard_normal((5, 4, READS)).astype(np.float32)
    states = [[0.0] * WIDTH for _ in range(4)]
    for t, seen in enumerate(rows):
        if t == 3:
            memory.reset(np.array([False, True, False, False]))
            states[1] = [0.0] * WIDTH
        beside = memory(seen)
        states = [by_the_book(own, row.tolist(), state) for row, state in zip(seen, states, strict=True)]
        assert np.array_equal(beside[:, :READS], seen)
        assert beside[:, READS:] == pytest.approx(np.array(states), abs=1e-6)


def test_other_rows_begin_with_nothing_remembered() -> None:
    memory, seen = Memory(tensors()), np.ones((3, READS), dtype=np.float32)
    first = memory(seen)
    assert not np.allclose(memory(seen), first), "it has seen them before"
    assert memory(seen[:2]) == pytest.approx(first[:2]), "two rows are not the three of before"
