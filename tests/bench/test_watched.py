"""Observers that loop, wait, allocate, raise or end their process are ended alone; the others' rows stay."""

from __future__ import annotations

import json
import multiprocessing
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.bench.executors import NOT_RUN, ProcessLimits, _work, find_executor
from coopenv.bench.frozen import Frozen, report
from coopenv.cli.app import main
from tests.helpers.commands import refused
from tests.helpers.processes import DEADLOCK
from tests.helpers.short_benchmark import short_definition

PLUGINS = '''
import ctypes, os, subprocess, sys, time
import numpy as np
from coopenv.observers import Estimate, Message

class Fine:
    def __init__(self, setup):
        self.ticks = 0
    def reset(self, pose, covariance):
        self.estimate = Estimate(*pose, covariance)
    def update(self, tick):
        self.ticks += 1
        if self.ticks == 5:
            self.misbehave()
        return self.estimate
    def message(self):
        return Message()
    def misbehave(self):
        pass

class Loops(Fine):
    def misbehave(self):
        while True:
            pass

class Waits(Fine):
    def misbehave(self):
        time.sleep(1e6)

class Allocates(Fine):
    def misbehave(self):
        kept = []
        while True:
            kept.append(np.ones(2**20))

class Delegates(Fine):
    """Allocates in a process of its own."""
    def misbehave(self):
        subprocess.run([sys.executable, "-c", "kept = bytearray(2**30)\\nwhile True: pass"])

class Raises(Fine):
    def misbehave(self):
        raise ValueError("on purpose")

class Interrupts(Fine):
    def misbehave(self):
        raise KeyboardInterrupt

class Ends(Fine):
    def misbehave(self):
        os._exit(3)

class Crashes(Fine):
    def misbehave(self):
        ctypes.string_at(0)
'''
REASONS = {
    "Fine": "",
    "Loops": "with seed 0: more than 2 s on one record (--seconds); its remaining records were not run",
    "Waits": "with seed 0: more than 2 s on one record (--seconds); its remaining records were not run",
    "Allocates": "with seed 0: more than 400 MiB of memory (--memory)",
    "Delegates": "with seed 0: more than 400 MiB of memory (--memory)",
    "Raises": "at vehicle_1 at 0.083 s: ValueError: on purpose (mine.py:",
    "Interrupts": "with seed 0: KeyboardInterrupt",
    "Ends": "with seed 0: its process ended with status 3",
    "Crashes": "with seed 0: its process ended with SIGSEGV",
}


def board(folder: Path, monkeypatch: pytest.MonkeyPatch, names: list[str], *more: str) -> dict[str, str]:
    """Return the failure of each observer, after a comparison with `dead_reckoning`, whose row must be whole."""
    (folder / "mine.py").write_text(PLUGINS)
    monkeypatch.chdir(folder)
    observers = ",".join([*(f"mine.py:{name}" for name in names), "dead_reckoning"])
    command = [
        "bench",
        "observers",
        "overtaking",
        "--observers",
        observers,
        "--set",
        "horizon=0.5",
        "--windows",
        "none",
    ]
    status = 2 if {*names} - {"Fine"} else 0  # one that was named has failed
    assert main([*command, "--seconds", "2", "--memory", "400", "--out", "board", *more]) == status
    rows = json.loads((folder / "board" / "leaderboard.json").read_text())["rows"]
    whole = [row for row in rows if row["observer"] in ("dead_reckoning", "Fine")]
    assert len(whole) == 2 * (1 + ("Fine" in names)) and all(row["position_rmse_m"] > 0.0 for row in whole)
    assert all(row["position_rmse_m"] is None for row in rows if row["failure"])
    return {name: next(row["failure"] for row in rows if row["observer"] == name) for name in names}


def test_what_misbehaves_is_ended_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["Loops", "Allocates", "Raises", "Ends", "Fine"]
    for name, reason in board(tmp_path, monkeypatch, names, "--seeds", "1", "--jobs", "1").items():
        assert reason.startswith(REASONS[name]) and bool(reason) == (name != "Fine")


