"""Input that cannot be, output that no reader or disk takes, missing extras: one line and a status, nothing is left."""

from __future__ import annotations

import importlib
import io
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from coopenv.cli import options
from coopenv.cli.app import main
from coopenv.report.terminal import Terminal
from tests.helpers.processes import COOPENV, DEADLOCK, ROOT, start

AGENTS = """
import numpy as np

def shape(observations): return np.zeros((len(observations), 5))
def nan(observations): return np.full((len(observations), 2), np.nan)
def text(observations): return "left"
def none(observations): return None
def boom(observations): raise KeyError("inside")

class Init:
    def __init__(self, scenario): raise ZeroDivisionError("no")

class Leaves:
    def __init__(self, scenario): raise SystemExit(3)

class Reset:
    def __init__(self, scenario): pass
    def reset(self, mask): raise ValueError("bad reset")
    def __call__(self, observations): return np.zeros((len(observations), 2))
"""
SHORT = ["--set", "horizon=0.5"]
EVALUATE = ["evaluate", "facade", *SHORT, "--worlds", "2", "--out", "out", "--agents"]
FILM = ["film", "facade", *SHORT, "--out", "film.gif", "--agent"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "acts.py").write_text(AGENTS)
    (tmp_path / "raises.py").write_text("raise RuntimeError('at import')")
    (tmp_path / "file").touch()
    (tmp_path / "broken.toml").write_text("title = ")
    (tmp_path / "picture.toml").write_bytes(bytes([137, 80, 200, 0]))
    (tmp_path / "rosbag").mkdir()
    (tmp_path / "rosbag" / "metadata.yaml").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*EVALUATE, "acts.py:shape"], "the policy returned actions of shape (2, 5), expected (2, 2)"),
        ([*EVALUATE, "acts.py:nan"], "not finite for row 0"),
        ([*EVALUATE, "acts.py:boom"], "the policy failed at acts.py:8: KeyError: 'inside'"),
        ([*EVALUATE, "acts.py:Reset"], "the policy's reset failed at acts.py:18: ValueError: bad reset"),
        ([*EVALUATE, "acts.py:Init"], "agent 'Init' cannot be built: ZeroDivisionError: no"),
        ([*EVALUATE, "acts.py:Leaves"], "agent 'Leaves' cannot be built: SystemExit: 3"),
        ([*EVALUATE, ","], "--agents ,: names no agent"),
        ([*EVALUATE, "peek", "--set", "camera.range=nan"], "camera.range: Input should be a finite number, got nan"),
        ([*EVALUATE, "peek", "--worlds", "99999999999"], "Invalid value for '--worlds'"),
        ([*FILM, "route_follower", "--out", "nowhere/film.gif"], "folder nowhere does not exist"),
        ([*FILM, "route_follower", "--speed", "nan"], "Invalid value for '--speed'"),
        (["run", "facade", "--set", "seed=3"], "seed: unknown key; allowed: action, backend,"),
        (["bench", "observers", "overtaking", "--observers", ""], "unknown observer ''; known: "),
        (["bench", "observers", "overtaking", "--seeds", "1000", "--out", "file"], "cannot write to file"),
        (["bench", "observers", "overtaking", "--fault", ""], "fault '': expected [VEHICLE:]NAME"),
        ("run busy_intersecton", "did you mean 'busy_intersection'"),
        ("run broken.toml", "not valid TOML"),
        ("run busy_intersection --steps 0", "--steps"),
        ("run busy_intersection --seed x", "--seed"),
        ("run busy_intersection --set foo", "expected KEY=VALUE"),
        ("run busy_intersection --dtype float16", "float16"),
        ("run urban_crossing --policy rando", "did you mean 'random'"),
        ("run urban_crossing --observer mine.py", "mine.py: name a class or function in it: mine.py:Class"),
        ("run urban_crossing --horizon 5", "No such option: --horizon; a key of the scenario: --override"),
        ("run urban_crossing noise.enabled=false", "; a key of the scenario: --override noise.enabled=VALUE"),
        ("run facade.toml", "no such scenario file: facade.toml (did you mean 'facade'?)"),
        ("evaluate facade peek", "evaluate --help"),
        ("describe peek", "expected an environment, peek is an agent"),
        ("run busy_intersection --steady-from 50", "steady_from"),
        ("run busy_intersection --out file", "it is not a folder"),
        ("schema --out missing/schema.json", "cannot write to"),
        ("describe", "ENV"),
        ("list things", "things"),
        ("run ./rosbag", "rosbag: a ROS bag"),
        ("run busy_intersection --figures gif", "--figures"),
        ("run nowhere.mcap --seed 1", "no such log: nowhere.mcap"),
        ("run mrclam_6 --seed 1", "--seed: is for a simulation, mrclam_6 is recorded"),
        ("run busy_intersection --variant blind", "is for recorded data"),
        ("record mrclam_6 --seed 2 --out drive.mcap", "--seed: is for a simulation, mrclam_6 is recorded"),
        ("record mrclam_12 --data . --out drive.mcap", "unknown data set 'mrclam_12' (did you mean"),
        ("record busy_intersection --variant blind --out drive.mcap", "variant is for recorded data"),
        ("record busy_intersection --data . --out drive.mcap", "data is for recorded data"),
        ("record busy_intersection --out drive.bag", "the name must end in .mcap"),
        ("record busy_intersection --out none/drive.mcap", "folder none does not exist"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_left(
    arguments: list[str] | str, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = sorted(folder.rglob("*"))
    assert main(arguments.split() if isinstance(arguments, str) else arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and words in errors[0], errors
    assert [path for path in sorted(folder.rglob("*")) if "__pycache__" not in path.parts] == there


@pytest.mark.skipif(not os.path.ismount("/proc"), reason="needs a folder that nobody can write to")
@pytest.mark.parametrize("arguments", [[*EVALUATE, "peek"], ["run", "facade", *SHORT]])
def test_a_folder_that_cannot_be_made(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments, "--out", "/proc/nobody"]) == 2
    assert "error: cannot write to /proc/nobody" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    ["run {}", "bench observers {}", "view {}", "film {} --out film.gif", "record {} --out a.mcap", "import {}"],
)
@pytest.mark.parametrize("name", ["nosuch.bag", "nosuch.db3"])
def test_a_bag_that_does_not_exist_is_an_error(command: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command.format(name).split()) == 2
    error_text = capsys.readouterr().err
    assert f"no such bag: {name}" in error_text and "map" not in error_text and error_text.count("\n") == 1


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        process = start((*COOPENV, "list"), tmp_path, stdout=full)
        _, errors = process.communicate(timeout=DEADLOCK)
    assert (errors, process.returncode) == ("error: standard output: No space left on device\n", 2)


def test_a_closed_pipe_is_quiet(tmp_path: Path) -> None:
    reader = start(("true",), tmp_path, stdin=subprocess.PIPE)
    reader.wait()
    process = start((*COOPENV, "schema"), tmp_path, stdout=reader.stdin)
    _, errors = process.communicate(timeout=DEADLOCK)
    assert (errors, process.returncode) == ("", 141)


def test_results_are_kept_when_the_table_cannot_be_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    assert main(["run", "overtaking", "--steps", "1", "--no-figures", "--out", "x"]) == 2
    assert Path("x/metrics.json").is_file()


def test_without_any_standard_stream(tmp_path: Path) -> None:
    closed = ("bash", "-c", 'exec "$@" <&- >&- 2>&-', "bash")
    assert start((*closed, *COOPENV, "schema", "--out", "s.json"), tmp_path).wait(DEADLOCK) == 0
    assert (tmp_path / "s.json").read_text().startswith("{")


def test_a_full_disk_for_errors_changes_no_status(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        assert start((*COOPENV, "run", "nowhere"), tmp_path, stderr=full).wait(DEADLOCK) == 2


WITHOUT = """
import json, os, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

LIBRARIES = {
    "cryptography", "foxglove", "gtsam", "h5py", "highway_env", "imageio_ffmpeg", "libsumo", "lz4", "mcap", "minari",
    "moviepy", "nats", "onnx", "ray", "rosbags", "stable_baselines3", "tensorboard", "tomlkit", "torch", "torchrl",
    "viser", "zenoh", "zstandard",
}

class Filtered:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in LIBRARIES else self.finder.find_spec(name, path, target)

sys.meta_path[:] = [Filtered(finder) if hasattr(finder, "find_spec") else finder for finder in sys.meta_path]
from coopenv.cli.app import main

for command, folder in json.load(sys.stdin):
    os.chdir(folder)
    sys.argv = ["coopenv", *command.split()]
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as errors:
        status = main()
    print(json.dumps([command, status, errors.getvalue(), sorted(os.listdir(folder))]))
"""
FLEET = ROOT / "examples" / "fleet" / "overtaking.toml"
COMMANDS = {
    "view crossing_path": "view",
    "film crossing_path --out film.mp4": "video",
    "run recorded.mcap": "log",
    "import drive.bag": "log",
    "train facade --out agent": "train",
    "dataset facade": "minari",
    "describe highway_intersection": "highway",
    "run sumo_crossing": "sumo",
    "bench observers overtaking --observers factor_graph": "bench",
    "bench observers overtaking --engine ray": "ray",
    "svea demo": "svea",
    f"svea run {FLEET}": "svea",
}
"""Command to the extra that it needs."""


def metadata(name: str) -> bytes:
    """Return a record of metadata without entries."""
    content = len(name).to_bytes(4, "little") + name.encode() + bytes(4)
    return b"\x0c" + len(content).to_bytes(8, "little") + content


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, list[str]]]:
    """Return the exit status, errors and folder of every command, all run in one interpreter."""
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
        ("rllib_env", "ray.rllib.env.multi_agent_env", "rllib"),
        ("torchrl_env", "torchrl.envs", "torchrl"),
        ("benchmarl_task", "benchmarl.environments.vmas.common", "benchmarl"),
    ],
)
def test_missing_extra(module: str, needed: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, needed, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(ImportError, match=rf"^{module} needs .+: pip install '\.\[{extra}\]'$"):
        importlib.import_module(module)


def test_a_command_prints_a_limited_number_of_warnings(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(warnings, "showwarning", lambda text, *_: shown.append(text))
    with options.warned():
        for k in range(100):
            warnings.warn(f"tick {k} " + "x" * 10_000, RuntimeWarning, stacklevel=1)
    assert len(shown) == options.MOST_WARNINGS and max(map(len, shown)) < 1000
    assert capsys.readouterr().err == "warning: further warnings are not printed\n"


def test_an_output_that_own_code_has_closed_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = io.StringIO()
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(sys, "stdout", closed)
    monkeypatch.setattr(sys, "stderr", errors)
    assert main(["list", "envs"]) == 2
    assert errors.getvalue() == "error: standard output: I/O operation on closed file\n"


@pytest.mark.parametrize(("columns", "width"), [("0", 80), ("1", 80), ("19", 80), ("20", 20), ("200", 200)])
def test_widths_in_which_no_table_fits_are_not_taken(monkeypatch: pytest.MonkeyPatch, columns: str, width: int) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert Terminal(file=io.StringIO()).width == width
