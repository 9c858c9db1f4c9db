"""Functions of a few small arrays, compiled by Numba: in NumPy every operation takes a microsecond at any size.

Each function is compiled for one type per argument, which admits any memory layout. Compilation happens when the module
is first loaded on a machine, once: other processes wait for it. As in C, the shapes of the arguments are not checked.

Numba caches machine code per function and invalidates it when the function's own file changes. Changes of functions and
constants in other files go unnoticed. The cache folder is therefore named by a digest of all these sources.

LLVM optimises at level 1: level 3 takes 1.6 times as long, and the observers are no faster.

Small matrices are multiplied and eliminated by loops: up to about ten rows BLAS takes longer. LAPACK by way of Numba is
no slower, but takes seconds to compile in every function that uses it.
"""

import math
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryFile
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import njit, types

from coopenv.base.files import lock
from coopenv.estimation import poses
from coopenv.estimation.poses import Array

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])

VECTOR, MATRIX, MATRICES = (types.Array(types.float64, n, "A", readonly=True) for n in (1, 2, 3))
"""Arguments that are arrays of float64 of so many axes, of any layout; they are not written to."""
ROW, TARGET = (types.Array(types.float64, n, "C") for n in (1, 2))
"""New arrays, which are written to."""
NUMBER, WHOLE, FLAG = types.float64, types.int64, types.boolean

PACKAGE = Path(__file__).parents[1]
ROOMS = ("estimation", "observers")  # packages of compiled functions and of their parts
LONGEST_COMPILATION = 120.0  # s of all functions; a process that holds the lock for longer is taken for suspended
_BEGINNING = "compiled-"  # of the folders' names

fresh: list[str] = []
"""Functions that this process has compiled, and not found in the cache."""


def compiled(*arguments: Any) -> Callable[[F], F]:
    """Return a decorator that compiles a function for arguments of these types; division by zero is as in NumPy."""

    def decorator(function: F) -> F:
        made = _made(function, arguments, code_folder())
        if getattr(getattr(made, "stats", None), "cache_misses", None):
            fresh.append(function.__name__)
        return cast(F, made)

    return decorator


def _made(function: Any, arguments: tuple[Any, ...], folder: Path | None) -> Any:
    compile_by = partial(njit, arguments, error_model="numpy")
    before, held = (config.CACHE_DIR, config.OPT), None
    config.OPT = type(config.OPT)(1)
    try:
        if folder is not None:
            config.CACHE_DIR = str(folder)
            held = None if _kept(function, folder) else lock(folder, LONGEST_COMPILATION)
            with suppress(Exception):  # the cache is damaged, or the disk is full; an error of the function returns
                return compile_by(cache=True)(function)
        return compile_by()(function)
    finally:
        config.CACHE_DIR, config.OPT = before
        if held is not None:
            os.close(held)


def _kept(function: Any, folder: Path) -> bool:
    """Return whether there is machine code of a function."""
    return any(folder.glob(f"*/*.{function.__name__}-{function.__code__.co_firstlineno}.*.nbi"))


@cache
def code_folder() -> Path | None:
    """Return the folder of the machine code of the present sources; None if no folder is writable.

    That is beside the package, else in the user's cache; in NUMBA_CACHE_DIR if that is set.
    """
    name = _BEGINNING + _digest()
    kept, user = PACKAGE / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    for place in [Path(chosen)] if chosen else [kept, user / "coopenv"]:
        folder = place / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=folder):
                pass
        except OSError:
            continue
        if place == kept:
            for old in place.glob(f"{_BEGINNING}*"):
                if old != folder:
                    rmtree(old, ignore_errors=True)
        return folder
    return None


def _digest() -> str:
    """Return a digest of all sources that may be in compiled functions."""
    digest = sha256()
    for path in sorted(path for room in ROOMS for path in (PACKAGE / room).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@compiled(TARGET, WHOLE, WHOLE, MATRIX)
def place(M: Array, row: int, column: int, block: Array) -> None:
    """Write a block into a matrix: Numba takes long to compile assignments to slices."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + i, column + j] = block[i, j]


@compiled(MATRIX, MATRIX)
def product(A: Array, B: Array) -> Array:
    """Return A B (n, k) of A (n, m) and B (m, k)."""
    (n, m), k = A.shape, B.shape[1]
    C = np.zeros((n, k))
    for i in range(n):
        for j in range(m):
            for l in range(k):  # noqa: E741
                C[i, l] += A[i, j] * B[j, l]
    return C


@compiled(MATRIX, VECTOR)
def transformed(A: Array, x: Array) -> Array:
    """Return A x (n,) of A (n, m) and x (m,)."""
    y = np.zeros(len(A))
    for i in range(len(A)):
        for j in range(len(x)):
            y[i] += A[i, j] * x[j]
    return y


@compiled(MATRIX, MATRIX)
def congruent(A: Array, P: Array) -> Array:
    """Return A P A^T (n, n) of A (n, m) and P (m, m)."""
    return product(product(A, P), A.T)


@compiled(MATRIX, MATRIX)
def eliminated(A: Array, B: Array) -> Array:
    """Return A^-1 B (n, k), by Gaussian elimination with pivots; a LinAlgError means that A (n, n) is singular."""
    A, X, n = A.copy(), B.copy(), len(A)
    for k in range(n):
        pivot = k + np.argmax(np.abs(A[k:, k]))
        if A[pivot, k] == 0.0:
            raise np.linalg.LinAlgError("singular matrix")
        for j in range(n):
            A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        for j in range(X.shape[1]):
            X[k, j], X[pivot, j] = X[pivot, j], X[k, j]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            for j in range(k + 1, n):
                A[i, j] -= factor * A[k, j]
            for j in range(X.shape[1]):
                X[i, j] -= factor * X[k, j]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for j in range(X.shape[1]):
                X[i, j] -= A[i, k] * X[k, j]
        for j in range(X.shape[1]):
            X[i, j] /= A[i, i]
    return X


exp_so3 = compiled(VECTOR)(poses.exp_so3)
right_jacobian = compiled(VECTOR)(poses.right_jacobian)
exp_translation = compiled(VECTOR, VECTOR)(poses.exp_translation)


@compiled(MATRIX)
def logarithm(R: Array) -> Array:
    """Return the rotation vector (3,) of R (3, 3), rad, to be used away from half a turn."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    angle = math.atan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    return v * (angle / sine if sine > 1e-9 else 1.0)


@compiled(MATRIX)
def orthonormalised(R: Array) -> Array:
    """Return the rotation nearest to an almost orthogonal R (3, 3), see `poses.orthonormalise`."""
    return 1.5 * R - product(0.5 * R, product(R.T, R))


@compiled(VECTOR)
def cross_matrix(v: Array) -> Array:
    """Return S(v) (3, 3) with S(v) y = v x y."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@compiled(MATRIX, VECTOR)
def adjoint(R: Array, p: Array) -> Array:
    """Return Ad (6, 6) of T = (R, p): T Exp(xi) T^-1 = Exp(Ad xi). It turns left errors at T into right ones."""
    A = np.zeros((6, 6))
    place(A, 0, 0, R)
    place(A, 3, 3, R)
    place(A, 3, 0, product(cross_matrix(p), R))
    return A
