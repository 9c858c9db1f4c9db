"""The command line: what it prints, writes, and refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import coopenv
from coopenv.base.installation import environment_id, list_agents
from coopenv.bench.observers.faults import FAULTS, VARIANTS
from coopenv.cli.app import failure_status, main
from coopenv.cli.options import parse_value
from coopenv.estimation.trajectory import Trajectory
from coopenv.observers.registry import list_observers
from coopenv.observers.sensed import Truth
from coopenv.runs import console
from coopenv.runs.command import Results
from coopenv.runs.recorder import record
from coopenv.sources.mcap import write_recording
from tests.helpers.commands import refused
from tests.helpers.env_suite import ALIKE, each_slow

FILES = {"metrics.json", "trajectory.npz", "scene.npz"}
FIGURES = {"errors.png", "trajectories_2d.png", "trajectories_3d.png"}
FIGURES |= {"topology.png", "consistency.png", "observability.png"}


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)


def test_list_names_every_environment_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2:]] == coopenv.list_envs()
    assert max(map(len, lines)) <= 80
    assert ["busy_intersection", "5", "3", "prescribed", "50"] in [line.split() for line in lines]


@pytest.mark.parametrize("kind", ["envs", "scenes"])
def test_narrow_lists_are_wrapped_and_not_cut(
    kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["list", kind]) == 0
    wide = capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", "40")
    assert main(["list", kind]) == 0
    narrow = capsys.readouterr().out
    assert "…" not in narrow and {*wide.split()} - {*narrow.split()} <= {max(wide.split(), key=len)}  # the rule


def test_list_of_observers_and_agents(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "observers"]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split()[0] for line in lines if not line.startswith(" ")] == list_observers()
    assert max(map(len, lines)) <= 80
    words = " ".join(" ".join(lines).split())  # wrapped, not cut
    assert words.count("estimates lasting errors of odometry and sensors, and that corrects neighbours") == 1
    assert main(["list", "agents"]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split()[0] for line in lines if not line.startswith(" ")] == list_agents()


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("list", coopenv.list_envs),
        ("list observers", list_observers),
        ("list agents", list_agents),
        (
            "list variants",
            lambda: [
                *(*VARIANTS, "landmarks", "landmarks+robots", "blind"),
                *(f"{name}={kind.value}" if kind.value else name for name, kind in FAULTS.items()),
            ],
        ),
    ],
)
def test_list_as_json(line: str, names: Callable[[], list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*line.split(), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == names()
    assert line != "list" or {row["id"] for row in rows} == {environment_id(name) for name in names()}


@pytest.mark.parametrize("name", each_slow(coopenv.list_envs(), *ALIKE))
def test_a_description_fits_one_screen(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", name]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 24
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 80
    env = coopenv.parallel_env(name)
    size = env.observation_space(env.possible_agents[0]).shape[0]
    assert f"Observation  {size} numbers per vehicle" in out
    assert environment_id(name) in out


def test_describe_starts_no_traffic_program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("coopenv.sumo.program.find_spec", lambda name: None)
    assert main(["describe", "sumo_crossing"]) == 0
    assert "6 in traffic" in capsys.readouterr().out


def test_describe_states_vehicles_and_actions(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "urban_crossing"]) == 0
    out = capsys.readouterr().out
    assert "4 driven by actions, up to 1 m/s; 4 with a goal" in out
    assert "Action       2 numbers in [-1, 1]: speed 0 to 1 m/s, steering" in out


def test_describe_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "urban_crossing", "--set", "v2x.loss=0.25", "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    env = coopenv.parallel_env("urban_crossing")
    assert described["observation_size"] == env.observation_space("vehicle_1").shape[0]
    assert list(described["observation"]) == list(env.observation_layout)
    assert described["scenario"]["v2x"]["loss"] == 0.25
    assert described["id"] == "coopenv/UrbanCrossing-v0"
    assert [entry["name"] for entry in described["action"]] == ["speed", "steering"]


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    usage = capsys.readouterr().out
    assert all(command in usage for command in ("list", "describe", "schema", "run"))
    assert main(["run", "--help"]) == 0
    assert "--steady-from" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"coopenv {coopenv.__version__}\n"


def test_run_writes_its_files_and_prints_its_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["run", "busy_intersection", "--seed", "4", "--steps", "120", "--set", "noise.enabled=false"]) == 0
    out = capsys.readouterr().out
    folder = tmp_path / "out" / "busy_intersection"
    assert {path.name for path in folder.iterdir()} == FIGURES | FILES | {"replay.html"}
    for picture in (imread(folder / name) for name in FIGURES):
        assert picture.shape[1] > 800 and picture.shape[0] > 300
        assert picture[..., :3].std() > 0.05  # not blank
    assert len(Trajectory.load(folder / "trajectory.npz").t) == 721
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (metrics["seed"], metrics["dtype"], metrics["device"]) == (4, "float64", "cpu")
    assert metrics["overrides"] == {"noise.enabled": False}
    assert metrics["steady_from_s"] == 35.0
    errors, rates = (line.split() for line in out.splitlines() if line.startswith("vehicle_1 "))
    assert [float(x) for x in errors[1:5]] == pytest.approx([11.5, 90.0, 1.32, 2.93], rel=0.01)
    assert [float(x) for x in rates[1:]] == [
        pytest.approx(metrics["vehicles"][0][column.name], rel=0.006) for column in console.RATES[1:]
    ]
    assert "vehicle_5: not observable at 0-" in out
    assert "No steady state: it would begin at 35 s" in out
    assert "stopped after the steps asked for, at 12 s" in out
    assert "Files in out/busy_intersection:" in out
    assert max(len(line) for line in out.splitlines()) <= 80


def test_run_as_json_prints_nothing_else(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["run", "overtaking", "--steps", "10", "--no-figures", "--json", "--policy", "random"]) == 0
    captured = capsys.readouterr()
    printed = json.loads(captured.out)
    assert "the policy has no effect" in captured.err
    assert printed["files"] == [f"out/overtaking/{name}" for name in ("metrics.json", "trajectory.npz", "scene.npz")]
    folder = tmp_path / "out" / "overtaking"
    assert {path.name for path in folder.iterdir()} == FILES
    assert json.loads((folder / "metrics.json").read_text()) == {k: v for k, v in printed.items() if k != "files"}


def test_figures_in_another_format_replace_the_older_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coopenv.viz.figures.FIGURE_NAMES", ("errors", "topology"))
    for option in ("--figures=png", "--figures=svg"):
        assert main(["run", "overtaking", "--steps", "5", "--out", "here", option]) == 0
    expected = {"errors.svg", "topology.svg", "replay.html"} | FILES
    assert {path.name for path in (tmp_path / "here").iterdir()} == expected
    assert "<svg" in (tmp_path / "here" / "errors.svg").read_text()


def test_recording_shows_its_progress(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coopenv.runs.console.LINE_PERIOD", 0.001)
    monkeypatch.setattr("coopenv.runs.console.ENOUGH", 0.0)
    assert main(["record", "overtaking", "--set", "horizon=5.0", "--out", "drive.mcap"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert any(re.fullmatch(r"recording: \d+ % after \d+ s, about \d+ s left", line) for line in lines)


def test_results_are_shown_where_asked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shown: list[str] = []
    monkeypatch.setattr("typer.launch", lambda path: shown.append(path) or 1)
    monkeypatch.setenv("DISPLAY", ":0")
    run = ["run", "overtaking", "--steps", "2", "--no-figures", "--out", "here", "--open"]
    board = ["bench", "observers", "overtaking", "--observers", "dead_reckoning", "--seeds", "1", "--jobs", "1"]
    assert main(run) == main([*board, "--set", "horizon=0.5", "--out", "board", "--open"]) == 0
    assert shown == ["here", "board/report.html"] and Path("board/report.html").is_file()
    assert "note: there is no program to open here" in capsys.readouterr().err
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(run) == 0 and len(shown) == 2
    assert "note: there is no display to show here on" in capsys.readouterr().err
    assert main([*board, "--open"]) == 2
    assert capsys.readouterr().err == "error: --open: the report needs a folder, --out DIR\n"


def test_a_log_file_runs_and_is_described_like_an_environment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "overtaking", "--set", "horizon=2.0", "--out", "drive.mcap"]) == 0
    assert main(["run", "drive.mcap", "--no-figures", "--steady-from", "1"]) == 0
    assert main(["run", "overtaking", "--set", "horizon=2.0", "--no-figures", "--steady-from", "1"]) == 0
    tables = [line for line in capsys.readouterr().out.splitlines() if line.startswith("vehicle_")]
    assert len(tables) == 8 and tables[:4] == tables[4:]  # errors and rates
    assert main(["describe", "drive.mcap"]) == 0
    assert "Recorded: every episode is the recording" in capsys.readouterr().out


def test_a_log_file_is_judged_where_the_truth_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    recording = record(coopenv.load_scenario("overtaking", {"horizon": 2.0}))
    for name, unknown in (("part.mcap", slice(0, 30)), ("blind.mcap", slice(None))):
        rotation, position = recording.truth.rotation.copy(), recording.truth.position.copy()
        rotation[unknown], position[unknown] = np.nan, np.nan
        write_recording(replace(recording, truth=Truth(rotation, position)), Path(name))
    assert main(["run", "part.mcap", "--steady-from", "1", "--no-figures"]) == 0
    metrics = json.loads(Path("out/part/metrics.json").read_text())
    assert all(np.isfinite(vehicle["steady_position_rmse_m"]) for vehicle in metrics["vehicles"])
    assert metrics["simulated_time_s"] == 2.0
    assert len(Trajectory.load(Path("out/part/trajectory.npz")).t) == 121
    capsys.readouterr()
    assert main(["run", "blind.mcap", "--observer", "mekf"]) == 0
    assert "No true poses, and so no errors" in capsys.readouterr().out
    metrics = json.loads(Path("out/blind/metrics.json").read_text())
    assert metrics["vehicles"] == [] and len(metrics["without_truth"]) == 2
    whole = Trajectory.load(Path("out/blind/trajectory.npz"))
    for row, end in zip(metrics["without_truth"], whole.position_estimate[-1], strict=True):
        assert 0.0 < row["position_std_m"] < 1.0 and 0.0 < row["orientation_std_deg"] < 10.0
        np.testing.assert_allclose(row["final_position_estimate_m"], end)
    assert Path("out/blind/replay.html").exists() and "No true poses" in str(Results.read("out/blind"))
    assert main(["figures", "out/blind"]) == 2
    assert "no true poses are known, which figures need" in capsys.readouterr().err
    assert main(["bench", "observers", "blind.mcap", "--observers", "mekf"]) == 2
    assert "blind: no true poses are known, which a comparison needs" in capsys.readouterr().err


def test_a_named_observer_that_always_fails_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    lines = [
        "from coopenv.observers.contract import Observer",
        "class Bad(Observer):",
        "    def __init__(self, setup):",
    ]
    lines += ["        pass", "    def reset(self, pose, covariance):", "        raise ValueError('no')"]
    lines += ["    def step(self, tick, messages):", "        raise ValueError('no')"]
    Path("bad.py").write_text("\n".join(lines))
    given = ["bench", "observers", "svea_overtaking", "--set", "horizon=1.0", "--observers", "bad.py:Bad,mekf"]
    assert main([*given, "--seeds", "1", "--jobs", "1"]) == 2
    printed = capsys.readouterr()
    assert "failed in every variant: Bad" in printed.err and "mekf" in printed.out


def test_vehicles_without_true_poses_do_not_hide_the_errors_of_others() -> None:
    recording = record(coopenv.load_scenario("overtaking", {"horizon": 2.0}))
    position = recording.truth.position.copy()
    position[:, -1] = np.nan  # of the last vehicle
    write_recording(replace(recording, truth=replace(recording.truth, position=position)), Path("half.mcap"))
    results = coopenv.run("half.mcap", steady_from=1.0)
    whole = coopenv.run("overtaking", overrides={"horizon": 2.0}, steady_from=1.0)
    rows, all_rows = results.metrics["vehicles"], whole.metrics["vehicles"]
    assert [row["vehicle"] for row in rows] == [row["vehicle"] for row in all_rows[:-1]]
    assert [row["steady_position_rmse_m"] for row in rows] == pytest.approx(
        [row["steady_position_rmse_m"] for row in all_rows[:-1]]
    )
    (other,) = results.metrics["without_truth"]
    assert other["vehicle"] == "vehicle_2" and np.isnan(other["position_std_m"])  # P of this observer is a gain


@pytest.mark.parametrize("name", ["trajectory.npz", "replay.html", "errors.png", "video.gif"])
def test_results_that_cannot_be_written_are_found_before_the_run(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coopenv.runs.films.find_spec", lambda name: None)
    monkeypatch.setattr("coopenv.runs.rollouts.Rollout.play", lambda self: pytest.fail("simulated"))
    (Path("there") / name).mkdir(parents=True)
    assert main(["run", "overtaking", "--out", "there", "--video"]) == 2
    assert capsys.readouterr().err == f"error: cannot write to there/{name}: it is a folder\n"


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_lost_observers_have_tables(capsys: pytest.CaptureFixture[str]) -> None:
    """Their figures are drawn in tests/viz/test_figures.py."""
    options = ["--set", "observer.name=dead_reckoning", "--policy", "route_follower", "--set", "horizon=8.0"]
    assert main(["run", "urban_crossing", *options, "--no-figures", "--out", "lost"]) == 0
    out = capsys.readouterr().out
    assert sum(line.startswith("vehicle_") and "never" in line for line in out.splitlines()) >= 2
    assert {path.name for path in Path("lost").iterdir()} == FILES
    assert "NaN" not in Path("lost/metrics.json").read_text()


def test_scenarios_from_a_path_and_their_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.toml").write_text(
        'title = "Mine"\nhorizon = 2.0\n[[landmarks]]\nname = "A"\nposition = [1.0, 0.0, 2.0]\n'
        "[[vehicles]]\ninitial_pose.position = [0.0, 0.0, 0.0]\n"
    )
    assert main(["run", "mine.toml", "--policy", "random", "--no-figures"]) == 0
    captured = capsys.readouterr()
    first, second = captured.err.splitlines()
    assert first.startswith("warning: only 1 landmark")
    assert second.startswith("note: all motion here is prescribed")
    assert "Mine: seed 0" in captured.out
    assert Path("out/mine/metrics.json").is_file()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("true", True),
        ("3", 3),
        ("0.5", 0.5),
        ("[1, 2]", [1, 2]),
        ('"x"', "x"),
        ("sensed", "sensed"),
        ("", ""),
        ("{a = 1}", {"a": 1}),
        ("1\nother = 2", "1\nother = 2"),
    ],
)
def test_values_are_toml_or_else_strings(text: str, value: object) -> None:
    assert parse_value(text) == value


@pytest.mark.parametrize("option", ["--set", "--override"])
def test_overrides_have_units_and_their_mistakes_are_named(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    units = [option, 'noise.bearing.scale="3 deg"', option, "noise.velocity=20 cm/s"]
    assert main(["describe", "facade", *units, option, "dynamics.max_speed=54"]) == 0
    out, err = capsys.readouterr()
    assert "0.05236 rad" in out and "noise 0.2 m/s" in out
    line = "dynamics.max_speed: 54 m/s is implausible (expected magnitude 0 to 30): km/h or mm/s in place of m/s?"
    assert line in " ".join(err.split())
    assert refused("describe", "facade", option, "camera.range=5 kg").endswith("allowed: m, mm, cm, km\n")


def test_a_module_that_is_not_installed_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert failure_status(ModuleNotFoundError("No module named 'scipy'", name="scipy")) == 2
    assert re.fullmatch(r"error: needs the module scipy, .*: pip install .*\n", capsys.readouterr().err)
    with pytest.raises(ModuleNotFoundError):
        failure_status(ModuleNotFoundError(name="coopenv.nowhere"))
