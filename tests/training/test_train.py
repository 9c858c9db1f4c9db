"""`coopenv train` in processes of their own: an agent at the end, and a clean resume after whatever comes between."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import sys
from contextlib import chdir, redirect_stdout
from hashlib import sha256
from io import StringIO
from pathlib import Path
from subprocess import Popen
from time import monotonic

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")
pytest.importorskip("tensorboard", reason="needs the extra 'train'")

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.cli.app import main
from coopenv.policies import find_agent, load_agent
from coopenv.policies.loader import read_card
from coopenv.training.command import Course, Reports, possible, train
from coopenv.training.ranking import Ranking
from coopenv.training.settings import Ppo, TrainingPlan, read_settings
from coopenv.training.trainer import Trainer
from tests.helpers.processes import COOPENV, start, wait_until

pytestmark = pytest.mark.train
SETTINGS = """
steps = 3000
scenario.horizon = 6.0
randomised.randomisation.camera_range = [0.8, 2.0]
variations = [{ share = 0.25, scenario.sensing = "ideal" }]
[ppo]
vehicles = 16
decisions = 25
minibatches = 2
epochs = 2
[evaluation]
every = 800
worlds = 2
final_worlds = 4
drivers = ["peek"]
"""
STEPS = [800, 1600, 2400, 3200]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "train.toml").write_text(SETTINGS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(*more: str) -> list[str]:
    return ["train", "urban_crossing", "--out", "agent", "--threads", "1", *more]


def fresh(*more: str) -> list[str]:
    return command("--settings", "train.toml", "--seed", "5", *more)


def begun(folder: Path, words: list[str]) -> Popen[str]:
    """Return a training once it has its first checkpoint."""
    process = start((*COOPENV, *words), folder)
    path = folder / "agent" / "checkpoint.safetensors"
    wait_until(lambda: path.is_file() or process.poll() is not None)
    assert path.is_file(), process.communicate()[1]
    return process


def killed(folder: Path, words: list[str]) -> None:
    """Kill a training once it has its first checkpoint."""
    process = begun(folder, words)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def resumed(folder: Path, *words: str) -> str:
    """Resume a training, and return what it prints as errors."""
    process = start((*COOPENV, *(words or command()), "--resume"), folder)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return errors


def finished(folder: Path) -> dict[str, np.ndarray]:
    """Return the weights of a whole agent in a folder."""
    names = {path.name for path in folder.iterdir()}
    assert names >= {"agent.toml", "weights.safetensors", "train.toml", "curve.csv", "tensorboard"}
    assert "checkpoint.safetensors" not in names
    load_agent(folder, coopenv.load_scenario("urban_crossing"))
    return load_file(folder / "weights.safetensors")


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the agent of a training that nothing interrupted."""
    folder = tmp_path_factory.mktemp("reference")
    (folder / "train.toml").write_text(SETTINGS)
    with chdir(folder), redirect_stdout(StringIO()) as printed:
        assert main(fresh("--json")) == 0
    document = json.loads(printed.getvalue())
    metrics = {row["metric"]: row for row in document["results"]}
    assert sorted(document["ranking"]) == ["agent", "peek"], "nothing was cloned"
    assert metrics["e95_m"]["ci_low"] <= metrics["e95_m"]["mean"] <= metrics["e95_m"]["ci_high"]
    return folder / "agent"


def test_leaves_an_agent(reference: Path) -> None:
    finished(reference)
    agent = find_agent(reference)
    assert (agent.kind, agent.environments) == ("learned", ("urban_crossing",))
    card = read_card(reference)
    assert card.training["command"] == "coopenv train urban_crossing --settings train.toml --seed 5"
    assert {"return", "arrival_rate", "collision_rate", "e50_m", "e95_m"} <= set(card.results["figures"])
    with (reference / "curve.csv").open(encoding="utf-8") as file:
        assert [int(row["steps"]) for row in csv.DictReader(file)] == STEPS
    assert list((reference / "tensorboard").glob("events.*"))
    again = read_settings(reference / "train.toml")
    assert (again.steps, again.ppo.vehicles, again.scenario) == (3000, 16, {"horizon": 6.0})
    assert again.variations[0].scenario == {"sensing": "ideal"}
    seen = card.network.seen if card.network else {}
    assert -1.0 <= seen["position_std"][0] < seen["position_std"][1] <= 1.0


def same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    assert set(first) == set(second)
    for name, values in first.items():
        assert values == pytest.approx(second[name], abs=1e-5), name


