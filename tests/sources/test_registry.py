"""Sources of other packages: a source is found by its name, and one that is broken is one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.cli.app import main
from coopenv.sources.registry import ENVIRONMENT, kind_of
from coopenv.sources.sources import open_backend, open_simulation
from tests.helpers.plugins import install

TWIN = """
from coopenv.sources.registry import SourceKind
from coopenv.sources.worlds import Simulated
from coopenv.scenario import load_scenario

TWIN = SourceKind(title="a twin", opener="twin:open_twin", options=("variant",))
FILES = SourceKind(
    title="a file of ours", opener="twin:nothing", claims=lambda name, topics: name.endswith(".ours"), recorded=True
)
ODD = SourceKind(title="odd", claims=lambda name, topics: 1 / 0)


def open_twin(name, overrides, variant="facade"):
    if name == "twin:failing":
        raise RuntimeError("no link")
    return Simulated(load_scenario(variant, {"horizon": 1.0, **overrides}))
"""
POINTS = {
    "twin": "twin:TWIN",
    "files": "twin:FILES",
    "absent": "no_such_module:KIND",
    "other": "twin:open_twin",
    "odd": "twin:ODD",
}


@pytest.fixture
def twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package with sources."""
    install(tmp_path, monkeypatch, "twin", TWIN, {"coopenv.sources": POINTS})


@pytest.mark.usefixtures("twin")
def test_a_source_of_another_package_is_opened_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert coopenv.parallel_env("twin").scenario.horizon == 1.0
    assert open_backend("twin:2", None, {"horizon": 2.0}, variant="overtaking").scenario.horizon == 2.0
    assert coopenv.parallel_env("facade", backend="twin").possible_agents
    assert main(["describe", "twin"]) == 0
    assert "1 s" in capsys.readouterr().out
    assert kind_of("facade") is kind_of("lane:3") is kind_of("nosuch") is ENVIRONMENT
    assert kind_of("x.ours").recorded


@pytest.mark.usefixtures("twin")
@pytest.mark.parametrize(
    ("name", "options", "why"),
    [
        ("twin:failing", {}, r"twin:open_twin fails: RuntimeError: no link"),
        ("twin", {"data": "."}, "data is for recorded data, 'twin' is a twin"),
        ("twin", {"car": "a"}, "car is for backend='svea', 'twin' is a twin"),
        ("x.ours", {}, r"twin:nothing fails: AttributeError"),
        ("absent", {}, r"source 'absent' \(no_such_module:KIND\) cannot be loaded: ModuleNotFoundError"),
        ("facade", {"backend": "absent"}, "source 'absent'.*cannot be loaded"),
        ("other:1", {}, "source 'other' .*expected a SourceKind"),
        ("facade", {"backend": "nosuch"}, "known: simulated, highway, sumo, program, replay, svea, twin"),
    ],
)
def test_a_source_that_does_not_work_is_one_line(name: str, options: dict[str, Any], why: str) -> None:
    with pytest.raises(CoopenvError, match=why) as caught:
        open_backend(name, options.pop("backend", None), {}, **options)
    assert "\n" not in str(caught.value)
    assert not kind_of("nosuch").recorded, "others are not affected"


@pytest.mark.usefixtures("twin")
def test_sources_are_listed_with_those_of_other_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "sources", "--json"]) == 0
    names = {row["name"]: row["ticks"] for row in json.loads(capsys.readouterr().out)}
    assert {"environment": "live", "log": "recorded", "mrclam": "recorded", "twin": "live"}.items() <= names.items()


@pytest.mark.usefixtures("twin")
def test_a_live_source_is_no_batch_of_worlds() -> None:
    with pytest.raises(CoopenvError, match="'twin' is a twin, which is one world: open it with parallel_env"):
        open_simulation("twin")
