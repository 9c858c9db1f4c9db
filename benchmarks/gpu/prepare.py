"""Set up a virtual environment on a bare machine; needs nothing but Python: `python -m benchmarks.gpu.prepare DIR`.

A torch that the interpreter has already is used as it is, because it fits the driver; packages of the interpreter are
seen by the new environment even where the interpreter is itself in one. `--wheels` takes packages from a folder, for a
machine without a network.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import sysconfig
import tomllib
import venv
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TRAINING = ("torch", "tyro", "tensorboard", "tomlkit")
"""Packages of extras that the training needs; without one it is left out."""
TESTS = ("pytest",)
LINK = "of_the_interpreter.pth"


def requirements(has_torch: bool) -> list[str]:
    """Return what pip has to install, as `pyproject.toml` says, without a torch that is there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = (*TRAINING, *TESTS)[1 if has_torch else 0 :]
    extras = [line for name in ("train", "dev") for line in project["optional-dependencies"][name]]
    return [*project["dependencies"], *(line for line in extras if _name(line) in wanted)]


def _name(requirement: str) -> str:
    return requirement.partition(">=")[0].partition("[")[0]


def make_environment(folder: Path, with_torch: bool) -> Path:
    """Make a virtual environment that sees this interpreter's packages where it has torch; return its Python."""
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if not python.exists():
        venv.create(folder, with_pip=True)
    if with_torch:
        place = subprocess.run(
            [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        outer = dict.fromkeys(sysconfig.get_path(kind) for kind in ("purelib", "platlib"))
        (Path(place) / LINK).write_text("\n".join(outer) + "\n", encoding="utf-8")
    return python


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the environment and install what is missing; return pip's exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu.prepare", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--wheels", type=Path, help="folder of wheels to install from, without a network")
    asked = parser.parse_args(arguments)
    has_torch = find_spec("torch") is not None
    python = make_environment(asked.folder, has_torch)
    source = ["--no-index", "--find-links", str(asked.wheels)] if asked.wheels else []
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *source]
    return subprocess.run([*pip, *requirements(has_torch)]).returncode


if __name__ == "__main__":
    sys.exit(main())
