"""The rooms of the package: which may import which, and that nothing goes round in a circle."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "coopenv"

ROOMS = (
    ("base",),
    ("scenario",),
    ("estimation",),
    ("world",),
    ("observers",),
    ("backends",),
    ("cars",),
    ("backends.sources",),
    ("viz",),
    ("api",),
    ("policies",),
    ("evaluation",),
    ("training",),
    ("runs",),
    ("bench",),
    ("cli", "__init__"),
    ("__main__",),
)
"""From the ground up: a room imports from those below it and from itself. `docs/architecture.md` shows the same."""

MODULES = sorted(PACKAGE.rglob("*.py"))


def name_of(path: Path) -> str:
    """Return a file's module, a package's being that of its `__init__`."""
    parts = ["coopenv", *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> set[str]:
    """Return every module of the package that a file imports, inside functions and for typing too."""
    known = {name_of(module) for module in MODULES}
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in known else node.module for name in whole}
    return {name for name in found if name.split(".")[0] == "coopenv"}


def floor_of(module: str) -> int:
    """Return how high a module's room lies; the longest name of a room that fits counts."""
    room = ".".join([*module.split("."), "__init__"][1:])
    fitting = [
        (len(name), floor) for floor, names in enumerate(ROOMS) for name in names if f"{room}.".startswith(f"{name}.")
    ]
    assert fitting, f"{module}: its room is not in ROOMS"
    return max(fitting)[1]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_point_downwards(path: Path) -> None:
    here = name_of(path)
    above = sorted(other for other in imports_of(path) if floor_of(other) > floor_of(here))
    assert not above, f"{here} imports from a room above it: {', '.join(above)}"


def test_no_module_imports_itself_through_others() -> None:
    known = {name_of(path) for path in MODULES}
    TopologicalSorter({name_of(path): imports_of(path) & known for path in MODULES}).prepare()