@pytest.mark.slow
def test_killed_and_resumed_learns_the_same(here: Path, reference: Path) -> None:
    """After kill -9 just behind a checkpoint, the rest of the training is what it would have been."""
    process = start((*COOPENV, *fresh()), here)
    log: list[str] = []
    assert process.stderr is not None
    for line in process.stderr:
        log.append(line)
        if "1,600 steps, held-out maps" in line:  # the checkpoint before, of 800 steps, is whole in any case
            os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "".join(log)
    assert (here / "agent" / "checkpoint.safetensors").is_file()
    assert not (here / "agent" / "agent.toml").exists()
    assert main(fresh()) == 2  # it does not begin anew by mistake
    assert " 800 steps" not in resumed(here)  # at most what came after the last checkpoint was done twice
    same(finished(here / "agent"), finished(reference))


@pytest.mark.slow
def test_further_files_are_written_after_resuming(here: Path) -> None:
    pytest.importorskip("onnx", reason="needs the extra 'onnx'")
    killed(here, fresh("--onnx", "--logs", "logs"))
    before = len(list((here / "logs").glob("events.*")))
    resumed(here)
    assert (here / "agent" / "policy.onnx").is_file()
    assert len(list((here / "logs").glob("events.*"))) == before + 1
    assert not (here / "agent" / "tensorboard").exists()


@pytest.mark.slow
def test_a_training_that_diverges_ends_in_one_line_and_keeps_its_checkpoint(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "train.toml").write_text(SETTINGS.replace("[ppo]", "[ppo]\nlearning_rate = 1e9"))
    for arguments in (fresh(), command("--resume")):
        assert main(arguments) == 2
        *_, error_text = capsys.readouterr().err.splitlines()
        assert error_text.startswith("error: the training diverged: after ")
        assert f"ppo.learning_rate = {1e9}" in error_text
        assert "agent/checkpoint.safetensors is kept as it was after 0 steps" in error_text
        assert not (here / "agent" / "agent.toml").exists()


@pytest.mark.slow
def test_the_agent_of_a_file_of_ones_own_takes_it_along(here: Path) -> None:
    """Its environment is found, and the command on its card trains once more, when nothing but its folder is left."""
    source = coopenv.base.installation.data_directory("envs") / "open_square.toml"
    mine = here / "elsewhere" / "my_square.toml"
    mine.parent.mkdir()
    mine.write_text(source.read_text())
    options = ["--settings", "train.toml", "--steps", "400", "--threads", "1", "--out", "agent"]
    assert main(["train", "elsewhere/my_square.toml", *options]) == 0
    mine.unlink()
    agent = find_agent("agent")
    assert coopenv.load_scenario(agent.environments[0]) == coopenv.load_scenario("open_square")
    card = read_card(here / "agent")
    assert card.title == "Learned driver of my_square"
    again = (*COOPENV, *shlex.split(card.training["command"])[1:], "--out", "../again")
    assert start(again, here / "agent").wait(300) == 0
    same(load_file(here / "again" / "weights.safetensors"), load_file(here / "agent" / "weights.safetensors"))


@pytest.mark.slow
def test_worlds_of_highway_env_begin_anew_where_a_killed_training_goes_on(here: Path) -> None:
    """Their state is objects, which no checkpoint holds."""
    pytest.importorskip("highway_env", reason="needs the extra 'highway'")
    (here / "small.toml").write_text(SETTINGS.replace("= 6.0", "= 3.0").replace("vehicles = 16", "vehicles = 4"))
    training = ["train", "highway_roundabout", "--out", "agent"]
    killed(here, [*training, "--settings", "small.toml", "--steps", "300"])
    resumed(here, *training)
    load_agent(here / "agent", coopenv.load_scenario("highway_roundabout"))


def test_an_interrupted_training_names_its_checkpoint(here: Path) -> None:
    process = begun(here, fresh())
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "checkpoint.safetensors" in errors.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("left", [0, 100, 20_000])
def test_a_truncated_checkpoint_is_one_line(left: int, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    killed(here, fresh())
    path = here / "agent" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:left])
    assert main(command("--resume")) == 2
    error_text = capsys.readouterr().err
    assert error_text.startswith("error: agent/checkpoint.safetensors: damaged, or not a checkpoint")
    assert error_text.count("\n") == 1


