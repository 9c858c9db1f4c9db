"""Settings of a training: defaults, arms, and what is refused in one line; its files beside an agent."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

import coopenv
from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.installation import data_directory
from coopenv.policies import find_agent
from coopenv.scenario import load_scenario
from coopenv.training.settings import (
    Ppo,
    Settings,
    TrainingPlan,
    check_settings,
    continued_settings,
    environment_file,
    read_settings,
    settings_digest,
    usual_settings,
    write_settings,
)

HERE = environment_file("urban_crossing")

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
    assert (settings.steps, settings.minutes) == (2_000_000, None)
    assert (settings.ppo.vehicles, settings.ppo.decisions, settings.ppo.hidden) == (512, 64, (128, 128))
    assert settings.clone is None


def test_by_default_a_training_begins_as_the_planner_if_that_can_drive() -> None:
    settings = usual_settings("open_square", {}, steps=None)
    shipped = read_settings(data_directory("agents") / "train.toml", "quality", "open_square")
    assert settings.right_of_way and settings.evaluation.every == settings.steps // 8
    assert settings.model_copy(update={"right_of_way": False, "evaluation": shipped.evaluation}) == shipped
    assert not usual_settings("facade", {}).right_of_way, "a single vehicle gives way to none"
    assert settings.clone and settings.clone.agent == "look_ahead" and settings.variations and settings.randomised
    capped = usual_settings("open_square", {}, minutes=2.0)
    assert (capped.minutes, capped.steps) == (2.0, shipped.steps), "minutes stop a training, and do not plan it"
    further = usual_settings("open_square", {}, start="my_driver", steps=80)
    assert (further.start, further.clone, further.evaluation.every) == ("my_driver", None, 10)
    blind = usual_settings("open_square", {"observation.exclude": ["map_position"]}, start="my_driver")
    assert not blind.right_of_way, "the rule needs the map"
    assert usual_settings("open_square", {"observation.exclude": ["map"]}) == read_settings(None)
    assert usual_settings("large_crossing", {}).scenario == {}, "its reward is its own"


def test_a_clone_alone_is_continued_in_small_steps_and_others_as_they_were(tmp_path: Path) -> None:
    folder = data_directory("agents")
    team = read_settings(folder / "train.toml", "team", "lighthouse")
    path = tmp_path / "clone.toml"
    path.write_text("steps = 0\nppo.hidden = [64, 64]\nclone.agent = 'team_look_ahead'\n")
    clone = continued_settings(path, "lighthouse", start="mine")
    assert (clone.steps, clone.start, clone.clone) == (team.steps, "mine", None)
    assert clone.ppo == team.ppo.model_copy(update={"hidden": (64, 64)}) and clone.evaluation == team.evaluation
    assert clone.scenario == team.scenario == {} and clone.variations == team.variations == ()
    own = tmp_path / "train.toml"
    own.write_text(
        "steps = 0\nright_of_way = true\nclone.agent = 'peek'\nrandomised.randomisation.camera_range = [0.5, 2.0]\n"
        "variations = [{ share = 0.5, scenario.sensing = 'ideal' }]\nscenario.reward.weights.progress = 3.0\n"
    )
    kept = continued_settings(own, "open_square", start="mine", steps=9)
    here = read_settings(folder / "train.toml", "team", "open_square")
    assert (kept.right_of_way, kept.steps, kept.scenario, kept.ppo.gae_lambda) == (True, 9, here.scenario, 0.99)
    assert (len(kept.variations), kept.variations[0].share, len(kept.randomised)) == (1, 0.5, 1), "as it was cloned"
    path = folder / "facade_quality" / "train.toml"
    learnt = continued_settings(path, "facade", start="facade_quality", steps=7)
    assert learnt == read_settings(path, start="facade_quality", steps=7)


def test_an_agent_beside_the_settings_is_their_start(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = data_directory("agents") / "relay_team"
    assert read_settings(folder / "train.toml").start == str(folder / "first")
    monkeypatch.chdir(folder)
    assert read_settings(Path("train.toml")).start == "first"
    assert read_settings(Path("train.toml"), start="peek").start == "peek"


VARIED = """
randomised.randomisation.camera_range = [0.5, 2.0]
variations = [{ share = 0.25, scenario.camera.model = "omnidirectional" }]
"""


def test_shares_of_the_worlds_to_learn_in_differ(tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text(VARIED)
    plan = TrainingPlan("facade", read_settings(tmp_path / "train.toml"), 0)
    (usual, most), (round_about, some) = plan.scenarios(16)
    assert (most, some) == (12, 4)
    assert usual.randomisation.camera_range == round_about.randomisation.camera_range == (0.5, 2.0)
    assert (usual.camera.model, round_about.camera.model) == ("pinhole", "omnidirectional")
    assert plan.all_overrides == {}, "held-out worlds are as the environment's"
    assert [count for _, count in TrainingPlan("facade", read_settings(None), 0).scenarios(16)] == [16]


@pytest.mark.parametrize(
    ("overrides", "error"),
    [
        ({"observation.map_size": 2}, "changes the meaning of entries: map_"),
        ({"observation.planar": False}, "changes the meaning of entries: goal"),
        ({"dynamics.max_speed": 3.0}, "changes the meaning of entries: .*dynamics.max_speed"),
        ({"rates.decision": 5.0}, "changes the meaning of entries: rates.decision"),
        ({"vehicles.0.motion.driver": "peek"}, "changes the meaning of entries: driven vehicles"),
        ({"camera.range": -1}, "camera.range"),
    ],
)
def test_worlds_to_learn_in_mean_what_those_to_be_judged_in_mean(overrides: dict[str, object], error: str) -> None:
    for changed in ({"variations": ({"share": 0.1, "scenario": overrides},)}, {"randomised": overrides}):
        with pytest.raises(CoopenvError, match=error):
            TrainingPlan("facade", Settings.model_validate(changed), 0).scenarios(8)


def test_tables_and_dotted_keys_are_the_same(path: Path) -> None:
    settings = read_settings(path)
    assert settings.scenario == {"reward.weights.position_error": 0.1, "rates.decision": 5.0}
    assert (settings.ppo.vehicles, settings.ppo.gamma) == (8, None)


def test_the_discount_follows_from_the_horizon() -> None:
    """Without a given one, the last decision of an episode weighs 1 / e for the first."""
    platoon = load_scenario("scout_platoon")
    decisions = platoon.horizon * platoon.rates.decision
    discount = Ppo().discount(platoon)
    assert discount == 1.0 - 1.0 / decisions and discount**decisions == pytest.approx(np.exp(-1.0), rel=2e-3)
    short = load_scenario("scout_platoon", {"horizon": 0.1})
    assert 0.0 < Ppo().discount(short) < 1.0 and Ppo(gamma=0.9).discount(platoon) == 0.9


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
    assert read_settings(path, steps=7, minutes=2.0).steps == 7
    path.write_text(FILE + "[clone]\nagent = 'peek'\n")
    assert read_settings(path).clone and read_settings(path, start="my_driver").clone is None
    plan = TrainingPlan("urban_crossing", read_settings(path), 3, None, {"rates.decision": 10.0})
    assert plan.all_overrides["rates.decision"] == 10.0


def test_a_plan_survives_as_plain_data(path: Path) -> None:
    plan = TrainingPlan("urban_crossing", read_settings(path, "blind"), 3, "blind", {"horizon": 9.0})
    plain = TypeAdapter(TrainingPlan).dump_python(plan, mode="json")
    assert TypeAdapter(TrainingPlan).validate_python(json.loads(json.dumps(plain))) == plan


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[ppo]\nvehicls = 3", r"train\.toml: ppo\.vehicls: unknown key \(did you mean 'vehicles'\?\)"),
        ("[ppo]\ngamma = 1.5", r"train\.toml: ppo\.gamma: Input should be less than 1, got 1\.5"),
        ("[ppo]\nvehicles = 1\ndecisions = 1", r"train\.toml: ppo\.decisions: one decision of one vehicle"),
        ("[ppo]\nhidden = []", r"train\.toml: ppo\.hidden: .*at least 1"),
        ("[clone]\nepisodes = 3", r"train\.toml: clone\.agent: Field required"),
        ("start = 'mine'\nclone.agent = 'peek'", r"a training begins as an agent or as a \[clone\], give one of them"),
        ("scenario = 3", r"train\.toml: scenario: expected a table"),
        ("[environments.facade]\narms = 3", r"train\.toml: environments\.facade\.arms: expected tables by name"),
        ("network = 'sets'", r"'sets' learns by a clone alone: set clone\.agent and steps = 0"),
        ("steps = 0\nclone = { agent = 'peek', elsewhere = ['facade'] }", r"clone\.elsewhere: only with network = 'se"),
        ("network = 'graph'", r"network: .*'sets'"),
        ("steps = 0", r"steps: 0 is for a clone alone"),
        ("variations = [{ share = 0.8, scenario = {} }, { share = 0.3, scenario = {} }]", r"add up to more than 1"),
        ("evaluation.final_worlds = 1", r"evaluation\.final_worlds: .*greater than 1"),
    ],
)
def test_mistakes_are_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "train.toml"
    path.write_text(text)
    with pytest.raises(coopenv.CoopenvError, match=message) as caught:
        read_settings(path, environment="facade")
    assert "\n" not in str(caught.value)


def test_missing_file_and_unknown_arm(path: Path) -> None:
    with pytest.raises(coopenv.CoopenvError, match=r"no arm 'blnd' \(did you mean 'blind'\?\); known: blind"):
        read_settings(path, "blnd")
    path.write_text(FILE.replace("arms.blind =", "arms.blnd ="))
    with pytest.raises(coopenv.CoopenvError, match=r"no arm 'blnd' \(did you mean 'blind'\?\)"):
        read_settings(path, environment="open_square")
    with pytest.raises(coopenv.CoopenvError, match=r"nowhere\.toml: cannot be read \(No such file"):
        read_settings(path.with_name("nowhere.toml"))


# Settings beside an agent: the user's own are never lost


MINE = """# my own words
steps = 3000
scenario.horizon = 6.0 # short
[ppo]
vehicles = 16
[arms.long]
steps = 9000
"""
REFUSED = r"train\.toml: no agent's, and this training has other settings: name another folder with --out, or move it"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """Return a folder with settings of the user's."""
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "train.toml").write_bytes(MINE.replace("\n", "\r\n").encode())
    return tmp_path / "old"


