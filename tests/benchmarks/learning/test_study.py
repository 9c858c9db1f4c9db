"""A study's file, the part of it that is chosen, and the judge of its agents."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any
from weakref import ref

import pytest

from benchmarks.learning.judge import Judge
from benchmarks.learning.study import Study, place_of, read_study
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import data_directory
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, score

STUDY = """
settings = "train.toml"
environments = ["open_square", "facade"]
arms = ["quality", "plain"]
seeds = [1, 7]
treatment = ["scenario.reward.*", "ppo.gamma"]
"""
SETTINGS = """
steps = 1000
[arms.quality]
[arms.plain]
scenario.reward.weights.position_uncertainty = 0.0
ppo.gamma = 0.9
"""


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "train.toml").write_text(SETTINGS)
    (tmp_path / "study.toml").write_text(STUDY)
    return read_study(tmp_path / "study.toml")


def test_every_agent_has_its_first_run_before_any_has_its_second(study: Study) -> None:
    plans = study.plans
    assert [plan.seed for plan in plans] == [1] * 4 + [7] * 4
    assert {place_of(plan).parent.name for plan in plans[:4]} == {
        *("open_square_quality", "open_square_plain"),
        *("facade_quality", "facade_plain"),
    }


def test_arms_differ_in_what_they_say(study: Study) -> None:
    quality, plain = study.agents["facade_quality"][1], study.agents["facade_plain"][1]
    assert (plain.environment, plain.arm, plain.seed) == ("facade", "plain", 7)
    assert plain.all_overrides == {"reward.weights.position_uncertainty": 0.0}
    assert (plain.settings.ppo.gamma, quality.settings.ppo.gamma) == (0.9, None)
    assert quality.settings.steps == plain.settings.steps == 1000


@pytest.mark.parametrize(
    "change",
    ["steps = 2000", 'clone.agent = "peek"', "ppo.hidden = [8]", "randomised.randomisation.camera_range = [0.5, 1.0]"],
)
def test_arms_that_differ_in_more_than_the_reward_are_refused(change: str, tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text(f"steps = 1000\n[arms.quality]\n{change}\n[arms.plain]\n")
    (tmp_path / "study.toml").write_text(STUDY.replace("treatment", "# "))
    with pytest.raises(CoopenvError, match="differ in open_square .*: " + change.split(" ")[0].replace(".", r"\.")):
        read_study(tmp_path / "study.toml")
    (tmp_path / "study.toml").write_text(STUDY.replace('["quality", "plain"]', '["quality"]'))
    assert len(read_study(tmp_path / "study.toml").plans) == 4  # a single arm is compared with none


def test_the_shipped_studies_compare_like_with_like() -> None:
    agents = data_directory("agents")
    assert {plan.arm for plan in read_study(agents / "study.toml").plans} == {"quality"}
    reward = read_study(agents / "reward_study.toml")
    for place in {plan.environment for plan in reward.plans}:
        arms = [plans[0].settings.model_dump() for plans in reward.agents.values() if plans[0].environment == place]
        first, *others = arms
        assert [each | {"scenario": {}} for each in others] == [first | {"scenario": {}}] * len(others) and others


def test_parts(study: Study) -> None:
    assert [place_of(plan) for plan in study.only(["facade", "7", "plain"]).plans] == [Path("facade_plain/seed_7")]
    assert len(study.only(["quality"]).plans) == 4
    assert study.only([]) == study
    with pytest.raises(
        CoopenvError, match=r"the study has no 'facde' \(did you mean 'facade'\?\); known: 1, 7, facade"
    ):
        study.only(["facde"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (STUDY.replace("quality", "quantity"), r"train\.toml: no arm 'quantity' \(did you mean 'quality'\?\)"),
        (STUDY.replace("train.toml", "other.toml"), r"other\.toml: cannot be read"),
        (STUDY.replace("[1, 7]", "[-1]"), r"study\.toml: seeds"),
        (STUDY + "sedes = 1\n", r"study\.toml: .*sedes"),
        ("settings =", r"study\.toml: not valid TOML"),
        (
            STUDY.replace('"scenario.reward.*", ', ""),
            r"study\.toml: arms quality and plain differ in open_square in more than the treatment \(ppo\.gamma\): "
            r"scenario\.reward\.weights\.position_uncertainty$",
        ),
        (
            STUDY.replace('treatment = ["scenario.reward.*", "ppo.gamma"]\n', ""),
            r"\(scenario\.reward\.\*\): ppo\.gamma$",
        ),
    ],
)
def test_mistakes_are_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text(SETTINGS)
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(CoopenvError, match=message) as raised:
        read_study(tmp_path / "study.toml")
    assert "\n" not in str(raised.value)


AGENTS = ("constant_speed", "route_follower")


def test_figures_stay_and_episodes_go(monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[Any] = []

    def watched(*arguments: Any) -> Episodes:
        episodes = drive(*arguments)
        driven.append(ref(episodes))
        return episodes

    monkeypatch.setattr("benchmarks.learning.judge.drive", watched)
    judge = Judge(2)

    def findings(environment: str) -> tuple[list[Result], list[Difference]]:
        return judge.results(environment, AGENTS[0]), judge.against(environment, *AGENTS)

    square = findings("open_square")
    expected = score(driven[0]()), compare_paired(driven[0](), driven[1]())
    assert repr(square) == repr(expected)  # some figures are no numbers, and equal all the same
    facade = findings("facade")
    gc.collect()
    assert [episodes() is None for episodes in driven] == [True, True, False, False]
    assert (findings("open_square"), findings("facade")) == (square, facade)
    assert len(driven) == 4
    judge.results("facade", AGENTS[0], {"horizon": 5.0})
    assert len(driven) == 5
