"""Other projects' own first examples, with coopenv: a row each, green or with a reason.

Usage: python -m benchmarks.interoperability                    # an environment per set of packages, below out/
       python -m benchmarks.interoperability evo torchrl --page docs/interoperability.md

A file of `examples/` is a row: it states its packages, and the page of the example, in its inline metadata (PEP 723).
The last line that it prints is what worked; the last line of its error is the reason.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from coopenv.report.table import Column, Table

ROOT = Path(__file__).parents[2]
EXAMPLES = Path(__file__).parent / "examples"
BLOCK = re.compile(r"(?m)^# /// script\n((?:^#.*\n)+?)^# ///$")
LONGEST = 900  # s, of an example
INTRODUCTION = """# Interoperability

The first example of each project's own documentation, with environments, runs and bags of coopenv.
`make interoperability` writes this page, also once a week; a row is a file of `benchmarks/interoperability/examples`.
"""


@dataclass(frozen=True)
class Example:
    """The first example of another project."""

    path: Path
    title: str
    """Name of the project, a colon, and what the example does."""
    packages: tuple[str, ...]
    package: str
    """The package whose version is stated."""
    documentation: str
    needs: tuple[str, ...]
    """Files of coopenv that it imports, relative to the checkout."""

    @classmethod
    def of(cls, path: Path) -> Example:
        """Read an example's docstring and metadata."""
        text = path.read_text(encoding="utf-8")
        block = BLOCK.search(text)
        if block is None:
            raise SystemExit(f"{path}: no block '# /// script' (PEP 723)")
        data = tomllib.loads("".join(line.removeprefix("#").removeprefix(" ") for line in block[1].splitlines(True)))
        own: dict[str, Any] = data["tool"]["coopenv"]
        title = text.removeprefix('"""').partition('"""')[0].strip()
        return cls(
            path, title, tuple(data["dependencies"]), own["package"], own["documentation"], tuple(own.get("needs", ()))
        )

    @property
    def name(self) -> str:
        """The word that selects it."""
        return self.path.stem.removesuffix("_example")


def installed(packages: Sequence[str], folder: Path) -> Path:
    """Return the Python of an environment that has packages, with coopenv from this checkout; it is made once.

    Raises:
        RuntimeError: pip refuses; the message is its last line.
    """
    place = folder / hashlib.sha256("\n".join(sorted(packages)).encode()).hexdigest()[:12]
    python = place / "bin" / "python"
    if not (place / "complete").exists():
        venv.create(place, with_pip=True, clear=True)
        own = re.compile(r"coopenv(\[.*\])?")
        wanted: list[str] = []
        for name in packages:
            found = own.fullmatch(name)
            wanted += ["--editable", f"{ROOT}{found[1] or ''}"] if found else [name]
        # A project may pin what coopenv pins: newest versions, but for torch's, whose build is the CPU's.
        pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        (place / "torch.txt").write_text("\n".join(line for line in pinned if line.startswith("torch==")))
        pip = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        command = [*map(str, pip), "--constraint", str(place / "torch.txt"), *wanted]
        made = subprocess.run(command, capture_output=True, text=True, check=False)
        if made.returncode:
            raise RuntimeError(last_line(made.stderr))
        (place / "complete").touch()
    return python


def last_line(text: str) -> str:
    """Return the last line that is not empty."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "no output")


def version_of(package: str, python: Path) -> str:
    """Return the version of an installed package."""
    program = f"from importlib.metadata import version; print(version({package!r}))"
    return subprocess.run((python, "-c", program), capture_output=True, text=True, check=True).stdout.strip()


def outcome(example: Example, python: Path, folder: Path) -> tuple[bool, str]:
    """Run an example in a folder of its own; return whether it is green, and its line."""
    place = folder / example.name
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    for needed in example.needs:
        shutil.copy(ROOT / needed, place)
    surroundings = {**os.environ, "PYTHONPATH": str(place), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            (python, example.path),
            cwd=place,
            env=surroundings,
            capture_output=True,
            text=True,
            timeout=LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, f"not finished after {LONGEST} s"
    (place / "output.txt").write_text(done.stdout + done.stderr)
    return done.returncode == 0, last_line(done.stdout if done.returncode == 0 else done.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the examples that are named, or each of them; return 1 if one is not green."""
    examples = [Example.of(path) for path in sorted(EXAMPLES.glob("*_example.py"))]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=", ".join(example.name for example in examples))
    parser.add_argument("--out", type=Path, default=Path("out/interoperability"), help="environments and outputs")
    parser.add_argument("--page", type=Path, help="write the table to this page")
    options = parser.parse_args(arguments)
    if unknown := set(options.names) - {example.name for example in examples}:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(example.name for example in examples)}")
    chosen = [example for example in examples if not options.names or example.name in options.names]
    rows = []
    green = True
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(chosen))
        for example in chosen:
            progress.update(task, description=example.name)
            version, fine = "", False
            try:
                python = installed(example.packages, options.out.absolute() / "environments")
                version = version_of(example.package, python)
                fine, line = outcome(example, python, options.out.absolute())
            except RuntimeError as error:
                line = f"not installed: {error}"
            green &= fine
            project = example.title.partition(": ")[0]
            state = "green" if fine else "fails"
            link = f"[{project}]({example.documentation})"
            rows.append({"project": project, "page": link, "version": version, "state": state, "result": line})
            progress.advance(task)
    texts = [Column(name, number=False, wraps=name == "result") for name in ("version", "state", "result")]
    Console().print(Table.of([Column("project", number=False), *texts], rows))
    if options.page:
        options.page.write_text(
            f"{INTRODUCTION}\n{Table.of([Column('page', 'project', number=False), *texts], rows).markdown()}\n",
            encoding="utf-8",
        )
    return 0 if green else 1


if __name__ == "__main__":
    sys.exit(main())