@pytest.fixture
def new(tmp_path: Path) -> Path:
    pytest.importorskip("tomlkit", reason="needs the extra 'train'")
    (tmp_path / "new").mkdir()
    return tmp_path / "new"


def plan_of(folder: Path, arm: str | None = None, **changes: int) -> TrainingPlan:
    return TrainingPlan(
        "urban_crossing", read_settings(folder / "train.toml", arm, "urban_crossing", **changes), 5, arm, {}
    )


def finish(folder: Path, plan: TrainingPlan) -> None:
    """Leave in a folder what a training writes of its settings there."""
    write_settings(folder, folder / "nothing", plan, HERE)
    (folder / "agent.toml").write_text(f'[training]\nsettings = "{settings_digest(plan)}"\n')


def test_settings_of_the_user_stay_byte_for_byte(old: Path, new: Path) -> None:
    write_settings(new, old, plan_of(old), HERE)
    assert (new / "train.toml").read_bytes() == (old / "train.toml").read_bytes()


@pytest.mark.parametrize(("arm", "changes"), [("long", {}), (None, {"steps": 10})])
def test_with_other_options_it_is_refused(arm: str | None, changes: dict[str, int], old: Path, new: Path) -> None:
    plan = plan_of(old, arm, **changes)
    for refuse in (lambda: check_settings(old, plan, HERE), lambda: write_settings(new, old, plan, HERE)):
        with pytest.raises(OutputError, match=REFUSED):
            refuse()


