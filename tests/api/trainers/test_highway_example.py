"""The example `highway_policy.py` trains, keeps weights that are read without running code, and prints its table."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")
pytest.importorskip("highway_env", reason="needs the extra 'highway'")

import torch

from tests.helpers import four_way

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return four_way.example("trainers/highway_policy")


def test_the_example_prints_the_cost_of_errors(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["highway_policy.py", "--quick"])
    example.main()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    assert [row.split()[1] for row in rows] == list(example.ARMS)
    errors = [float(row.split("│")[2].split()[0]) for row in rows]
    assert errors[0] == 0.0 and errors[2] < 0.3 < errors[3]
    assert not list(tmp_path.iterdir())


def test_weights_are_kept_and_read_again(example: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "policy.pt"
    first = example.trained(path, 30, keep=True).policy.state_dict()
    again = example.trained(path, 30, keep=True).policy.state_dict()
    assert path.is_file() and first.keys() == again.keys()
    assert all(torch.equal(first[name], again[name]) for name in first)