@pytest.mark.slow
def test_nothing_to_resume_and_options_that_cannot_change(
    here: Path, reference: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command("--resume")) == 2
    assert "error: nothing to resume: there is no agent/checkpoint.safetensors\n" in capsys.readouterr().err
    assert main(command("--resume", "--seed", "1", "--steps", "5")) == 2
    assert "leave out --seed, --steps" in capsys.readouterr().err
    assert main(["train", "urban_crossing", "--out", str(reference), "--resume"]) == 2
    assert "holds a finished agent and no checkpoint" in capsys.readouterr().err
    killed(here, fresh())
    assert main(["train", "overtaking", "--out", "agent", "--resume"]) == 2
    assert "agent holds a training of urban_crossing, not of overtaking" in capsys.readouterr().err


@pytest.mark.slow
def test_a_full_disk_keeps_the_last_checkpoint(here: Path, reference: Path) -> None:
    """Files larger than 64 kB cannot be written: the first checkpoint fails in one line, and nothing is left."""
    limited = ["bash", "-c", 'ulimit -f 64; exec "$@"', "bash"]
    process = start((*limited, *COOPENV, *fresh()), here)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert errors.splitlines()[-1].startswith("error: cannot write to agent/checkpoint.safetensors")
    assert not (here / "agent" / "agent.toml").exists()
    killed(here, fresh())
    before = (here / "agent" / "checkpoint.safetensors").read_bytes()
    process = start((*limited, *COOPENV, *command("--resume")), here)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2 and "cannot write to agent/checkpoint.safetensors" in errors
    assert (here / "agent" / "checkpoint.safetensors").read_bytes() == before
    resumed(here)
    same(finished(here / "agent"), finished(reference))


@pytest.mark.slow
def test_an_environment_that_changed_since(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = coopenv.base.installation.data_directory("envs") / "urban_crossing.toml"
    (here / "mine.toml").write_text(source.read_text())
    killed(here, ["train", "mine.toml", "--settings", "train.toml", "--out", "agent"])
    (here / "mine.toml").write_text(source.read_text().replace("range = 6.0", "range = 5.0"))
    assert main(["train", "mine.toml", "--out", "agent", "--resume"]) == 2
    assert "mine.toml has changed since; remove the file to start anew" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "overtaking"], "all motion is prescribed or has a driver, there is nothing to learn"),
        (["train", "urban_crossing", "--from", "peek"], "start: peek is no policy that PPO learns"),
        (["train", "urban_crossing", "--from", "facade_quality"], "it was trained with another observation"),
        (["train", "open_square", "--from", "general"], "start: general is no policy that PPO learns"),
        (
            ["train", "facade", "--from", "facade_quality", "--settings", "clip.toml"],
            "start: facade_quality needs ppo.observation_clip = 6, got 5",
        ),
        (["train", "urban_crossing", "--agent", "route_follower"], "--agent route_follower: there is no train.toml"),
        (["train", "urban_crossing", "--agent", "route_follower", "--settings", "train.toml"], "give one of them"),
        (["train", "urban_crossing", "--arm", "x"], "no arm 'x'; known: none"),
        (
            ["train", "facade", "--settings", "rule.toml", "--override", "observation.include=['estimate']"],
            "right_of_way: the observation lacks axis_std",
        ),
        (["train", "facade", "--settings", "alone.toml"], "alone: the observation lacks message_mask"),
        (["train", "urban_crossing", "--settings", "wrong.toml"], "alone: unknown agent 'nobody'"),
        (["train", "urban_crossing", "--settings", "own.toml"], "alone: unknown agent 'mine.py:Mine'"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], message: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, line in (
        ("rule", "right_of_way = true"),
        ("alone", "alone = 'peek'"),
        ("wrong", "alone = 'nobody'"),
        ("own", "alone = 'mine.py:Mine'"),
        ("clip", "ppo.observation_clip = 5.0"),
    ):
        (here / f"{name}.toml").write_text(line)
    assert main(arguments) == 2
    error_text = capsys.readouterr().err
    assert message in error_text and error_text.count("\n") == 1


