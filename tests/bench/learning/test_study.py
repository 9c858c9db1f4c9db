"""What a study's file says, and which of its trainings are chosen."""

from __future__ import annotations

from pathlib import Path

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.bench.study import Group, Run, Study, read_study

STUDY = """
settings = "train.toml"
environments = ["open_square", "facade"]
arms = ["quality", "plain"]
seeds = [1, 7]
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
    runs = list(study.runs)
    assert [run.seed for run in runs] == [1] * 4 + [7] * 4
    assert {run.group.name for run in runs[:4]} == {
        *("open_square_quality", "open_square_plain"),
        *("facade_quality", "facade_plain"),
    }


def test_arms_differ_in_what_they_say(study: Study) -> None:
    plain = study.plan(Run(Group("facade", "plain"), 7))
    assert (plain.environment, plain.arm, plain.seed) == ("facade", "plain", 7)
    assert plain.all_overrides == {"reward.weights.position_uncertainty": 0.0}
    quality = study.plan(Run(Group("facade", "quality"), 7))
    assert (plain.settings.ppo.gamma, quality.settings.ppo.gamma) == (0.9, 0.99)
    assert quality.settings.steps == plain.settings.steps == 1000


def test_parts(study: Study) -> None:
    assert [run.folder for run in study.only(["facade", "7", "plain"]).runs] == [Path("facade_plain/seed_7")]
    assert len(list(study.only(["quality"]).runs)) == 4
    assert list(study.only([]).runs) == list(study.runs)
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
    ],
)
def test_mistakes_are_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text(SETTINGS)
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(CoopenvError, match=message) as raised:
        read_study(tmp_path / "study.toml")
    assert "\n" not in str(raised.value)
