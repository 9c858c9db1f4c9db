"""Output that no reader or disk takes, and missing extras: one line and a status, never a traceback."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.processes import COOPENV, DEADLOCK, ROOT, start


@pytest.mark.parametrize("arguments", [["list"], ["schema"], ["--help"]])
def test_a_full_disk_is_one_line(arguments: list[str], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        process = start((*COOPENV, *arguments), tmp_path, stdout=full)
        _, errors = process.communicate(timeout=DEADLOCK)
    assert (errors, process.returncode) == ("error: standard output: No space left on device\n", 2)


@pytest.mark.parametrize("arguments", [["list"], ["schema"], ["--version"]])
def test_a_closed_pipe_is_quiet(arguments: list[str], tmp_path: Path) -> None:
    reader = start(("true",), tmp_path, stdin=subprocess.PIPE)
    reader.wait()
    process = start((*COOPENV, *arguments), tmp_path, stdout=reader.stdin)
    _, errors = process.communicate(timeout=DEADLOCK)
    assert (errors, process.returncode) == ("", 141)


def test_results_are_kept_when_the_table_cannot_be_printed(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        command = (*COOPENV, "run", "overtaking", "--steps", "1", "--no-figures", "--out", "x")
        process = start(command, tmp_path, stdout=full)
        process.communicate(timeout=DEADLOCK)
    assert process.returncode == 2
    assert (tmp_path / "x" / "metrics.json").is_file()


def test_without_any_standard_stream(tmp_path: Path) -> None:
    closed = ("bash", "-c", 'exec "$@" <&- >&- 2>&-', "bash")
    for arguments, status in ((["list"], 0), (["nothing"], 2), (["schema", "--out", "s.json"], 0)):
        assert start((*closed, *COOPENV, *arguments), tmp_path).wait(DEADLOCK) == status
    assert (tmp_path / "s.json").read_text().startswith("{")


def test_a_full_disk_for_errors_changes_no_status(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        assert start((*COOPENV, "run", "nowhere"), tmp_path, stderr=full).wait(DEADLOCK) == 2


def test_names_that_are_no_text_are_printed(tmp_path: Path) -> None:
    strict = ("env", "PYTHONIOENCODING=ascii:strict")
    process = start((*strict, *COOPENV, "schema", "--out", "none\udcff/s.json"), tmp_path)
    _, errors = process.communicate(timeout=DEADLOCK)
    assert process.returncode == 2
    assert errors == "error: cannot write to none\\udcff/s.json: folder none\\udcff does not exist\n"


def test_a_terminal_without_width_still_shows_tables(tmp_path: Path) -> None:
    process = start(("env", "COLUMNS=0", *COOPENV, "list"), tmp_path)
    out, _ = process.communicate(timeout=DEADLOCK)
    assert "busy_intersection" in out


WITHOUT = """
import json, os, subprocess, sys

LIBRARIES = {
    "cryptography", "foxglove", "gtsam", "h5py", "highway_env", "imageio_ffmpeg", "lz4", "mcap", "minari", "moviepy",
    "nats", "onnx", "ray", "rosbags", "stable_baselines3", "tensorboard", "tomlkit", "torch", "torchrl", "viser",
    "zenoh", "zstandard",
}

class Filtered:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in LIBRARIES else self.finder.find_spec(name, path, target)

sys.meta_path[:] = [Filtered(finder) if hasattr(finder, "find_spec") else finder for finder in sys.meta_path]
import coopenv.api.engine
import coopenv.policies
import coopenv.runs.demo
import coopenv.runs.dataset
import coopenv.runs.live
from coopenv.cli import main

for command, folder in json.load(sys.stdin):
    if os.fork() == 0:
        os.chdir(folder)
        os.dup2(os.open("/dev/null", os.O_WRONLY), 1)
        os.dup2(os.open(folder + ".errors", os.O_WRONLY | os.O_CREAT), 2)
        sys.argv = ["coopenv", *command.split()]
        os._exit(main())  # what ends at an exit is not asked for, and takes longer than the command
    status = os.waitstatus_to_exitcode(os.wait()[1])
    print(json.dumps([command, status, open(folder + ".errors").read(), sorted(os.listdir(folder))]))
"""
FLEET = ROOT / "examples" / "fleet" / "overtaking.toml"
COMMANDS = {
    "view crossing_path": "view",
    "film crossing_path --out film.mp4": "video",
    "run recorded.mcap": "log",
    "describe recorded.mcap": "log",
    "film recorded.mcap --out film.gif": "log",
    "run drive.bag --map topics.toml": "log",
    "import drive.bag": "log",
    "record crossing_path --out new.mcap": "log",
    "bench observers recorded.mcap": "log",
    "train facade --out agent": "train",
    "dataset facade": "minari",
    "describe highway_intersection": "highway",
    "bench observers overtaking --observers factor_graph": "bench",
    "bench observers overtaking --engine ray": "ray",
    "svea demo": "svea",
    "svea router": "svea",
    f"svea fake {FLEET} --car svea7": "svea",
    f"svea run {FLEET}": "svea",
    f"svea keys {FLEET} --out keys": "svea",
    f"svea health {FLEET} --car svea7": "svea",
}
"""Command to the extra that it needs."""


def metadata(name: str) -> bytes:
    """Return a record of metadata without entries."""
    content = len(name).to_bytes(4, "little") + name.encode() + bytes(4)
    return b"\x0c" + len(content).to_bytes(8, "little") + content


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, list[str]]]:
    """Return the exit status, errors and folder of every command, each run in a fork of one interpreter."""
    orders = []
    for number, command in enumerate(COMMANDS):
        folder = tmp_path_factory.getbasetemp() / f"extras_{number}"
        folder.mkdir()
        (folder / "drive.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(64))
        (folder / "drive.bag").write_bytes(b"#ROSBAG V2.0\n")
        (folder / "topics.toml").write_text('environment = "crossing_path"\ncars = [{ name = "svea7" }]\n')
        (folder / "recorded.mcap").write_bytes(b"\x89MCAP0\r\n" + metadata("coopenv-drive"))
        orders.append((command, str(folder)))
    program = [sys.executable, "-c", WITHOUT]
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(program, input=json.dumps(orders), stdout=subprocess.PIPE, text=True, env=variables)
    return {command: rest for command, *rest in map(json.loads, result.stdout.splitlines())}


@pytest.mark.parametrize("command", COMMANDS)
def test_one_line_names_the_extra(command: str, done: dict[str, tuple[int, str, list[str]]]) -> None:
    status, errors, names = done[command]
    assert (status, errors.count("\n")) == (2, 1), errors
    assert f"pip install '.[{COMMANDS[command]}]'" in errors
    assert names == ["drive.bag", "drive.mcap", "recorded.mcap", "topics.toml"]


@pytest.mark.parametrize(
    ("module", "needed", "extra"),
    [
        ("coopenv.api.trainers.sb3", "stable_baselines3.common.vec_env", "train"),
        ("coopenv.api.trainers.rllib", "ray.rllib.env.multi_agent_env", "rllib"),
        ("coopenv.api.trainers.torchrl", "torchrl.envs", "torchrl"),
        ("coopenv.api.trainers.benchmarl", "benchmarl.environments.pettingzoo.common", "benchmarl"),
    ],
)
def test_missing_extra(module: str, needed: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, needed, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(ImportError, match=rf"^{module} needs .+: pip install '\.\[{extra}\]'$"):
        importlib.import_module(module)
