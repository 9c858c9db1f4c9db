"""`python -m benchmarks.city`: mistakes in its options."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.city import main
from tests.helpers.commands import refused


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "none")]
    assert "--observers: unknown observer 'robus' (did you mean 'robust'" in refused("--observers=robus", command=main)
    assert "city.json; without --page the command measures it" in refused("--page", ".", *out, command=main)
    for wrong in (["--worlds", "0"], ["--sizes", "x"], ["--sizes", "64,-1"]):
        with pytest.raises(SystemExit):
            main([*wrong, *out])
        assert f"argument {wrong[0]}: " in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
