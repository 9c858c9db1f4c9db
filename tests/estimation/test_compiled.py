"""Compiled functions against NumPy and SciPy, for arrays of any layout."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from coopenv.estimation import compiled

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
    show = "from package.estimation import outer, compiled; print(outer.g(1.0), len(compiled.fresh))"
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    path = os.pathsep.join([str(tmp_path), str(compiled.PACKAGE.parent)])
    said = []
    for limit in (1, None, 100):
        if limit is not None:
            (room / "inner.py").write_text(inner.format(limit))
        said.append(output(show, PYTHONPATH=path))
    assert said == [["4.0", "2"], ["4.0", "0"], ["202.0", "2"]]
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


def test_one_process_compiles_and_none_waits_for_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    locked: list[Path] = []
    monkeypatch.setattr(compiled, "code_folder", lambda: tmp_path)
    monkeypatch.setattr(compiled, "lock", lambda folder, wait: locked.append(folder))
    for _ in range(2):

        @compiled.compiled(compiled.NUMBER)
        def halved(x: float) -> float:
            return 0.5 * x

        assert halved(2.0) == 1.0 and locked == [tmp_path]


def test_functions_run_as_python_where_compilation_is_off() -> None:
    show = "from coopenv.observers.bearing_measurements import across; print(across(0.0, 0.0, 1.0)[0])"
    assert output(show, NUMBA_DISABLE_JIT="1") == ["[", "1.", "-0.", "-0.]"]
