"""`python -m benchmarks.speed` as a whole."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.speed import peer_cases, run
from benchmarks.speed.__main__ import command, main, parser
from benchmarks.speed.report import BUSY
from tests.helpers.commands import refused
from tests.helpers.fake_library import FAKE, SHARE, fake_case

KEYS = {
    "": {"command", "rows", "machine", "versions", "without_figures", "ratios", "startup_s", "growth"},
    "rows": {
        *("name", "worlds", "vehicles", "threads", "dtype", "env_steps_per_s", "agent_steps_per_s"),
        *("vehicle_ticks_per_s", "counted_as_vehicle_ticks", "array_bytes_per_world", "rss_bytes_per_world"),
    },
    "machine": {"processor", "cores_available", "memory_bytes", "system"},
    "versions": {"python", "coopenv", "warp-lang", "numpy"},
    "without_figures": {"name", "worlds", "reason"},
    "ratios": {"peer", "worlds", "threads", "agent_steps"},
    "startup_s": {"imports", "compiling", "cached"},
    "growth": {"sizes", "costs", "overall", "large", "label"},
}


def check(document: dict[str, Any]) -> None:
    """Find the keys that readers rely on."""
    for part, keys in KEYS.items():
        found = document[part] if part else document
        assert all(keys <= set(entry) for entry in (found if isinstance(found, list) else [found])), part
    assert document["command"].startswith("python -m benchmarks.speed ") and document["rows"]
    assert all(row["env_steps_per_s"] > 0 for row in document["rows"])


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("busy_intersecton", "did you mean 'busy_intersection'"),
        ("--out occupied", "it is not a folder"),
        ("--out occupied/below", "cannot write to"),
        ("--out taken", "speed.json: it is a folder"),
        ("--set noise.enabld=false", "did you mean 'enabled'"),
    ],
)
def test_mistakes_end_with_one_line_and_status_2(line: str, message: str) -> None:
    Path("occupied").write_text("")
    Path("taken/speed.json").mkdir(parents=True)
    assert message in refused(*line.split(), command=main)


@pytest.mark.parametrize("option", ["--repeats 0", "--seconds 0", "--seconds nan", "--seconds soon"])
def test_numbers_are_positive(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(option.split())
    assert option.split()[0] in capsys.readouterr().err.splitlines()[-1]


def test_the_command_is_written_as_it_can_be_typed() -> None:
    line = "urban_crossing --set horizon=20.0 --seconds=1.5 --growth --no-peers"
    asked = parser().parse_args([*line.split(), "--out", "here"])
    assert command(asked) == f"python -m benchmarks.speed {line}"


def test_a_run_with_a_fake_peer(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    absent = peer_cases.peer_cases(quick=True)[0]
    monkeypatch.setattr(run, "PEERS", (FAKE, peer_cases.HIGHWAY))
    monkeypatch.setattr(run, "installed", lambda library: library is FAKE)
    monkeypatch.setattr(run, "peer_cases", lambda quick: [fake_case(), absent])
    monkeypatch.setattr(run, "own_cases", lambda *_: [fake_case("make_vec", worlds=32)])
    assert main(["--seconds", "0.01", "--repeats", "1", "--quick", "--out", "here"]) == 0
    out = capsys.readouterr().out
    document = json.loads(Path("here/speed.json").read_text())
    check(document)
    assert [row["name"] for row in document["rows"]] == ["make_vec", "fake"]
    assert document["without_figures"][0]["reason"] == "not installed: pip install highway-env"
    assert set(document["startup_s"]["imports"]) == {"coopenv", "fake"}
    assert "install highway-env" in out
    used = re.search(r"Cores used: (\d\.\d\d) by cases on 1", out)
    assert used is not None and float(used[1]) == SHARE < BUSY
    assert "figures are too low" in " ".join(out.split())
    assert "For fake: scans." in out
    assert "Files in here: speed.json, speed.png" in out


@pytest.mark.slow
def test_quick_from_end_to_end(capsys: pytest.CaptureFixture[str]) -> None:
    line = "--quick --growth --seconds 0.02 --repeats 1 --out here"
    assert main(line.split()) == 0
    out = capsys.readouterr().out
    document = json.loads(Path("here/speed.json").read_text())
    check(document)
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "…" not in out
    assert {path.name for path in Path("here").iterdir()} == {"speed.json", "speed.png", "growth.png"}
    shown = {row["name"] for row in document["rows"]} | {row["name"] for row in document["without_figures"]}
    assert {case.name for case in peer_cases.peer_cases()} <= shown
    assert {row["worlds"] for row in document["rows"] if row["name"] == "make_vec"} == {1, 32, 1024}
    assert all(row["array_bytes_per_world"] > 1000 for row in document["rows"] if row["library"] == "coopenv")
    assert len(document["growth"]) == 4
    assert all(growth["costs"] for growth in document["growth"])
    assert "coopenv" in document["startup_s"]["imports"]
