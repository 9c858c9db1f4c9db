"""Linear algebra in kernels and in compiled functions of the host."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import ortho_group

from coopenv.estimation import compiled, linalg
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


def test_smallest_eigenvalue_of_matrices_that_rounding_has_made_indefinite() -> None:
    """Of rank two, with some eigenvalues a little below 0: an even number of them leaves the determinant positive."""
    rng = np.random.default_rng(5)
    C, noise = rng.normal(size=(4000, 2, 6)), 2e-7 * rng.normal(size=(4000, 6, 6))
    M = np.swapaxes(C, 1, 2) @ C
    M += (noise + np.swapaxes(noise, 1, 2)) * np.trace(M, axis1=1, axis2=2)[:, None, None]
    assert (np.abs(call(linalg.smallest_eigenvalue6, "float64", M)) <= 1e-6 * np.trace(M, axis1=1, axis2=2)).all()


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


LAYOUTS = {
    "rows first": np.ascontiguousarray,
    "columns first": np.asfortranarray,
    "strided": lambda A: np.repeat(np.repeat(A, 2, axis=0), 3, axis=1)[::2, ::3],
    "read-only": lambda A: np.lib.stride_tricks.as_strided(A.copy(), A.shape, writeable=False),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_products_and_equations(layout: str) -> None:
    rng = np.random.default_rng(0)
    A, B, S = (LAYOUTS[layout](rng.normal(size=shape)) for shape in ((4, 5), (5, 3), (5, 5)))
    assert_allclose(compiled.product(A, B), A @ B, atol=1e-14)
    assert_allclose(compiled.transformed(A, B[:, 1]), A @ B[:, 1], atol=1e-14)
    assert_allclose(compiled.congruent(A, S), A @ S @ A.T, atol=1e-13)
    before = S.copy()
    assert_allclose(S @ compiled.eliminated(S, B), B, atol=1e-12)
    assert_allclose(S, before, atol=0.0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.floats(0.0, 6.0))
def test_elimination_is_as_good_as_lapack(seed: int, size: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-scale, scale, (size, 1))
    x = rng.normal(size=(size, 2))
    b = A @ x
    mine, lapack = (np.abs(A @ found - b).max() for found in (compiled.eliminated(A, b), np.linalg.solve(A, b)))
    assert mine <= 100.0 * lapack + 1e-13 * np.abs(A).max() * np.abs(x).max()


def test_a_pivot_that_is_zero_is_not_the_end() -> None:
    A = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert_allclose(compiled.eliminated(A, np.eye(2)), A)


@pytest.mark.parametrize("A", [np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 4.0]])])
def test_a_singular_matrix(A: np.ndarray) -> None:
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        compiled.eliminated(A, np.eye(2))


def test_division_by_zero_is_as_in_numpy() -> None:
    @compiled.compiled(compiled.NUMBER)
    def inverse(x: float) -> float:
        return 1.0 / x

    assert inverse(0.0) == np.inf and inverse(4.0) == 0.25


def test_without_a_folder_to_write_to_functions_are_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> object:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*arguments, **options)

    njit = compiled.njit
    monkeypatch.setattr(compiled, "njit", refuse)

    @compiled.compiled(compiled.NUMBER)
    def double(x: float) -> float:
        return 2.0 * x

    assert double(2.0) == 4.0


def output(program: str, **environment: str) -> list[str]:
    """Return the words that a program prints."""
    command, merged = [sys.executable, "-c", program], {**os.environ, **environment}
    done = subprocess.run(command, env=merged, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def test_a_change_of_what_a_function_uses_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba looks at the function's own file only."""
    room = tmp_path / "package" / "estimation"
    room.mkdir(parents=True)
    decorator = Path(compiled.__file__).read_text().partition("@compiled(")[0]
    (room / "compiled.py").write_text(decorator)
    head = "from package.estimation.compiled import NUMBER, compiled\n"
    inner = head + "LIMIT = {}.0\n@compiled(NUMBER)\ndef f(x):\n    return x + LIMIT\n"
    (room / "outer.py").write_text(
        head + "from package.estimation.inner import f\n@compiled(NUMBER)\ndef g(x):\n    return 2.0 * f(x)\n"
    )
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    for limit in (1, None, 100):
        if limit is not None:
            (room / "inner.py").write_text(inner.format(limit))
        outer = import_module("package.estimation.outer")
        found.append((outer.g(1.0), len(sys.modules["package.estimation.compiled"].fresh)))
        for name in [name for name in sys.modules if name.partition(".")[0] == "package"]:
            del sys.modules[name]  # as a process that begins
    assert found == [(4.0, 2), (4.0, 0), (202.0, 2)]
    assert len(list((tmp_path / "package" / "__pycache__").glob("compiled-*"))) == 1


def test_damaged_machine_code_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "code_folder", lambda: tmp_path)
    for times in (1, 2):

        @compiled.compiled(compiled.NUMBER)
        def doubled(x: float) -> float:
            return 2.0 * x

        assert doubled(2.0) == 4.0 and compiled.fresh[-times:] == times * ["doubled"]
        kept = [path for path in tmp_path.rglob("*.nb?") if path.is_file()]
        assert kept
        for path in kept:
            path.write_bytes(path.read_bytes()[:20])


def test_one_process_compiles_and_none_waits_for_cached_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    locked: list[Path] = []
    monkeypatch.setattr(compiled, "code_folder", lambda: tmp_path)
    monkeypatch.setattr(compiled, "lock", lambda folder, wait: locked.append(folder))
    for _ in range(2):

        @compiled.compiled(compiled.NUMBER)
        def halved(x: float) -> float:
            return 0.5 * x

        assert halved(2.0) == 1.0 and locked == [tmp_path]


def test_functions_run_as_python_where_compilation_is_off() -> None:
    show = "from coopenv.observers.linearisation import across; print(across(0.0, 0.0, 1.0)[0])"
    assert output(show, NUMBA_DISABLE_JIT="1") == ["[", "1.", "-0.", "-0.]"]
