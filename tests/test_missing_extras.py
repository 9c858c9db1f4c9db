"""Without an extra, commands and trainers say in one line which one to install."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys

import pytest

from tests.helpers.processes import ROOT

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
