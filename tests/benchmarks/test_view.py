"""`python -m benchmarks.view`."""

from __future__ import annotations

import pytest

from benchmarks import view

pytest.importorskip("viser", reason="needs the extra 'view'")


def test_simulating_is_a_part_of_what_is_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "WARM_UP", 0.3)
    assert view.main(["busy_intersection", "--seconds", "1.5"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("busy_intersection")]
    assert [row[1] for row in rows] == ["no", "yes"]
    for row in rows:
        frames, cpu, scaled, without = (float(entry.rstrip("%")) for entry in row[2:])
        assert frames > 0.0
        assert cpu > 0.0
        assert 0.0 < without < scaled


def test_an_unknown_environment_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert view.main(["nosuch"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: unknown environment 'nosuch'; known: ")
    assert error.count("\n") == 1
