"""Code that the pages show runs as it stands."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopenv.api.reward import FIELDS, OTHERS
from coopenv.api.terms.layout import observation_layout
from coopenv.observers import registry, run
from coopenv.observers.registry import find
from coopenv.policies import load_agent
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

DOCS = Path(__file__).parents[1] / "docs"


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", [DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda page: page.name)
def test_blocks_are_whole_programs(page: Path, tmp_path: Path) -> None:
    for number, block in enumerate(python_blocks(page)):
        (tmp_path / f"block_{number}.py").write_text(block, encoding="utf-8")
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select=E9,F", "--no-cache", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_backend_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = python_blocks(DOCS / "backends.md")
    program: dict[str, Any] = {}
    exec(compile(block, "backends.md", "exec"), program)
    assert "missing=24" in capsys.readouterr().out
    estimates = [info["estimate"]["position"] for info in program["infos"].values()]
    assert np.abs(estimates - program["env"].engine.backend.places).max() < 0.05


def test_the_tutorials_observer_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})
    blocks = python_blocks(DOCS / "observers.md")
    assert blocks
    for block in blocks:
        exec(compile(block, "observers.md", "exec"), {})
    result = run(find("mine"), record(load_scenario("busy_intersection_tracking", {"horizon": 5.0}), 0))
    assert not result.failure
    # vehicles 1 to 3 see two landmarks and more, and turn towards them
    assert (result.orientation_error[-1, :3] < result.orientation_error[0, :3]).all()
    assert np.isfinite(result.position_error).all()


def test_the_page_on_terms_lists_every_entry_of_a_step() -> None:
    page = (DOCS / "terms.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in (*FIELDS, *OTHERS))


def test_the_programs_on_terms_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program: dict[str, Any] = {}
    for block in python_blocks(DOCS / "terms.md"):
        (tmp_path / "program.py").write_text(block, encoding="utf-8")
        program = runpy.run_path(str(tmp_path / "program.py"))
    assert float(capsys.readouterr().out) < 0.0
    program["envs"].reset(seed=0)
    assert np.isfinite(program["envs"].step(np.zeros(program["envs"].action_space.shape))[1]).all()


def test_the_programs_on_agents_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, own = python_blocks(DOCS / "agents.md")
    exec(compile(first, "agents.md", "exec"), {})
    assert "arrival_rate: 0.9" in capsys.readouterr().out
    (tmp_path / "mine.py").write_text(own, encoding="utf-8")
    scenario = load_scenario("urban_crossing")
    policy = load_agent(f"{tmp_path / 'mine.py'}:Mine", scenario)
    rows = np.zeros((3, observation_layout(scenario).size), dtype=np.float32)
    np.testing.assert_array_equal(policy(rows), [[0.0, 0.0]] * 3)


@pytest.mark.train
def test_the_page_on_trainers_drives_with_the_result_of_the_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With weights that have learnt nothing, which the page's program takes for those of `examples/train_ppo.py`."""
    torch = pytest.importorskip("torch", reason="needs the extra train")
    from safetensors.torch import save_file

    monkeypatch.setattr(sys, "path", [*sys.path, str(DOCS.parent / "examples")])
    from train_ppo import Policy

    torch.manual_seed(0)
    size = observation_layout(load_scenario("urban_crossing")).size
    (tmp_path / "out" / "ppo").mkdir(parents=True)
    save_file(
        Policy(size, 2, hidden=64, initial_std=0.5).state_dict(), tmp_path / "out" / "ppo" / "weights.safetensors"
    )
    monkeypatch.chdir(tmp_path)
    (block,) = (block for block in python_blocks(DOCS / "trainers.md") if "train_ppo" in block)
    program: dict[str, Any] = {}
    exec(compile(block, "trainers.md", "exec"), program)
    ends = capsys.readouterr().out.splitlines()
    assert sorted(line.partition(":")[0] for line in ends) == sorted(program["env"].possible_agents)
