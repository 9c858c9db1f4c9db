"""Tutorials and how-to pages run from top to bottom as they stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coopenv.observers import registry
from coopenv.viz import FIGURE_NAMES
from tests.helpers import bags
from tests.helpers.sessions import blocks, compare, run_page

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {
    "tutorials/first_steps.md": [],
    "tutorials/own_observer.md": [pytest.mark.slow],
    "tutorials/train.md": [pytest.mark.train, pytest.mark.slow],
    "tutorials/logs.md": [pytest.mark.slow],
    "tutorials/cars.md": [pytest.mark.slow],
    "how-to/scenario.md": [pytest.mark.slow],
    "how-to/figures.md": [pytest.mark.slow],
    "how-to/faults.md": [pytest.mark.slow],
    "how-to/batches.md": [],
}
NEEDS = {
    "tutorials/train.md": ("stable_baselines3", "train"),
    "tutorials/logs.md": ("rosbags", "log"),
    "tutorials/cars.md": ("zenoh", "svea"),
}
"""A module and the extra that brings it."""


def test_every_page_with_programs_is_run() -> None:
    folders = [DOCS / folder for folder in ("tutorials", "how-to", "contributing")]
    pages = {
        path.relative_to(DOCS).as_posix() for folder in folders for path in folder.glob("*.md") if any(blocks(path))
    }
    assert pages == PAGES.keys()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.setattr(registry, "_places", {})
    return tmp_path


@pytest.mark.parametrize("page", [pytest.param(page, marks=marks, id=page) for page, marks in PAGES.items()])
def test_the_page_runs(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if page in NEEDS:
        module, extra = NEEDS[page]
        pytest.importorskip(module, reason=f"needs the extra {extra!r}")
    if page == "tutorials/logs.md":  # the reader's bag
        bags.write(folder / "drive", bags.messages(bags.drive()), "ros1")
    program = run_page(DOCS / page, folder, monkeypatch)
    if page == "tutorials/first_steps.md":
        assert (folder / "lost.png").stat().st_size > 20_000
        error = [info["position_error"] for info in program["infos"].values()]
        assert max(error[:4]) < 0.2 < error[4]  # as the page says
        assert 0.3 < error[4] / program["infos"]["vehicle_5"]["position_std"] < 3.0
    elif page == "tutorials/own_observer.md":
        rows = program["found"].rows
        mean = {
            name: np.mean([r.position_rmse_m for r in rows if r.observer == name])
            for name in program["found"].observers
        }
        assert mean["robust"] < mean["Mine"] < mean["riccati"] < mean["dead_reckoning"]
        assert {"errors.png", "out"} <= {path.name for path in folder.iterdir()}
    elif page == "how-to/figures.md":
        drawn = {"figures": "pdf", "out/paper": "pdf", "out/springer": "svg"}
        for where, suffix in drawn.items():
            assert {path.name for path in (folder / where).glob(f"*.{suffix}")} == {
                f"{n}.{suffix}" for n in FIGURE_NAMES
            }
        assert len(list((folder / "out" / "paper" / "tum").iterdir())) == 10
        for name in ("errors.svg", "mine.pdf", "errors.tex", "errors.pdf", "rows.csv"):
            assert (folder / name).stat().st_size > 400
    elif page == "tutorials/train.md":
        assert program["infos"]["vehicle_1"]["outcome"] == "arrived" and program["worst"] < 0.5
    elif page == "tutorials/logs.md":
        assert program["env"].possible_agents == ["vehicle_1"]


def test_outputs_are_compared() -> None:
    compare("a: 1.02 m\n", "a: 1.0 m\n")
    for other in ("a: 1.3 m\n", "b: 1.0 m\n", "a: 1.0 m\nb\n"):
        with pytest.raises(AssertionError):
            compare(other, "a: 1.0 m\n")
