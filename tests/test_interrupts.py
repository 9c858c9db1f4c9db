"""Signals end commands with their workers, and say what was kept."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from coopenv.base import interrupts
from tests.helpers.env_suite import rest_slow
from tests.helpers.processes import COOPENV, DEADLOCK, group_of, start, wait_until, workers_of

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")

RUN = (*COOPENV, "run", "busy_intersection", "--out", "result")
BENCH = (*COOPENV, "bench", "observers", "busy_intersection", "--observers", "riccati,mekf", "--seeds", "8")
BENCH += ("--jobs", "2", "--out", "result")
STATUS = {signal.SIGHUP: 129, signal.SIGINT: 130, signal.SIGTERM: 143}


def begun(folder: Path) -> bool:
    return any(path.suffix == ".part" for path in folder.iterdir())


@pytest.mark.parametrize(("number", "earlier"), [(signal.SIGHUP, False), (signal.SIGTERM, True)])
def test_a_run_ends_with_one_line(number: signal.Signals, earlier: bool, tmp_path: Path) -> None:
    if earlier:
        (tmp_path / "result").mkdir()
        (tmp_path / "result" / "metrics.json").write_text("earlier")
    process = start(RUN, tmp_path)
    wait_until(lambda: begun(tmp_path))
    process.send_signal(number)
    out, errors = process.communicate(timeout=DEADLOCK)
    assert (out, process.returncode) == ("", STATUS[number])
    lines = [line for line in errors.splitlines() if not line.startswith("compiling")]
    ends = f"interrupted; {'kept: result of an earlier run' if earlier else 'nothing written'}"
    assert lines == [*(["overwrites an earlier result in result"] if earlier else []), ends]
    assert [path.name for path in tmp_path.iterdir()] == (["result"] if earlier else [])
    assert not earlier or (tmp_path / "result" / "metrics.json").read_text() == "earlier"


@pytest.mark.parametrize(
    ("number", "whole_group"),
    rest_slow([(signal.SIGINT, True), (signal.SIGTERM, False), (signal.SIGKILL, False)], 0, 2),
)
def test_workers_end_with_their_parent(number: signal.Signals, whole_group: bool, tmp_path: Path) -> None:
    process = start(BENCH, tmp_path)
    wait_until(lambda: len(workers_of(process.pid)) == 2)
    (os.killpg if whole_group else os.kill)(process.pid, number)
    out, errors = process.communicate(timeout=DEADLOCK)
    assert (out, process.returncode) == ("", STATUS.get(number, -number))
    assert number == signal.SIGKILL or errors == "interrupted; nothing written\n"
    wait_until(lambda: not group_of(process.pid))
    assert number == signal.SIGKILL or list(tmp_path.iterdir()) == []


def script(folder: Path, text: str) -> tuple[str, str, int]:
    """Run a script with signals caught; return what it writes, what it complains of, and its exit status."""
    first = "import ctypes, os, signal, threading\nfrom coopenv.base import files, interrupts\n"
    first += "interrupts.install()\n"
    process = start((sys.executable, "-c", first + text), folder)
    out, errors = process.communicate(timeout=DEADLOCK)
    return out, errors, process.returncode


def test_a_hanging_call_is_ended(tmp_path: Path) -> None:
    out, errors, status = script(
        tmp_path,
        "with files.replacing_folder('result', ['a']):\n"
        "    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()\n"
        "    signal.pthread_sigmask(signal.SIG_BLOCK, interrupts.SIGNALS)\n"  # the call below goes on, as compilers do
        "    ctypes.CDLL(None).sleep(1000)\n",
    )
    assert (out, errors, status) == ("", "interrupted; nothing written\n", 143)
    assert list(tmp_path.iterdir()) == []


def test_code_that_swallows_the_interruption_is_ended(tmp_path: Path) -> None:
    _, errors, status = script(
        tmp_path,
        "class Swallowing:\n"
        "    def __del__(self): os.kill(os.getpid(), signal.SIGINT); print('after')\n"
        "Swallowing()\n"
        "while True:\n"
        "    try: signal.pause()\n"
        "    except KeyboardInterrupt: pass\n",
    )
    assert (errors, status) == ("interrupted; nothing written\n", 130)


def test_a_result_is_put_in_place_before_the_end(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "a").write_text("old")
    _, errors, status = script(
        tmp_path,
        "swap = files.exchange\n"
        "def slow(*paths): os.kill(os.getpid(), signal.SIGTERM); print('held', flush=True); swap(*paths)\n"
        "files.exchange = slow\n"
        "try:\n"
        "    with files.replacing_folder('result', ['a']) as new: (new / 'a').write_text('new')\n"
        "    print('not reached')\n"
        "except KeyboardInterrupt: interrupts.end(interrupts.report())\n",
    )
    assert (errors, status) == ("interrupted; written: result\n", 143)
    assert (tmp_path / "result" / "a").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_held_code_is_not_interrupted_without_a_signal() -> None:
    with interrupts.held(), interrupts.held():
        pass
    assert not interrupts.received()
