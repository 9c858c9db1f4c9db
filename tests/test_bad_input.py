"""Agents that misbehave, places that cannot be written, numbers that are none: one line, and nothing is left behind."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import coopenv
from coopenv.cli import main
from coopenv.runs.rollouts import rollout

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
WATCH = ["watch", "--env", "facade", *SHORT, "--out", "film"]


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
        ([*EVALUATE, "acts.py:text"], "the policy returned no array of numbers, but 'left'"),
        ([*EVALUATE, "acts.py:none"], "the policy returned actions of shape (), expected (2, 2)"),
        ([*EVALUATE, "acts.py:boom"], "the policy failed at acts.py:8: KeyError: 'inside'"),
        ([*EVALUATE, "acts.py:Reset"], "the policy's reset failed at acts.py:18: ValueError: bad reset"),
        ([*EVALUATE, "acts.py:Init"], "agent 'Init' cannot be built: ZeroDivisionError: no"),
        ([*EVALUATE, "acts.py:Leaves"], "agent 'Leaves' cannot be built: SystemExit: 3"),
        ([*EVALUATE, ","], "--agents ,: names none"),
        ([*EVALUATE, "peek", "--set", "camera.range=nan"], "camera.range: Input should be a finite number, got nan"),
        ([*EVALUATE, "peek", "--out", "file"], "cannot write to file: it is not a folder"),
        ([*EVALUATE, "peek", "--worlds", "99999999999"], "Invalid value for '--worlds'"),
        ([*WATCH, "acts.py:boom"], "the policy failed at acts.py:8"),
        ([*WATCH, "route_follower", "--out", "file"], "cannot write to file: it is not a folder"),
        (["watch", "route_follower", "--speed", "nan"], "Invalid value for '--speed'"),
        (["play", "facade", "--others", "nobody"], "unknown policy 'nobody'"),
        (["page", "facade", "--out", "file"], "cannot write to file"),
        (["page", "facade", "busy_intersection", "--measure"], "there is nothing to drive"),
        (["page", "raises.py"], "unknown environment 'raises.py'"),
        (["run", "facade", "--set", "seed=3"], "seed: unknown key; allowed: action, backend,"),
        (["bench", "observers", "overtaking", "--observers", ""], "unknown observer ''; known: "),
        (["bench", "observers", "overtaking", "--seeds", "1000", "--out", "file"], "cannot write to file"),
        (["bench", "observers", "overtaking", "--fault", ""], "fault '': expected [VEHICLE:]NAME"),
        ("run busy_intersecton", "did you mean 'busy_intersection'"),
        ("run nowhere.toml", "no such scenario file: nowhere.toml"),
        ("run broken.toml", "not valid TOML"),
        ("run busy_intersection --steps 0", "--steps"),
        ("run busy_intersection --seed x", "--seed"),
        ("run busy_intersection --seed -1", "--seed"),
        ("run busy_intersection --set foo", "expected KEY=VALUE"),
        ("run busy_intersection --set =3", "expected KEY=VALUE"),
        ("run busy_intersection --set noise.enabld=false", "did you mean 'enabled'"),
        ("run busy_intersection --set horizon=nan", "horizon"),
        ("run busy_intersection --set vehicles.9.goal=1", "no entry '9'"),
        ("run busy_intersection --dtype float16", "float16"),
        ("run busy_intersection --device tpu", "tpu"),
        ("run urban_crossing --policy rando", "did you mean 'random'"),
        ("run busy_intersection --steady-from 50", "steady_from"),
        ("run busy_intersection --out file", "it is not a folder"),
        ("run busy_intersection --out file/below", "cannot write to"),
        ("schema --out missing/schema.json", "cannot write to"),
        ("describe", "ENV"),
        ("list things", "things"),
        ("run ./rosbag", "rosbag: a ROS bag"),
        ("describe picture.toml", "picture.toml: not a text file"),
        ("run busy_intersection --figures gif", "--figures"),
        ("run nowhere.mcap", "nowhere.mcap"),
        ("run nowhere.mcap --seed 1", "--seed: is for a simulation, nowhere.mcap is recorded"),
        ("run busy_intersection --variant blind", "is for recorded data"),
        ("run busy_intersection --bogus", "--bogus"),
        ("frobnicate", "frobnicate"),
        ("record mrclam_6 --seed 2 --out drive.mcap", "--seed: is for a simulation, mrclam_6 is recorded"),
        ("record mrclam_12 --data . --out drive.mcap", "unknown data set 'mrclam_12' (did you mean"),
        ("record mrclam_6 --variant blnd --data . --out drive.mcap", "did you mean 'blind'"),
        ("record busy_intersection --variant blind --out drive.mcap", "--variant blind: is for recorded data"),
        ("record busy_intersection --data . --out drive.mcap", "--data .: is for recorded data"),
        ("record busy_intersectoin --out drive.mcap", "did you mean 'busy_intersection'"),
        ("record busy_intersection --out drive.bag", "the name must end in .mcap"),
        ("record busy_intersection --out none/drive.mcap", "folder none does not exist"),
    ],
)
def test_one_line_and_nothing_is_left(
    arguments: list[str] | str, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = sorted(folder.rglob("*"))
    assert main(arguments.split() if isinstance(arguments, str) else arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and words in errors[0], errors
    assert [path for path in sorted(folder.rglob("*")) if "__pycache__" not in path.parts] == there


@pytest.mark.skipif(not os.path.ismount("/proc"), reason="needs a folder that nobody can write to")
@pytest.mark.parametrize("arguments", [[*EVALUATE, "peek"], [*WATCH, "peek"], ["page", "facade"]])
def test_a_folder_that_cannot_be_made(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments, "--out", "/proc/nobody"]) == 2
    assert "error: cannot write to /proc/nobody" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    ["run {}", "bench observers {}", "view {}", "film {} --out film.gif", "record {} --out a.mcap", "import {}"],
)
@pytest.mark.parametrize("name", ["nosuch.bag", "nosuch.db3"])
def test_a_bag_that_does_not_exist_is_told_so(command: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command.format(name).split()) == 2
    told = capsys.readouterr().err
    assert f"no such bag: {name}" in told and "map" not in told and told.count("\n") == 1


def test_a_scenario_goes_where_a_name_goes() -> None:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 1.0})
    env = coopenv.parallel_env(scenario, overrides={"noise.enabled": False}, observer="dead_reckoning")
    made = env.engine.backend.scenario
    assert made.observer.name == "dead_reckoning" and not made.noise.enabled
    assert env.metadata["name"] == f"{scenario.title}_v0"
    assert len(rollout(scenario, steps=2).t) == len(rollout("overtaking", steps=2).t)
    batch = coopenv.make_vec(scenario, num_worlds=2, overrides={"horizon": 0.5})
    assert batch.num_envs == 2 * len(scenario.vehicles)
    assert coopenv.load_scenario(scenario) is scenario
    with pytest.raises(coopenv.CoopenvError, match=r"^overrides \(--set\): noise\.enabeld: unknown key .*did you mean"):
        coopenv.parallel_env(scenario, overrides={"noise.enabeld": False})
    with pytest.raises(coopenv.CoopenvError, match=r"^environment: expected a name or a path, got a Scenario"):
        coopenv.compare(["riccati"], scenario, seeds=1)  # type: ignore[arg-type]
