"""`make gpu` and `python -m benchmarks.stages`: what they keep, leave out and compare."""

from __future__ import annotations

import copy
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import view
from benchmarks.gpu import work
from benchmarks.gpu.__main__ import PAGE, main
from benchmarks.gpu.plan import Stage, plan
from benchmarks.gpu.runner import failures, run
from benchmarks.gpu.table import BEGIN, END, put, section
from benchmarks.stages.__main__ import main as stages_main
from benchmarks.stages.ablated_stages import NEVER, STAGES, Setting, ablated_settings
from benchmarks.stages.against import HERE
from benchmarks.stages.rounds import alternate
from coopenv import load_scenario
from coopenv.base.errors import CoopenvError

HEAD = {"command": "python -m benchmarks.gpu", "coopenv": "1.2.3", "device": "cuda:0"}


def test_what_is_there_is_kept_when_a_stage_fails_or_takes_too_long(tmp_path: Path) -> None:
    """The document is on the disk after every stage; a mistake and a limit are lines in it, not the end of the run."""
    seen: list[int] = []

    def tell(line: str) -> None:
        seen.append(len(json.loads((tmp_path / "gpu.json").read_text())["stages"]))

    stages = [Stage("slow", "machine", 0.05, {"device": "cpu"}), Stage("wrong", "machine", 60.0, {"device": "tpu"})]
    document = run(stages, HEAD, tmp_path / "gpu.json", 600.0, tell)
    assert seen == [1, 2]
    assert json.loads((tmp_path / "gpu.json").read_text()) == document
    slow, wrong = document["stages"]
    assert slow["problem"] == "ended after its limit of 0 s"
    assert "unknown device 'tpu'" in wrong["problem"]
    assert failures(document) == ["slow", "wrong"]
    late = run(stages, HEAD, tmp_path / "gpu.json", 0.0)
    assert [row["skipped"] for row in late["stages"]] == ["no time was left"] * 2 and not failures(late)