@pytest.mark.parametrize(
    ("threads", "logs", "extra", "message"),
    [
        (0, None, "", "threads must be at least 1"),
        (1, "a_file", "", "cannot write to a_file: "),
        (1, "a_file/logs", "", "cannot write to a_file/logs: "),
        (1, None, "vehicles = 100_000_000", "would need"),
        (1, None, "[clone]\nagent = 'nobody'", "unknown agent 'nobody'"),
        (1, None, "[evaluation]\ndrivers = ['pek']", "unknown driver .* 'pek' .did you mean 'peek'"),
    ],
)
def test_a_training_that_cannot_begin_leaves_nothing(
    threads: int, logs: str | None, extra: str, message: str, here: Path
) -> None:
    (here / "a_file").write_text("")
    (here / "bad.toml").write_text(f"[ppo]\n{extra}\n")
    before = {path.name for path in here.iterdir()}
    plan = TrainingPlan("urban_crossing", read_settings(here / "bad.toml"), 0, None, {})
    with pytest.raises(CoopenvError, match=message):
        train(plan, Path("new", "agent"), threads=threads, logs=None if logs is None else Path(logs))
    assert {path.name for path in here.iterdir()} == before


def test_an_agent_that_is_there_stays(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "agent").mkdir()
    (here / "agent" / "agent.toml").write_text("mine")
    assert main(fresh()) == 2
    assert capsys.readouterr().err == "error: agent/agent.toml: exists already; --force replaces the agent\n"
    assert [path.name for path in (here / "agent").iterdir()] == ["agent.toml"]


@pytest.mark.slow
def test_a_forced_training_replaces_an_agent_and_its_cards_at_its_end(here: Path) -> None:
    (here / "agent").mkdir()
    for name in ("agent.toml", "card.json", "card.md", "mine.py"):
        (here / "agent" / name).write_text("mine")
    killed(here, fresh("--force"))
    assert {(here / "agent" / name).read_text() for name in ("agent.toml", "card.json", "card.md")} == {"mine"}
    resumed(here)
    finished(here / "agent")
    assert (here / "agent" / "mine.py").read_text() == "mine"
    assert not list((here / "agent").glob("card.*"))


@pytest.mark.slow
def test_settings_in_the_agents_folder_stay_as_the_user_wrote_them(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "agent").mkdir()
    mine = here / "agent" / "train.toml"
    mine.write_text(f"# my own words\n{SETTINGS.replace('3000', '400')}")
    before = mine.read_bytes()
    own = command("--settings", "agent/train.toml")
    assert main([*own, "--steps", "800"]) == 2
    assert capsys.readouterr().err.startswith("error: agent/train.toml: no agent's, and this training has other")
    assert [path.name for path in (here / "agent").iterdir()] == ["train.toml"]
    for arguments in (own, [*own, "--force"]):
        assert main(arguments) == 0
        assert mine.read_bytes() == before
    assert read_card(here / "agent").training["steps"] == 400