def test_an_observer_that_takes_too_long_is_not_tried_in_other_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that raises is tried in all of them. That the rows of others stay is tested above. Scenes are short here."""
    counted = "class My{0}({0}):\n    def reset(self, *start):\n        print('{0}', file=open('log', 'a'))\n"
    counted += "        super().reset(*start)\n"
    (tmp_path / "own.py").write_text(PLUGINS + counted.format("Loops") + counted.format("Raises"))
    monkeypatch.chdir(tmp_path)
    benchmark, names = Frozen("v1"), ["lane", "ring"]
    monkeypatch.setattr(Frozen, "definition", short_definition(2, 1.0))
    observers = ["own.py:MyLoops", "own.py:MyRaises"]
    result = benchmark.run(observers, names, 1, ProcessLimits(seconds=2.0), lambda share: None)
    rows = {(row["observer"], row["scene"]): row for row in result["rows"]}
    log = (tmp_path / "log").read_text().split()
    for name, started, seeds in (("Loops", ["lane"], 1), ("Raises", names, 2)):
        assert all(rows[f"My{name}", scene]["failure"] for scene in names)
        vehicles = sum(len(scene.source.scenario.vehicles) for scene in benchmark.scenes(started))
        assert log.count(name) == seeds * vehicles
        [line] = [part for part in report(benchmark, result) if isinstance(part, str) and part.startswith(f"My{name}")]
        assert line.endswith(NOT_RUN) == (name == "Loops")


@pytest.mark.parametrize("command", [["v1"], ["observers", "overtaking", "--observers"]])
def test_code_that_ends_or_blocks_its_process_when_loaded_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    for name, code in (("ends", "os._exit(0)"), ("loops", "while True: pass")):
        (tmp_path / f"{name}.py").write_text(f"import os\nclass Mine: pass\n{code}\n")
    monkeypatch.chdir(tmp_path)
    ended = refused("bench", *command, "ends.py:Mine,dead_reckoning", "--seconds", "9")
    assert ended == "error: 'ends.py:Mine' cannot be loaded: its process ended with status 0\n"
    late = refused("bench", *command, "dead_reckoning,loops.py:Mine", "--seconds", "0.5")
    assert late == "error: 'loops.py:Mine' cannot be loaded: more than 0.5 s (--seconds)\n"


def test_standard_output_is_one_document_and_the_status_that_of_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Whatever code prints when it is loaded or run, and by any means."""
    prints = "print('loaded')\nclass Prints(Fine):\n    def misbehave(self):\n        os.write(1, b'run')\n"
    (tmp_path / "mine.py").write_text(PLUGINS + prints + "        0 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Frozen, "definition", short_definition(1, 1.0))
    assert main(["bench", "v1", "mine.py:Prints", "--scenes", "lane", "--jobs", "1", "--json"]) == 2
    out, err = capfd.readouterr()
    assert json.loads(out)["totals"][0]["failed"] == 1
    assert "loaded" in err and "run" in err and err.endswith("error: failed in every scene: Prints\n")


@pytest.mark.slow
def test_what_waits_delegates_or_crashes_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["Waits", "Delegates", "Interrupts", "Crashes"]
    for name, reason in board(tmp_path, monkeypatch, names, "--seeds", "1").items():
        assert reason.startswith(REASONS[name])


def test_a_cluster_has_limits_of_its_own() -> None:
    with pytest.raises(CoopenvError, match="--memory 100: with --engine ray the cluster decides"):
        find_executor("ray", mebibytes=100.0)


def test_a_worker_that_gets_no_task_ends_in_silence(capfd: pytest.CaptureFixture[str]) -> None:
    """As when its parent is interrupted before it sends one."""
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe()
    process = context.Process(target=_work, args=(other,))
    process.start()
    other.close()
    pipe.close()
    process.join(DEADLOCK)
    assert process.exitcode == 0
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")
def test_the_first_worker_is_deaf_to_ctrl_c(tmp_path: Path) -> None:
    """In a fresh process, in which nothing of `multiprocessing` runs yet."""
    (tmp_path / "first.py").write_text(
        "from coopenv.bench.executors import _Worker\n"
        "if __name__ == '__main__':\n"
        "    worker = _Worker()\n"
        "    print(open(f'/proc/{worker.process.pid}/status').read().split('SigBlk:')[1].split()[0])\n"
        "    worker.end()\n"
    )
    found = subprocess.run([sys.executable, tmp_path / "first.py"], capture_output=True, text=True, check=True)
    assert int(found.stdout, 16) & 1 << (signal.SIGINT - 1)