def test_overrides_are_among_the_settings_and_what_cannot_be_read_is_the_users(old: Path) -> None:
    plan = TrainingPlan("urban_crossing", read_settings(old / "train.toml"), 5, None, {"horizon": 6.0})
    check_settings(old, plan, HERE)
    with pytest.raises(OutputError, match=REFUSED):
        check_settings(old, replace(plan, overrides={"horizon": 7.0}), HERE)
    (old / "train.toml").write_text("steps = ")
    with pytest.raises(OutputError, match=REFUSED):
        check_settings(old, plan, HERE)


def test_settings_of_a_replaced_agent_are_replaced(old: Path, new: Path) -> None:
    plan = plan_of(old)
    finish(new, plan)
    assert read_settings(new / "train.toml") == plan.settings
    other = plan_of(old, steps=10)
    newer = new / "newer"
    newer.mkdir()
    write_settings(newer, new, other, HERE)
    assert read_settings(newer / "train.toml") == other.settings


def test_settings_of_an_agent_are_the_user_s_once_changed(old: Path, new: Path) -> None:
    plan, other = plan_of(old), plan_of(old, steps=10)
    finish(new, plan)
    with (new / "train.toml").open("a") as file:
        file.write("# gamma = 0.9 was worse\n")
    check_settings(new, plan, HERE)
    with pytest.raises(OutputError, match=REFUSED):
        check_settings(new, other, HERE)
    (old / "agent.toml").write_text("[training]\nseed = 5\n")
    check_settings(old, other, HERE)


