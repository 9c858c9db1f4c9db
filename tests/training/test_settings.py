"""Settings of a training: defaults, arms, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

import coopenv
from coopenv.training.settings import Plan, read_settings

FILE = """
steps = 1000
[scenario]
reward.weights.position_error = 0.1
"rates.decision" = 5.0
[ppo]
vehicles = 8
[environments.open_square]
scenario.reward.weights.position_error = 0.2
ppo = { gamma = 0.8 }
arms.blind = { steps = 3000, scenario = { camera.range = 0.7 } }
[arms.blind]
steps = 2000
scenario = { camera.range = 0.5, "reward.weights.position_error" = 0.0 }
ppo = { gamma = 0.9 }
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "train.toml"
    path.write_text(FILE)
    return path


def test_defaults() -> None:
    settings = read_settings(None)
    assert settings.budget == (2_000_000, None)
    assert (settings.ppo.vehicles, settings.ppo.decisions, settings.ppo.hidden) == (512, 64, (128, 128))
    assert settings.clone is None


def test_tables_and_dotted_keys_are_the_same(path: Path) -> None:
    settings = read_settings(path)
    assert settings.scenario == {"reward.weights.position_error": 0.1, "rates.decision": 5.0}
    assert (settings.ppo.vehicles, settings.ppo.gamma) == (8, 0.99)


def test_an_arm_changes_what_it_names(path: Path) -> None:
    settings = read_settings(path, "blind")
    assert settings.scenario == {
        "reward.weights.position_error": 0.0,
        "rates.decision": 5.0,
        "camera.range": 0.5,
    }
    assert (settings.steps, settings.ppo.vehicles, settings.ppo.gamma) == (2000, 8, 0.9)


def test_an_environment_goes_before_all_and_an_arm_before_it(path: Path) -> None:
    here, blind = (read_settings(path, arm, "open_square") for arm in (None, "blind"))
    assert (here.scenario["reward.weights.position_error"], here.ppo.gamma, here.steps) == (0.2, 0.8, 1000)
    assert (blind.scenario["reward.weights.position_error"], blind.ppo.gamma, blind.steps) == (0.0, 0.9, 3000)
    assert blind.scenario["camera.range"] == 0.7  # what the arm changes here only
    assert read_settings(path, None, "facade") == read_settings(path)


def test_the_command_line_goes_before_the_file(path: Path) -> None:
    assert read_settings(path, steps=7).budget == (7, None)
    plan = Plan("urban_crossing", read_settings(path), 3, None, {"rates.decision": 10.0})
    assert plan.all_overrides["rates.decision"] == 10.0


def test_a_plan_survives_as_plain_data(path: Path) -> None:
    plan = Plan("urban_crossing", read_settings(path, "blind"), 3, "blind", {"horizon": 9.0})
    assert Plan.of_document(plan.document()) == plan
    with pytest.raises(coopenv.CoopenvError, match="not the plan of a training"):
        Plan.of_document({"environment": "x"})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[ppo]\nvehicls = 3", r"train\.toml: ppo\.vehicls: unknown key \(did you mean 'vehicles'\?\)"),
        ("[ppo]\ngamma = 1.5", r"train\.toml: ppo\.gamma: Input should be less than 1, got 1\.5"),
        ("[ppo]\nvehicles = 1\ndecisions = 1", r"train\.toml: ppo\.decisions: one decision of one vehicle"),
        ("[ppo]\nhidden = []", r"train\.toml: ppo\.hidden: .*at least 1"),
        ("[clone]\nepisodes = 3", r"train\.toml: clone\.agent: Field required"),
        ("steps = 10\nminutes = 1", r"train\.toml: steps and minutes: give one of them"),
        ("scenario = 3", r"train\.toml: scenario: expected a table"),
        ("[environments.facade]\narms = 3", r"train\.toml: environments\.facade\.arms: expected tables by name"),
        ("arms = 3", r"train\.toml: arms: expected tables by name"),
        ("steps = ", r"train\.toml: not valid TOML"),
    ],
)
def test_mistakes_are_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "train.toml"
    path.write_text(text)
    with pytest.raises(coopenv.CoopenvError, match=message):
        read_settings(path, environment="facade")


def test_missing_file_and_unknown_arm(path: Path) -> None:
    with pytest.raises(coopenv.CoopenvError, match=r"no arm 'blnd' \(did you mean 'blind'\?\); known: blind"):
        read_settings(path, "blnd")
    path.write_text(FILE.replace("arms.blind =", "arms.blnd ="))
    with pytest.raises(coopenv.CoopenvError, match=r"no arm 'blnd' \(did you mean 'blind'\?\)"):
        read_settings(path, environment="open_square")
    with pytest.raises(coopenv.CoopenvError, match=r"nowhere\.toml: cannot be read \(No such file"):
        read_settings(path.with_name("nowhere.toml"))
