"""Belief propagation against the smoother: exact on trees, exact means in graphs with loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coopenv.observers import Recording, Run, Tick, belief_propagation, run
from coopenv.observers.belief_propagation import BeliefPropagation
from tests.oracles.batch import assert_same_covariance, small_record


class Converged(BeliefPropagation):
    """Passes messages through all frames until convergence."""

    def correct(self, ticks: list[Tick]) -> np.ndarray:
        super().correct(ticks)
        for _ in range(8):
            L, _ = self.propagate(0, 4)
        return np.linalg.inv(L[-1])


def deviation(result: Run, exact: Run) -> float:
    """Return the largest deviation of last positions in standard deviations of the exact solution."""
    assert not result.failure
    std = np.sqrt(np.diagonal(exact.covariance[-1], axis1=1, axis2=2)[:, 3:])
    return float(np.abs((result.position[-1] - exact.position[-1]) / std).max())


def tree(made: Recording) -> Recording:
    """Return a recording in which every vehicle measures landmarks, and one vehicle at the last frame alone."""
    L, visible = made.landmarks.shape[1], made.visible.copy()
    visible[:-1, :, L:] = False
    for i in range(visible.shape[1]):
        seen = np.flatnonzero(visible[-1, i])
        visible[-1, i, seen[seen >= L][1:]] = False
    assert visible[-1, :, L:].sum() >= 2
    return replace(made, visible=visible)


def test_on_a_tree_beliefs_are_the_exact_marginals() -> None:
    made = tree(small_record(4))
    exact, result = run("smoother", made), run(Converged, made)
    assert deviation(result, exact) < 1e-3
    assert_same_covariance(result.covariance[-1], exact.covariance[-1])
    assert deviation(run("belief_propagation", made), exact) < 0.02


def test_with_loops_means_are_those_of_least_squares_and_covariances_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(belief_propagation, "STEP_PERIOD", 1e-3)
    made = small_record(5)
    exact, result = run("smoother", made), run(Converged, made)
    assert deviation(result, exact) < 2e-3
    ratio = np.linalg.det(result.covariance[-1]) / np.linalg.det(exact.covariance[-1])
    assert (ratio < 1.0 + 1e-6).all() and ratio.min() < 0.9


def test_messages_are_counted() -> None:
    made = small_record(2)
    L = made.landmarks.shape[1]
    blind = replace(made, visible=made.visible & (np.arange(made.visible.shape[2]) < L))
    alone, together = (run("belief_propagation", m).bytes_per_second for m in (blind, made))
    assert (alone == 56 * 60.0).all()
    assert (together > alone).all()
