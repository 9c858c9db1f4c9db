"""Executors: order, single threads, a cluster that is not there, and a real one of two nodes."""

from __future__ import annotations

import importlib.util
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import ONE_THREAD
from coopenv.bench.executors import Local, ProcessLimits, find_executor, reach

THREADS = list(ONE_THREAD)


def square(x: int) -> int:
    return x * x


def threads(x: int) -> list[int | str | None]:
    return [x, *(os.environ.get(name) for name in THREADS)]


def test_results_come_in_the_order_of_the_tasks() -> None:
    done: list[int] = []
    assert Local(1).map(square, range(7), done.append) == [x * x for x in range(7)]
    assert done == list(range(1, 8))


def test_processes_compute_with_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS[0], "7")
    monkeypatch.delenv(THREADS[1], raising=False)
    assert Local(2).map(threads, range(4), lambda _: None) == [[x] + ["1"] * len(THREADS) for x in range(4)]
    assert os.environ[THREADS[0]] == "7" and THREADS[1] not in os.environ


def test_one_job_is_this_process_unless_limits_are_given() -> None:
    assert find_executor("local", 1) == Local(1)
    assert find_executor("local", 2) == Local(2, ProcessLimits())
    assert find_executor("local", 1, seconds=5.0) == Local(1, ProcessLimits(seconds=5.0))


def test_what_cannot_be_sent_to_a_process_is_reported() -> None:
    with pytest.raises(CoopenvError, match="or use --jobs 1"):
        Local(2).map(lambda x: x, [lambda: None] * 2, lambda _: None)


def test_a_process_that_dies_is_reported() -> None:
    with pytest.raises(CoopenvError, match="a process died"):
        Local(2).map(os._exit, [1, 1], lambda _: None)


def test_nobody_listens() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound but not listening: nobody else takes it, and nobody answers
        with pytest.raises(CoopenvError, match="no Ray cluster at"):
            reach(f"127.0.0.1:{taken.getsockname()[1]}")
    for wrong in ("127.0.0.1", "127.0.0.1:port", ":1"):
        with pytest.raises(CoopenvError, match="expected HOST:PORT"):
            reach(wrong)


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_ray_is_not_installed() -> None:
    with pytest.raises(CoopenvError, match=r"pip install '\.\[ray\]'"):
        find_executor("ray")


CLUSTER = """
set -e
ip link set lo up
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH=$PWD/token RAY_BACKEND_LOG_LEVEL=fatal
"$PYTHON" -c "import secrets; print(secrets.token_hex(32), end='')" > token
ray="$PYTHON -m ray.scripts.scripts"
quiet="--num-cpus 1 --disable-usage-stats"
$ray start --head --port 6399 --include-dashboard=false --temp-dir "$PWD/ray" $quiet >head.log 2>&1
$ray start --address 127.0.0.1:6399 $quiet >second.log 2>&1
"$PYTHON" -c "import ray; ray.init('127.0.0.1:6399'); print(len(ray.nodes()))" 2>nodes.log
run="$PYTHON -m coopenv bench observers overtaking --observers riccati,mekf --variants nominal,v2x_loss"
run="$run --seeds 3 --set horizon=1.0"
$run --engine ray --address 127.0.0.1:6399 --out ray_board
$run --jobs 2 --out local_board
"""
"""Two nodes that nothing outside can reach: a network with the loopback alone, and processes that end with it."""

ALONE = ["unshare", "-n", "-p", "-f", "--mount-proc", "--kill-child"]


def _alone() -> bool:
    try:
        return subprocess.run([*ALONE, "ip", "link", "set", "lo", "up"], capture_output=True).returncode == 0
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra ray")
@pytest.mark.skipif(not _alone(), reason="needs the right to make a network of its own")
def test_two_nodes_give_the_local_table(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = Path(tmp_path_factory.mktemp("r"))
    environment = {**os.environ, "PYTHON": sys.executable}
    done = subprocess.run(
        [*ALONE, "bash", "-c", CLUSTER], cwd=folder, env=environment, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[0] == "2"
    boards = [json.loads((folder / name / "leaderboard.json").read_text()) for name in ("ray_board", "local_board")]
    for board in boards:
        assert len(board["rows"]) == 2 * 2 * 2
        for row in board["rows"]:
            del row["us_per_update"]
    assert boards[0] == boards[1]
