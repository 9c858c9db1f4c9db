"""Entry points of coopenv: those of a clone, those of an installation, and that all of them load."""

from __future__ import annotations

import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from coopenv.base import plugins
from tests.helpers.plugins import install

CLONE = Path(__file__).resolve().parents[1]
GROUPS = tomllib.loads((CLONE / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
POINTS = [EntryPoint(name, place, group) for group, points in GROUPS.items() for name, place in points.items()]


@pytest.mark.parametrize("point", POINTS, ids=lambda point: point.name)
def test_every_entry_point_of_coopenv_loads(point: EntryPoint) -> None:
    assert plugins.own(point.group)[point.name] == plugins.offered(point.group)[point.name] == point
    assert plugins.loaded(point, "entry point") is not None


def test_an_installation_has_the_entry_points_of_its_metadata(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, "coopenv", "", {"coopenv.views": {"theirs": "math:sqrt"}})
    (tmp_path / "coopenv.py").unlink()  # its metadata alone
    monkeypatch.setattr(plugins, "__file__", str(tmp_path / "coopenv" / "base" / "plugins.py"))
    plugins._own.cache_clear()
    try:
        assert plugins.own("coopenv.views")["theirs"].load()(4.0) == 2.0
    finally:
        plugins._own.cache_clear()