def test_parts_that_run_one_by_one_fill_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A part replaces its own rows of the same device and version, and no others."""
    out = tmp_path / "gpu.json"
    part = ["--device", "cpu", "--quick", "--worlds", "2", "--out", str(out), "--only"]
    out.write_text(json.dumps({"coopenv": "0.0.1", "device": "cpu", "stages": [{"name": "tests", "skipped": "old"}]}))
    assert main([*part, "machine"]) == 0
    document = json.loads(out.read_text())
    assert [row["name"] for row in document["stages"]] == ["machine"]
    document["stages"] = [{"name": "machine", "problem": "old"}, {"name": "tests", "skipped": "kept"}]
    out.write_text(json.dumps(document))
    assert main([*part, "machine"]) == 0
    kept, new = json.loads(out.read_text())["stages"]
    assert kept == {"name": "tests", "skipped": "kept"} and "result" in new
    assert main([*part, "dance"]) == 2 and "no stage begins with 'dance'" in capsys.readouterr().err


def test_worlds_that_do_not_fit_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """1,000 worlds of over 10 KiB each are more than 80 % of 10 MiB."""
    monkeypatch.setattr(work, "free_memory", lambda device: 10 * 2**20)
    (stage,) = (s for s in plan("cpu", (1000,)) if s.name == "throughput, riccati, 1000")
    assert work.throughput(**stage.arguments)["skipped"].startswith("1000 worlds take 0.0 GiB")


def test_one_large_world_is_a_stage_of_its_own() -> None:
    (stage,) = (s for s in plan("cpu") if s.name.startswith("throughput, riccati in city"))
    given = stage.arguments
    assert given["worlds"] == 1 and len(load_scenario(given["environment"], given["overrides"]).vehicles) == 1_024
    (quick,) = (s for s in plan("cpu", quick=True) if s.name == stage.name)
    found = work.throughput(**quick.arguments)
    assert found["worlds"] == 1 and found["vehicle_ticks_per_s"] > 0.0


def test_worlds_are_compared_one_by_one() -> None:
    here = {"a": np.array([[1.0, np.nan], [2.0, np.inf], [3.0, 0.0]]), "n": np.array([1, 2, 3]), "tick": 4}
    there = copy.deepcopy(here)
    assert work.compared(here, there, 3) == {"worlds": 3, "worlds_alike": 3, "largest_difference": 0.0, "in": ""}
    there["a"][2, 0] += 4e-3
    found = work.compared(here, there, 3)
    assert found["worlds_alike"] == 2 and found["in"] == "a"
    assert found["largest_difference"] == pytest.approx(1e-3)
    there["n"][0] = 7
    assert work.compared(here, there, 3)["largest_difference"] == np.inf
    there["a"][1, 1] = np.nan
    assert work.compared(here, there, 3)["worlds_alike"] == 0


def document_of_a_gpu() -> dict[str, Any]:
    rate = {"env_steps_per_s": 2e6, "agent_steps_per_s": 1e7, "vehicle_ticks_per_s": 6e7, "bytes_per_world": 2048.0}
    spread = {"slowest_round": 0.5, "fastest_round": 1.5}
    alike = {"worlds": 64, "worlds_alike": 64, "largest_difference": 2e-9, "in": "position"}
    stages = [
        {"name": "throughput, riccati, 4096", "result": {"worlds": 4096, **rate, **spread}},
        {"name": "throughput, robust, 262144", "skipped": "262144 worlds take 99.0 GiB, 80.0 GiB are free"},
        {"name": "agreement, riccati", "result": alike},
        {"name": "tests", "result": {"status": 0, "passed": 4, "failed": 0, "left_out": 0}},
    ]
    return {**HEAD, "stages": stages}


def test_the_table_stands_between_the_marks(tmp_path: Path) -> None:
    page, document = tmp_path / "page.md", document_of_a_gpu()
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    put(document, page)
    text = page.read_text()
    assert text.startswith(f"before\n{BEGIN}\n") and text.endswith(f"{END}\nafter\n") and "old" not in text
    assert "| riccati | 2 | 60 M |" in text
    assert "64 of 64 worlds alike" in text and "4 passed, 0 failed" in text and "99.0 GiB" in text
    put(document, page)
    assert page.read_text() == text
    with pytest.raises(CoopenvError, match="make gpu has written"):
        put({"stages": 1}, page)
    with pytest.raises(CoopenvError, match="of a CPU"):
        put({**document, "device": "cpu"}, page)
    page.write_text(PAGE.read_text(encoding="utf-8"))  # has a place for it
    put(document, page)
    assert section(document) in page.read_text()
    page.write_text("no marks")
    with pytest.raises(CoopenvError, match="needs one line"):
        put(document, page)


def test_bad_worlds_and_failed_tests_are_failures() -> None:
    document = document_of_a_gpu()
    assert not failures(document)
    document["stages"][2]["result"] |= {"worlds_alike": 63, "largest_difference": None}
    assert "63 of 64 worlds alike, largest difference not finite" in section(document)
    document["stages"][3]["result"]["passed"] = 0
    assert failures(document) == ["agreement, riccati", "tests"]


@pytest.mark.slow
def test_the_whole_run_on_a_cpu(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gpu.json"
    assert main(["--device", "cpu", "--quick", "--worlds", "64", "--out", str(out)]) == 0
    document = json.loads(out.read_text())
    assert [row["name"] for row in document["stages"]] == [stage.name for stage in plan("cpu", (64,), True)]
    results = {row["name"]: row["result"] for row in document["stages"] if "result" in row}
    assert results["agreement, robust"]["worlds_alike"] == results["agreement, robust"]["worlds"]
    assert results["throughput, riccati, 64"]["env_steps_per_s"] > 0.0
    assert results["tests"]["failed"] == 0 < results["tests"]["passed"]
    assert "| vehicle ticks/s | KiB/world | 1 world | 64 worlds |" in capsys.readouterr().out


def test_rounds_alternate() -> None:
    names: list[str] = []

    def step(name: str) -> float:
        names.append(name)
        return float(len(names))

    times = alternate([partial(step, "a"), partial(step, "b")], 3)
    assert names == ["a", "b"] * 3 and times.tolist() == [[1, 2], [3, 4], [5, 6]]


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


@pytest.mark.slow
def test_the_whole_command(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--worlds", "2", "--rounds", "2", "--decisions", "1"]
    assert stages_main(few) == 0
    out = capsys.readouterr().out
    assert all(name in out for name, _ in STAGES) and "urban_crossing, robust" in out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert stages_main([*few, "--against", str(HERE), "--compiles", "0"]) == 0
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