def test_without_onnx_no_training_begins(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(CoopenvError, match="--onnx needs the package onnx"):
        train(TrainingPlan("urban_crossing", read_settings(here / "train.toml"), 0), Path("agent"), onnx=True)
    assert not (here / "agent").exists()


def test_a_clone_alone_is_an_agent(here: Path) -> None:
    (here / "train.toml").write_text(
        "steps = 0\nalone = 'stop_when_lost'\nclone = { agent = 'peek', episodes = 1, epochs = 2 }\n"
        + SETTINGS.split("\n", 2)[2]
    )
    assert main(fresh()) == 0
    card = read_card(here / "agent")
    assert card.network and card.network.alone == "stop_when_lost"
    assert card.training["steps"] == 0 and card.network and card.network.seen
    assert not (here / "agent" / "checkpoint.safetensors").exists()
    (here / "agent").rename(here / "first")
    settings = read_settings(here / "first" / "train.toml", start=str(here / "first"), steps=400)
    settings = settings.model_copy(update={"ppo": settings.ppo.model_copy(update={"initial_std": 0.07})})
    plan = TrainingPlan("urban_crossing", settings, 6)
    trainer = Trainer(plan, possible(plan), threads=1)
    trainer.begin()
    assert np.exp(trainer.tensors()["log_std"]) == pytest.approx(0.07), "no exploration was learnt"


CLONED = SETTINGS.replace("steps = 3000", "steps = 800").replace("every = 800", "every = 400")
CLONED += "[clone]\nagent = 'route_follower'\nepisodes = 2\nepochs = 2\n"


def trained(folder: Path, text: str, **options: object) -> tuple[dict[str, np.ndarray], Ranking]:
    """Return the weights of a training by some settings, and its rank."""
    (folder / "own.toml").write_text(text)
    found: list[Ranking] = []
    plan = TrainingPlan("urban_crossing", read_settings(folder / "own.toml", **options), 5)
    train(plan, folder / "agent", threads=1, force=True, reports=Reports(ranked=found.append))
    return load_file(folder / "agent" / "weights.safetensors"), found[0]


def test_weights_do_not_depend_on_the_clock(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a machine that is 10,000 times as slow, a checkpoint follows every update, and the agent is the same."""
    weights, _ = trained(here, CLONED, minutes=1e9)
    monkeypatch.setattr("coopenv.training.trainer.monotonic", lambda: 1e4 * monotonic())
    slow, ranking = trained(here, CLONED, minutes=1e9)
    assert not [note for note in ranking.notes if "minutes" in note]
    for name, values in weights.items():
        assert np.array_equal(values, slow[name]), name


def test_findings_survive_in_a_checkpoint() -> None:
    """Where no vehicle arrives, the travel time is not a number."""
    course = Course(curve=[{"steps": 800, "travel_time_s": np.nan}], drivers={"peek": {"travel_time_s": np.nan}})
    again = Course.model_validate(json.loads(course.model_dump_json()))
    assert repr(again) == repr(course)


def test_a_clone_that_learning_makes_worse_is_kept(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every later policy arrives less often in the worlds for validation, so the agent is the clone."""
    looks = iter([0.9, 0.5, 0.4, 0.3])
    key = "coopenv.training.command.ranking_key"
    seen: dict[int, float] = {}
    monkeypatch.setattr(key, lambda row: (-seen.setdefault(row["steps"], next(looks, 0.0)), 0.0))
    weights, ranking = trained(here, CLONED)
    clone, _ = trained(here, CLONED.replace("steps = 800", "steps = 0"))
    for name, values in clone.items():
        assert np.array_equal(values, weights[name]), name
    assert {*ranking.drivers} == {"route_follower", "peek", "clone", "agent"}
    own, begun = (ranking.drivers[name]["e95_m"] for name in ("agent", "clone"))
    assert own == pytest.approx(begun, rel=1e-4)
    assert ranking.notes == ("Kept: the policy after 0 steps, the best in the worlds for validation",)
    last, ranking = trained(here, CLONED.replace("every = ", 'keep = "last"\nevery = '))
    assert not np.array_equal(last["layers.0.weight"], clone["layers.0.weight"]) and ranking.notes == ()


def test_minutes_stop_a_training_with_a_note(here: Path) -> None:
    _, ranking = trained(here, SETTINGS, minutes=1e-6)
    assert ranking.notes == ("Stopped by --minutes 1e-06 after 400 of 3,000 steps: another load gives another agent",)


def test_a_training_continues_an_agent_with_its_critic(here: Path) -> None:
    """An agent of before has no critic: a new one is learnt, while the policy begins as it was."""
    before, _ = trained(here, SETTINGS.replace("steps = 3000", "steps = 400"))
    (here / "agent").rename(here / "first")
    settings = read_settings(here / "first" / "train.toml", start=str(here / "first"))
    plan = TrainingPlan("urban_crossing", settings, 6)
    trainer = Trainer(plan, possible(plan), threads=1)
    trainer.begin()
    after = trainer.tensors()
    assert trainer.notes == [] and {*after} == {*before}
    for name, values in before.items():
        assert "layers" not in name or np.array_equal(after[name], values), name
    assert after["critic.counts"][0] == pytest.approx(before["critic.counts"][0]), "the policy sees what it has learnt"
    without_critic(here / "first")
    trainer = Trainer(plan, possible(plan), threads=1)
    trainer.begin()
    assert "was saved without a critic" in trainer.notes[0]
    assert after["layers.1.weight"] == pytest.approx(trainer.tensors()["layers.1.weight"])
    assert after["critic.layers.1.weight"] != pytest.approx(trainer.tensors()["critic.layers.1.weight"], abs=1e-3)
    other = TrainingPlan("urban_crossing", settings.model_copy(update={"ppo": Ppo(hidden=(8,))}), 6)
    with pytest.raises(CoopenvError, match=r"first has not the widths ppo\.hidden = \[8\]"):
        Trainer(other, possible(other), threads=1).begin()


def without_critic(folder: Path) -> None:
    """Leave an agent as an earlier version saved it."""
    path, card = folder / "weights.safetensors", folder / "agent.toml"
    digest = sha256(path.read_bytes()).hexdigest()
    save_file({name: v for name, v in load_file(path).items() if not name.startswith("critic.")}, path)
    card.write_text(card.read_text().replace(digest, sha256(path.read_bytes()).hexdigest()))
