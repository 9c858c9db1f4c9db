"""Functions of a few small arrays, compiled by Numba: in NumPy every operation takes a microsecond, whatever its size.

Each function is compiled for one type per argument, which admits any memory layout. Compilation happens when the module
is first loaded on a machine. As in C, the shapes of the arguments are not checked.

Numba caches machine code per function and invalidates it when the function's own file changes. Changes of functions and
constants in other files go unnoticed. The cache folder is therefore named by a digest of all these sources.
"""

import os
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryFile
from typing import Any, TypeVar, cast

import numba
from numba import njit, types

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])

VECTOR, MATRIX, MATRICES = (types.Array(types.float64, n, "A", readonly=True) for n in (1, 2, 3))
"""Arguments that are arrays of float64 of so many axes, of any layout; they are not written to."""
ROW, TARGET = (types.Array(types.float64, n, "C") for n in (1, 2))
"""New arrays, which are written to."""
NUMBER, WHOLE, FLAG = types.float64, types.int64, types.boolean

PACKAGE = Path(__file__).parents[1]
ROOMS = ("estimation", "observers")  # where compiled functions are, and what they use
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
    options: dict[str, Any] = {"error_model": "numpy"}
    if folder is not None:
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            return njit(arguments, cache=True, **options)(function)
        except Exception:  # what is kept is damaged, or the disk is full; an error of the function comes once more
            pass
        finally:
            config.CACHE_DIR = before
    return njit(arguments, **options)(function)


@cache
def code_folder() -> Path | None:
    """Return where machine code of these very sources is kept; None where there is no place to write to.

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
