"""The settings beside an agent: the user's own are never lost."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("tomlkit", reason="needs the extra 'train'")

from coopenv.base.errors import OutputError
from coopenv.training import files
from coopenv.training.settings import Plan, read_settings

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
    (tmp_path / "new").mkdir()
    return tmp_path / "new"


def plan_of(folder: Path, arm: str | None = None, **changes: int) -> Plan:
    return Plan("urban_crossing", read_settings(folder / "train.toml", arm, "urban_crossing", **changes), 5, arm, {})


def finish(folder: Path, plan: Plan) -> None:
    """Leave in a folder what a training writes of its settings there."""
    files.write(folder, folder / "nothing", plan, "urban_crossing")
    (folder / "agent.toml").write_text(f'[training]\nsettings = "{files.settings_digest(plan)}"\n')


def test_what_the_user_wrote_stays_byte_for_byte(old: Path, new: Path) -> None:
    files.write(new, old, plan_of(old), "urban_crossing")
    assert (new / "train.toml").read_bytes() == (old / "train.toml").read_bytes()


@pytest.mark.parametrize(("arm", "changes"), [("long", {}), (None, {"steps": 10})])
def test_with_other_options_it_is_refused(arm: str | None, changes: dict[str, int], old: Path, new: Path) -> None:
    plan = plan_of(old, arm, **changes)
    with pytest.raises(OutputError, match=REFUSED):
        files.check(old, plan, "urban_crossing")
    with pytest.raises(OutputError, match=REFUSED):
        files.write(new, old, plan, "urban_crossing")


def test_overrides_are_among_the_settings(old: Path) -> None:
    settings = read_settings(old / "train.toml")
    files.check(old, Plan("urban_crossing", settings, 5, None, {"horizon": 6.0}), "urban_crossing")
    with pytest.raises(OutputError, match=REFUSED):
        files.check(old, Plan("urban_crossing", settings, 5, None, {"horizon": 7.0}), "urban_crossing")


def test_those_of_an_agent_that_is_replaced_are_replaced(old: Path, new: Path) -> None:
    plan = plan_of(old)
    finish(new, plan)
    assert read_settings(new / "train.toml") == plan.settings
    other = plan_of(old, steps=10)
    newer = new / "newer"
    newer.mkdir()
    files.write(newer, new, other, "urban_crossing")
    assert read_settings(newer / "train.toml") == other.settings


def test_those_of_an_agent_of_before_the_digest_are_replaced(old: Path) -> None:
    (old / "agent.toml").write_text("[training]\nseed = 5\n")
    files.check(old, plan_of(old, steps=10), "urban_crossing")


def test_those_of_an_agent_that_the_user_has_changed_are_the_users(old: Path, new: Path) -> None:
    plan = plan_of(old)
    finish(new, plan)
    with (new / "train.toml").open("a") as file:
        file.write("# gamma = 0.9 was worse\n")
    files.check(new, plan, "urban_crossing")
    with pytest.raises(OutputError, match=REFUSED):
        files.check(new, plan_of(old, steps=10), "urban_crossing")


def test_what_cannot_be_read_is_the_users(old: Path) -> None:
    plan = plan_of(old)
    (old / "train.toml").write_text("steps = ")
    with pytest.raises(OutputError, match=REFUSED):
        files.check(old, plan, "urban_crossing")


def test_a_link_stays_a_link(old: Path, new: Path) -> None:
    (old / "train.toml").rename(old.parent / "mine.toml")
    (old / "train.toml").symlink_to("../mine.toml")
    files.write(new, old, plan_of(old), "urban_crossing")
    assert (new / "train.toml").readlink() == Path("../mine.toml")
