"""Run the test suite under other Pythons, versions of libraries, processors, and in random order: `make test-matrix`.

Each cell has a virtual environment, made by uv in build/matrix, and runs the tests that are not slow in it. A cell
whose Python cannot be found counts as failed.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "matrix"
VERSIONS = {
    "pinned": ("--constraint", "constraints.txt"),
    "lowest": ("--resolution", "lowest-direct"),
    "newest": ("--upgrade",),
    "warp": ("--upgrade", "--override", ".ci/newest_warp.txt"),
}
"""Options of `uv pip install`."""
CPU_FEATURES = "from numpy._core._multiarray_umath import __cpu_dispatch__ as names; print(*names)"
"""Prints what NPY_DISABLE_CPU_FEATURES can switch off."""
UV = (sys.executable, "-m", "uv")
SEED = random.randrange(10**6)


@dataclass(frozen=True)
class Cell:
    """One way to run the suite."""

    name: str
    meaning: str
    python: str = "3.11"
    versions: str = "pinned"
    environment: dict[str, str] = field(default_factory=dict)
    no_simd: bool = False
    """Whether NumPy keeps to the instructions that every processor has."""
    options: tuple[str, ...] = ()
    """Of pytest."""
    packages: tuple[str, ...] = ()
    """Installed besides the extra `dev`."""
    parallel: bool = True


CELLS = [
    Cell("lowest", "lowest versions that pyproject.toml allows", versions="lowest"),
    Cell("newest", "newest versions that pyproject.toml allows", "3.13", "newest"),
    Cell("warp", "newest release of Warp, whatever pyproject.toml allows", "3.13", "warp"),
    Cell("python-3.12", "another Python; one worker", "3.12", parallel=False),
    Cell("haswell", "BLAS kernels of Haswell", environment={"OPENBLAS_CORETYPE": "Haswell"}),
    Cell("nehalem", "BLAS kernels of Nehalem", environment={"OPENBLAS_CORETYPE": "Nehalem"}),
    Cell("no-simd", "NumPy without dispatched CPU features", no_simd=True),
    Cell(
        "generic",
        "Warp kernels and Numba functions for any x86-64, without FMA",
        environment={"NUMBA_CPU_NAME": "generic"},
        options=("-p", "tests.helpers.generic_kernels"),
    ),
    Cell("random-order", f"order of seed {SEED}", options=(f"--randomly-seed={SEED}",), packages=("pytest-randomly",)),
]
"""Python 3.13 with pinned versions is left out: `newest` differs in the same way and more."""


class MissingError(RuntimeError):
    """A cell cannot be set up; one line."""


def run(*command: str | Path) -> str:
    """Return what a command prints.

    Raises:
        MissingError: it failed.
    """
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise MissingError(lines[-1].strip())
    return str(done.stdout).strip()


def find_python(version: str) -> str:
    """Return an interpreter that uv or pyenv has, or else the version, for uv to download."""
    try:
        return run(*UV, "python", "find", "--no-python-downloads", "--system", version)
    except MissingError:
        installed = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob(f"versions/{version}.*/bin/python")
        return str(max(installed, default=version))


def make_environment(cell: Cell) -> Path:
    """Return the Python of a virtual environment with the cell's versions, which is made anew.

    Raises:
        MissingError: there is no such Python, or a package cannot be installed.
    """
    folder = FOLDER / f"{cell.name}-{cell.python}"
    try:
        run(*UV, "venv", "--quiet", "--clear", "--python", find_python(cell.python), folder)
    except MissingError as problem:
        raise MissingError(f"no Python {cell.python} here, and none to download ({problem})") from None
    python = folder / "bin" / "python"
    wanted = ("--editable", ".[dev]", *cell.packages)
    run(*UV, "pip", "install", "--quiet", "--python", python, *VERSIONS[cell.versions], *wanted)
    return python


def run_cell(cell: Cell, tests: list[str], workers: int) -> tuple[bool, str]:
    """Run the suite; return whether all passed, and pytest's last line or why it was not run."""
    try:
        python = make_environment(cell)
        environment = {**os.environ, **cell.environment}
        if cell.no_simd:
            environment["NPY_DISABLE_CPU_FEATURES"] = run(python, "-c", CPU_FEATURES)
    except MissingError as problem:
        return False, f"not run: {problem}"
    parallel = ("-n", str(workers), "--dist", "loadfile") if cell.parallel and workers > 1 else ("-p", "no:xdist")
    command = [
        python,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow and not packaging and not browser",
    ]
    log = FOLDER / f"{cell.name}.log"
    with log.open("w") as file:
        done = subprocess.run([*command, *parallel, *cell.options, *tests], cwd=ROOT, env=environment, stdout=file)
    return done.returncode == 0, log.read_text().strip().splitlines()[-1].strip("= ")


def main() -> int:
    """Run the cells that are named, all by default; return the exit status."""
    names = [cell.name for cell in CELLS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("cells", nargs="*", metavar="CELL", help=f"of {', '.join(names)}; default: all")
    parser.add_argument("--workers", type=int, default=2, help="processes of pytest")
    parser.add_argument("--tests", nargs="*", default=["tests"], help="files or folders")
    asked = parser.parse_args()
    if unknown := set(asked.cells) - set(names):
        parser.error(f"no such cell: {', '.join(sorted(unknown))}; known: {', '.join(names)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    table = Table("cell", "Python", "versions", "what differs", "result", "min")
    passed = True
    console = Console()
    for cell in CELLS:
        if asked.cells and cell.name not in asked.cells:
            continue
        console.print(f"{cell.name} ... (output in {(FOLDER / cell.name).relative_to(ROOT)}.log)")
        begin = time.monotonic()
        good, result = run_cell(cell, asked.tests, asked.workers)
        passed &= good
        minutes = f"{(time.monotonic() - begin) / 60:.1f}"
        table.add_row(cell.name, cell.python, cell.versions, cell.meaning, result, minutes, style="" if good else "red")
    console.print(table)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
