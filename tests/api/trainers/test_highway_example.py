"""`examples/highway_policy.py` trains, keeps weights that are read without running code, and prints its table."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")
pytest.importorskip("highway_env", reason="needs the extra 'highway'")

import torch

pytestmark = pytest.mark.train
EXAMPLE = Path(__file__).parents[3] / "examples" / "highway_policy.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("highway_policy", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = sys.modules["highway_policy"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_prints_what_error_costs(
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
