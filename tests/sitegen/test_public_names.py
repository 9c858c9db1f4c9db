"""Public names stay as they are, unless a change writes their file anew."""

from __future__ import annotations

from pathlib import Path

import griffe
import pytest

from sitegen import public_names

PACKAGE = '''
from dataclasses import dataclass
SIZE: int = 3

@dataclass
class Part:
    """A part."""
    size: float
    _hidden: int = 0

    def move(self, by: float = 1.0, *, back: bool = False) -> "Part": ...

class Made(Part):
    def __init__(self, name: str) -> None:
        self.name = name

def _private(): ...
'''


@pytest.fixture(scope="module")
def report() -> str:
    return public_names.report()


def test_a_name_has_its_signature(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PACKAGE, encoding="utf-8")
    module = griffe.GriffeLoader(search_paths=[str(tmp_path)]).load("parts")
    assert [*public_names.described("parts", module)] == [
        "class parts.Made(name: str)",
        "parts.Made.name",
        "class parts.Part(size: float, _hidden: int = 0)",
        "parts.Part.move(by: float = 1.0, *, back: bool = False) -> Part",
        "parts.Part.size: float",
        "parts.SIZE: int",
    ]


def test_public_names_are_those_of_the_file(report: str) -> None:
    now, held = (text.splitlines() for text in (report, public_names.FILE.read_text(encoding="utf-8")))
    gone, new = sorted({*held} - {*now}), sorted({*now} - {*held})
    assert not gone and not new, (
        f"gone or changed: {gone}; new: {new}. Public names: see docs/stability.md, then run `make names`"
    )
    assert now == held


def test_the_file_holds_names_of_every_kind(report: str) -> None:
    lines = report.splitlines()
    assert "coopenv/BusyIntersection-v0" in lines and "coopenv.list_envs() -> list[str]" in lines
    assert any(line.startswith("$ coopenv bench observers --") for line in lines)
    assert "coopenv.observers.contract.Tick.dt: float" in lines
