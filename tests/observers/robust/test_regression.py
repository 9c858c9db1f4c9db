"""By how much a sender is vaguer than it says, where what is told of it contradicts what is believed."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from scipy.linalg import eigh

from coopenv.observers.robust.constants import LEAST_LEFT
from coopenv.observers.robust.correlations import excess
from coopenv.observers.robust.memory import mat66d
from coopenv.world.launch import start_warp

start_warp()


@wp.kernel(enable_backward=False, module_options={"max_unroll": 1}, module="unique")
def excess_kernel(left: wp.array(dtype=mat66d), after: wp.array(dtype=mat66d), more: wp.array(dtype=mat66d)):
    n = wp.tid()
    more[n] = excess(left[n], after[n])


def drawn(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return covariances (count, 6, 6) of poses: rad and m."""
    A = rng.normal(size=(count, 6, 6)) * np.repeat([0.01, 0.3], 3)[:, None]
    return A @ np.swapaxes(A, 1, 2) + 1e-8 * np.eye(6)


@pytest.fixture(scope="module")
def case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what is left over of covariances, these, and by how much they are to be larger."""
    rng = np.random.default_rng(0)
    after = drawn(rng, 100)
    A = np.linalg.cholesky(after)
    axes = np.linalg.qr(rng.normal(size=(100, 6, 6)))[0]
    values = rng.uniform(-1.0, 1.0, (100, 6))
    values[:20] = rng.uniform(2.0 * LEAST_LEFT, 1.0, (20, 6))  # nothing contradicts
    B = A @ axes
    left = (B * values[:, None]) @ np.swapaxes(B, 1, 2)
    arrays = [wp.array(x, dtype=mat66d, device="cpu") for x in (left, after)]
    more = wp.zeros(100, dtype=mat66d, device="cpu")
    wp.launch(excess_kernel, dim=100, inputs=arrays, outputs=[more], device="cpu")
    return left, after, more.numpy()


def test_nothing_is_added_where_nothing_contradicts(case: tuple[np.ndarray, ...]) -> None:
    assert (case[2][:20] == 0.0).all()
    assert (np.abs(case[2][20:]).max(axis=(1, 2)) > 0.0).all()


def test_a_share_is_left_over_in_all_directions_and_no_more_is_added(case: tuple[np.ndarray, ...]) -> None:
    """With those directions in which both are diagonal: what was less than the share is the share, the rest stays."""
    for left, after, more in zip(*case, strict=True):
        before, axes = eigh(left, after)
        now = axes.T @ (left + more) @ axes
        assert_allclose(now, np.diag(np.maximum(before, LEAST_LEFT)), atol=1e-9)