def test_a_link_stays_a_link(old: Path, new: Path) -> None:
    (old / "train.toml").rename(old.parent / "mine.toml")
    (old / "train.toml").symlink_to("../mine.toml")
    write_settings(new, old, plan_of(old), HERE)
    assert (new / "train.toml").readlink() == Path("../mine.toml")


# The environment's file as it goes with the agent that has learnt in it


SQUARE = data_directory("envs") / "open_square.toml"


def test_a_shipped_environment_goes_by_its_name() -> None:
    assert environment_file("open_square") == ("open_square", "open_square", None, {})


@pytest.mark.parametrize(
    ("given", "name"),
    [("my_square.toml", "my_square.toml"), ("train.toml", "environment.toml"), ("agent.toml", "environment.toml")],
)
def test_a_file_goes_as_it_is_and_hides_no_other_of_the_agent(given: str, name: str, tmp_path: Path) -> None:
    (tmp_path / given).write_text(SQUARE.read_text())
    assert environment_file(str(tmp_path / given)) == (Path(given).stem, name, SQUARE.read_text(), {})


def test_code_that_it_names_goes_with_the_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tomlkit", reason="needs the extra 'train'")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "factors.py").write_text("FACTOR = 0.0\n")
    (tmp_path / "mine" / "terms.py").write_text(
        "from factors import FACTOR\n\ndef calm(q):\n    return FACTOR * q.speed\n"
    )
    text = SQUARE.read_text()
    assert "[reward]\n" in text
    text = text.replace("[reward]\n", '[reward]\ncustom.calm = "../mine/terms.py:calm"\nweights.calm = 1.0\n')
    (tmp_path / "mine" / "square.toml").write_text(text)
    kept = environment_file(str(tmp_path / "mine" / "square.toml"))
    assert kept.text == text.replace("../mine/", "") and {*kept.code} == {"terms.py", "factors.py"}
    monkeypatch.chdir(tmp_path / "mine")
    overrides = {"reward.custom.calm": "terms.py:calm", "reward.weights.calm": 1.0}
    assert environment_file("facade", overrides).code == kept.code
    (tmp_path / "terms.py").write_text("")
    with pytest.raises(CoopenvError, match="one folder must hold both"):
        environment_file("square.toml", {"reward.custom.calm": "../terms.py:calm"})


def test_an_agent_names_files_of_its_folder(tmp_path: Path) -> None:
    card = 'title = "x"\ndescription = "x"\nentry = "mine.py:Mine"\nenvironments = ["square.toml", "facade"]\n'
    (tmp_path / "agent.toml").write_text(card)
    assert find_agent(tmp_path).environments == (str(tmp_path / "square.toml"), "facade")


@pytest.mark.parametrize("name", ["pilot_team", "relay_team"])
def test_an_agent_that_a_training_begins_as_lies_in_its_folder(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """There the command of the card is given."""
    monkeypatch.chdir(data_directory("agents") / name)
    settings = read_settings(Path("train.toml"))
    assert settings.start == "first"
    first, whole = find_agent(settings.start), find_agent(name)
    assert first.network and whole.network and first.network.observation == whole.network.observation
    assert first.training["steps"] > 0 and whole.training["command"].endswith(f"--seed {whole.training['seed']}")
