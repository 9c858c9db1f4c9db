"""6x6 linear algebra in Warp against NumPy: well and badly scaled, clustered, rank deficient, both precisions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import ortho_group

from coopenv.estimation import linalg
from tests.helpers.warp_calls import DTYPES, EPSILON, Calls


@wp.func
def cholesky_factor(M: Any):
    """Return L and, in blocks, the inverses of its diagonal blocks."""
    A = linalg.block3(M, 0, 0)
    B = linalg.block3(M, 0, 3)
    L11, L21, L22, I11, I22 = linalg.cholesky6(A, B, linalg.block3(M, 3, 3))
    return linalg.join6(L11, type(L11)(), L21, L22), linalg.join6(I11, type(I11)(), type(I11)(), I22)


call = Calls(
    __name__,
    {linalg.eigen_symmetric6: "66 > 66 66", cholesky_factor: "66 > 66 66"},
    {linalg.smallest_eigenvalue6: "66 > 1"},
)
SPECTRA = {
    "random": np.random.default_rng(0).uniform(0.1, 10.0, (60, 6)),
    "badly_scaled": np.tile(np.logspace(-10, 0, 6), (40, 1)),
    "large": np.tile([1e6, 1e7, 1e8, 2e6, 3e7, 5e8], (20, 1)),
    "small": np.tile([1e-9, 2e-9, 3e-9, 1e-8, 2e-8, 3e-8], (20, 1)),
    "clustered": np.tile([1.0, 1.0 + 1e-9, 1.0 + 2e-9, 5.0, 5.0, 5.0 + 1e-12], (20, 1)),
    "twofold_smallest": np.tile([1e-3, 1e-3, 0.3, 1.0, 2.0, 2.0], (20, 1)),
    "sixfold": np.full((5, 6), 2.5),
    "rank_5": np.tile([0.0, 0.1, 0.7, 1.0, 2.0, 3.0], (20, 1)),
    "rank_3": np.tile([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], (20, 1)),
    "rank_1": np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (20, 1)),
    "zero": np.zeros((2, 6)),
}


def symmetric(spectrum: np.ndarray, seed: int = 1) -> np.ndarray:
    """Return U diag(spectrum) U^T (K, 6, 6) with random orthogonal U."""
    U = ortho_group.rvs(6, size=len(spectrum), random_state=seed)
    M = U @ (spectrum[..., None] * np.swapaxes(U, 1, 2))
    return (M + np.swapaxes(M, 1, 2)) / 2


def matrices(name: str, dtype: str) -> np.ndarray:
    """Return the matrices of a kind as the precision holds them."""
    return symmetric(SPECTRA[name]).astype(dtype).astype(float)


def size(M: np.ndarray) -> np.ndarray:
    return np.linalg.norm(M, axis=(1, 2))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", SPECTRA)
def test_eigenvalues_and_vectors(name: str, dtype: str) -> None:
    M = matrices(name, dtype)
    D, U = call(linalg.eigen_symmetric6, dtype, M)
    assert_allclose(np.swapaxes(U, 1, 2) @ U, np.broadcast_to(np.eye(6), U.shape), atol=30 * EPSILON[dtype])
    bound = 30 * EPSILON[dtype] * size(M)
    assert (size(U @ D @ np.swapaxes(U, 1, 2) - M) <= bound).all()
    diagonal = np.diagonal(D, axis1=1, axis2=2)
    assert (np.abs(np.sort(diagonal, axis=1) - np.linalg.eigvalsh(M)).max(axis=1) <= bound).all()
    assert (size(D - diagonal[:, None] * np.eye(6)) <= bound).all()


REPEATED = {
    "twofold": [1e-3, 1e-3, 0.3, 1.0, 2.0, 2.0],
    "threefold": [1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0],
    "three_pairs": [0.1, 0.1, 1.0, 1.0, 10.0, 10.0],
    "threefold_zero": [0.0, 0.0, 0.0, 1.0, 1.0, 3.0],
    "pairs_of_eight_decades": [1e-8, 1e-8, 1e-4, 1e-4, 1.0, 1.0],
    "pairs_of_both_signs": [-1.0, -1.0, 1.0, 1.0, 2.0, -2.0],
}


@pytest.mark.parametrize("name", REPEATED)
def test_repeated_eigenvalues_of_many_matrices(name: str) -> None:
    """20,000 matrices per spectrum; a solver that turns within a cluster for ever fails for 1 to 10 of 10,000."""
    rng = np.random.default_rng(1)
    U = np.linalg.qr(rng.normal(size=(20_000, 6, 6)))[0]
    M = U @ (np.array(REPEATED[name])[:, None] * np.swapaxes(U, 1, 2))
    M = (M + np.swapaxes(M, 1, 2)) / 2
    D, U = call(linalg.eigen_symmetric6, "float64", M)
    diagonal = np.diagonal(D, axis1=1, axis2=2)
    unit = EPSILON["float64"] * size(M)
    assert (size(D - diagonal[:, None] * np.eye(6)) <= 3 * unit).all()
    assert (size(U @ (diagonal[..., None] * np.swapaxes(U, 1, 2)) - M) <= 50 * unit).all()
    assert np.abs(np.swapaxes(U, 1, 2) @ U - np.eye(6)).max() <= 30 * EPSILON["float64"]
    assert (np.abs(np.sort(diagonal) - np.sort(REPEATED[name])).max(axis=1) <= 50 * unit).all()


def test_eigenvalues_of_matrices_with_zeros() -> None:
    """Diagonal, block diagonal and zero-diagonal matrices, where a rotation could divide by zero."""
    block = np.kron(np.diag([1.0, 0.0, 3.0]), np.array([[2.0, 1.0], [1.0, 2.0]]))
    swap = np.fliplr(np.eye(6))
    M = np.array([np.eye(6), np.diag([0.0, 0, 0, 4, 5, 6]), block, swap, np.diag([1e-40, 1, 1, 1, 1, 1e30])])
    D, _ = call(linalg.eigen_symmetric6, "float64", M)
    assert_allclose(np.sort(np.diagonal(D, axis1=1, axis2=2), axis=1), np.linalg.eigvalsh(M), atol=1e-15, rtol=1e-14)


@pytest.mark.parametrize("name", SPECTRA)
def test_smallest_eigenvalue(name: str) -> None:
    M = matrices(name, "float64")
    found = call(linalg.smallest_eigenvalue6, "float64", M)
    assert (found >= 0.0).all()
    expected = np.maximum(np.linalg.eigvalsh(M)[:, 0], 0.0)
    bound = 30 * EPSILON["float64"] * np.trace(M, axis1=1, axis2=2) + 2e-9 * expected  # where the iteration stops
    assert (np.abs(found - expected) <= bound).all()


def test_smallest_eigenvalue_is_accurate_to_ten_decades() -> None:
    spectrum = np.tile(np.logspace(-10, 0, 6), (200, 1))
    assert_allclose(call(linalg.smallest_eigenvalue6, "float64", symmetric(spectrum)), 1e-10, rtol=3e-5)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 9.0))
@settings(max_examples=60, deadline=None)
def test_smallest_eigenvalue_of_sums_of_squares(seed: int, decades: float) -> None:
    """Gramians are C^T C with rows of very different size."""
    rng = np.random.default_rng(seed)
    C = rng.normal(size=(20, 7, 6)) * 10.0 ** (-decades * rng.random((20, 7, 1)))
    M = np.swapaxes(C, 1, 2) @ C
    expected = np.linalg.eigvalsh(M)[:, 0]
    bound = 30 * EPSILON["float64"] * np.trace(M, axis1=1, axis2=2) + 2e-9 * np.abs(expected)
    assert (np.abs(call(linalg.smallest_eigenvalue6, "float64", M) - expected) <= bound).all()


DEFINITE = [name for name in SPECTRA if SPECTRA[name].min() > 0.0]


@pytest.mark.parametrize(
    ("name", "dtype"), [(n, d) for n in DEFINITE for d in DTYPES if (n, d) != ("badly_scaled", "float32")]
)
def test_cholesky(name: str, dtype: str) -> None:
    M = matrices(name, dtype)
    L, inverses = call(cholesky_factor, dtype, M)
    assert (np.triu(L, 1) == 0.0).all()
    assert (size(L @ np.swapaxes(L, 1, 2) - M) <= 20 * EPSILON[dtype] * size(M)).all()
    condition = np.linalg.cond(M)[:, None, None]
    reference = np.linalg.cholesky(M)
    assert (np.abs(L - reference) <= 20 * EPSILON[dtype] * condition * np.abs(reference).max()).all()
    for block in (slice(0, 3), slice(3, 6)):
        product = inverses[:, block, block] @ L[:, block, block]
        assert (np.abs(product - np.eye(3)) <= 20 * EPSILON[dtype] * np.sqrt(condition)).all()


def test_cholesky_of_a_covariance_in_mixed_units() -> None:
    """Angles of microradians beside positions of 100 m, strongly correlated."""
    scale = np.array([1e-6, 2e-6, 1e-6, 100.0, 50.0, 80.0])
    M = symmetric(SPECTRA["random"]) * scale[:, None] * scale
    L, _ = call(cholesky_factor, "float64", M)
    assert_allclose(L / scale[:, None], np.linalg.cholesky(M) / scale[:, None], rtol=1e-11, atol=1e-13)
