"""`python -m benchmarks.stages` and `benchmarks.view`: ratios, stages that are really off, and the whole commands."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from benchmarks import view
from benchmarks.stages.__main__ import main
from benchmarks.stages.ablated_stages import NEVER, STAGES, Setting, ablated_settings
from benchmarks.stages.against import HERE
from benchmarks.stages.rounds import alternate


def test_rounds_alternate() -> None:
    told: list[str] = []

    def step(name: str) -> float:
        told.append(name)
        return float(len(told))

    times = alternate([partial(step, "a"), partial(step, "b")], 3)
    assert told == ["a", "b"] * 3 and times.tolist() == [[1, 2], [3, 4], [5, 6]]


def test_each_stage_is_switched_off_on_top_of_those_before() -> None:
    settings = list(ablated_settings())
    assert [name for name, _ in settings] == [name for name, _ in STAGES]
    last = settings[-1][1]
    assert not (last.visibility or last.sending or last.gramian) and last.overrides == {"noise.enabled": False}


def test_what_is_switched_off_does_not_happen() -> None:
    sensed = {"topology.mode": "sensed", "horizon": 1.0}
    whole = Setting().world("overtaking", sensed, 2, "float32")
    silent = Setting(visibility=False, sending=False, gramian=False).world("overtaking", sensed, 2, "float32")
    for world in (whole, silent):
        world.advance(6)
    assert silent.model.radio.period == NEVER
    assert (whole.view("inbox_tick") >= 0).any() and not (silent.view("inbox_tick") > 0).any()
    targets = whole.view("sight")[0] != 0
    assert (silent.view("sight")[0][targets] == silent.view("sight")[0][targets][0]).all()
    assert (whole.view("sight") != silent.view("sight")).any()
    assert whole.view("gramian_time").any() and not silent.view("gramian_time").any()


def test_a_folder_without_coopenv(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--against", str(tmp_path), "--worlds", "1"]) == 2
    assert "no checkout of coopenv" in capsys.readouterr().err


@pytest.mark.slow
def test_the_whole_command(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--worlds", "2", "--rounds", "2", "--decisions", "1"]
    assert main(few) == 0
    out = capsys.readouterr().out
    assert all(name in out for name, _ in STAGES) and "urban_crossing, robust" in out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert main([*few, "--against", str(HERE), "--compiles", "0"]) == 0
    assert "this / other" in capsys.readouterr().out


# The live view


def test_simulating_is_a_part_of_what_is_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
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
