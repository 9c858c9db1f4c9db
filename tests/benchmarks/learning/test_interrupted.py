"""`python -m benchmarks.learning` in processes of its own: agents with cards, and going on after kill -9."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")
pytest.importorskip("tensorboard", reason="needs the extra 'train'")

import coopenv
from coopenv.policies import find_agent, load_agent
from coopenv.training.settings import read_settings
from tests.helpers.processes import start, wait_until

pytestmark = [pytest.mark.train, pytest.mark.slow]
STUDY = 'settings = "train.toml"\nenvironments = ["open_square"]\narms = ["quality", "plain"]\nseeds = [1, 2]\n'
SETTINGS = """
steps = 2000
scenario.horizon = 6.0
[ppo]
vehicles = 16
decisions = 25
minibatches = 2
[evaluation]
every = 800
worlds = 2
final_worlds = 4
[arms.quality]
scenario.reward.weights.position_uncertainty = 2.0
[arms.plain]
scenario.reward.weights.position_uncertainty = 0.0
"""
COMMAND = (sys.executable, "-m", "benchmarks.learning", "study.toml", "--worlds", "4", "--jobs", "2", "--logs", "logs")


@pytest.fixture(autouse=True)
def study(tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text(SETTINGS)
    (tmp_path / "study.toml").write_text(STUDY)


def killed_as_soon_as(path: Path, folder: Path, *more: str) -> None:
    """Kill the command as soon as a file is there."""
    process = start((*COMMAND, *more), folder)
    wait_until(lambda: path.is_file() or process.poll() is not None)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def trained(folder: Path, *more: str) -> str:
    """Return what the command prints."""
    process = start((*COMMAND, *more), folder)
    printed, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return printed


def test_interrupted_goes_on_and_leaves_every_agent_with_its_card(tmp_path: Path) -> None:
    killed_as_soon_as(tmp_path / "open_square_quality" / "card.md", tmp_path)
    early = (tmp_path / "open_square_quality" / "seed_1" / "weights.safetensors").stat().st_mtime_ns
    assert "open_square_plain" in trained(tmp_path)
    assert (tmp_path / "open_square_quality" / "seed_1" / "weights.safetensors").stat().st_mtime_ns == early
    for arm in ("quality", "plain"):
        folder = tmp_path / f"open_square_{arm}"
        assert not list(folder.rglob("checkpoint*"))
        card = json.loads((folder / "card.json").read_text())
        study = card["study"]
        merits = {seed: entry["merit"] for seed, entry in study["seeds"].items()}
        assert sorted(merits) == ["1", "2"]
        assert str(study["best"]) == max(merits, key=lambda seed: merits[seed])
        assert card["environments"]["open_square"]["results"] == study["seeds"][str(study["best"])]["results"]
        assert "(best)" in (folder / "card.md").read_text()
        agent = find_agent(folder)
        assert (agent.name, agent.kind, agent.environments) == (folder.name, "learned", ("open_square",))
        load_agent(folder, coopenv.load_scenario("open_square"))
        again = read_settings(folder / "train.toml")
        assert again.scenario["reward.weights.position_uncertainty"] == (0.0 if arm == "plain" else 2.0)
        assert f"--seed {study['best']}" in (folder / "card.md").read_text()
    page = (tmp_path / "README.md").read_text()
    assert page.count("## open_square") == 1 and "`open_square_quality` against `open_square_plain`: e50" in page


def test_settings_that_changed_train_anew_what_was_finished(tmp_path: Path) -> None:
    for steps, only in (("2000", "1"), ("2400", "plain,1")):
        (tmp_path / "train.toml").write_text(SETTINGS.replace("2000", steps))
        trained(tmp_path, "--only", only)
        assert read_settings(tmp_path / "open_square_plain" / "train.toml").steps == int(steps)
        page = (tmp_path / "README.md").read_text()
        assert "`open_square_plain`" in page
        assert ("`open_square_quality`" in page) == (only == "1")  # else it is to be trained anew


def test_settings_that_changed_train_anew_what_was_interrupted(tmp_path: Path) -> None:
    agent = tmp_path / "open_square_plain"
    kept = agent / "seed_1" / "checkpoint.safetensors"
    killed_as_soon_as(kept, tmp_path, "--only", "plain,1")
    (tmp_path / "train.toml").write_text(SETTINGS.replace("2000", "3000"))
    trained(tmp_path, "--only", "plain,1")
    assert read_settings(agent / "train.toml").steps == 3000
    assert not kept.exists()


def test_what_cannot_be_trained_is_reported_before_anything_is(tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text(
        SETTINGS + '[environments.open_square]\nscenario.observation.exclude = ["map"]\nclone.agent = "peek"\n'
    )
    process = start(COMMAND, tmp_path)
    _, errors = process.communicate(timeout=100)
    assert process.returncode == 2
    assert "open_square_quality/seed_1: agent 'peek' cannot be built: the observation lacks map_position" in errors
    assert not list(tmp_path.glob("open_square_*"))
