"""Fields whose description is a comment have it on the pages of the API."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.sessions import ROOT

griffe = pytest.importorskip("griffe", reason="needs the extra 'docs'")


def loaded(folder: Path, package: str) -> Any:
    extensions = griffe.load_extensions(str(ROOT / "sitegen" / "comments.py"))
    return griffe.GriffeLoader(search_paths=[str(folder)], extensions=extensions).load(package)


def docstrings(parent: Any) -> dict[str, str | None]:
    return {name: part.docstring and part.docstring.value for name, part in parent.attributes.items()}


def test_every_field_of_what_the_api_shows_is_described() -> None:
    """The tutorial on observers promises it."""
    package = loaded(ROOT, "coopenv")
    pages = (ROOT / "docs" / "reference" / "api").glob("*.md")
    shown = [
        name for page in pages for name in re.findall(r"^::: coopenv\.(\S+)", page.read_text(encoding="utf-8"), re.M)
    ]
    found = [package[name] for name in shown if not name.startswith("bench.")]
    classes = [part for part in found if part.is_class]
    classes += [part for module in found if module.is_module for part in module.classes.values() if not part.is_alias]
    records = [
        part for part in classes if "dataclass" in part.labels or part.name in ("Agent", "Backend", "JointObserver")
    ]
    assert {"Tick", "Gains", "Sensed", "Command", "Run", "Field", "Difference", "Agent", "Backend"} <= {
        part.name for part in records
    }
    assert not [
        f"{part.path}.{name}"
        for part in records
        for name, text in docstrings(part).items()
        if not text and not name.startswith("_") and name != "model_config"  # pydantic's
    ]
