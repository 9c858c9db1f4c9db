"""An environment's file as it goes with the agent that has learnt in it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("tomlkit", reason="needs the extra 'train'")

import coopenv
from coopenv.policies import find_agent
from coopenv.training.files import environment_file

FILE = coopenv.base.installation.data_directory("envs") / "open_square.toml"


def test_a_shipped_environment_goes_by_its_name() -> None:
    assert environment_file("open_square") == ("open_square", "open_square", None)


@pytest.mark.parametrize(
    ("given", "name"),
    [("my_square.toml", "my_square.toml"), ("train.toml", "environment.toml"), ("agent.toml", "environment.toml")],
)
def test_a_file_goes_as_it_is_and_hides_no_other_of_the_agent(given: str, name: str, tmp_path: Path) -> None:
    (tmp_path / given).write_text(FILE.read_text())
    assert environment_file(str(tmp_path / given)) == (Path(given).stem, name, FILE.read_text())


def test_code_that_it_names_is_found_from_the_copy_too(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "terms.py").write_text("def calm(q):\n    return 0.0 * q.speed\n")
    text = FILE.read_text()
    assert "[reward]\n" in text
    text = text.replace("[reward]\n", '[reward]\ncustom.calm = "terms.py:calm"\nweights.calm = 1.0\n')
    (tmp_path / "mine" / "square.toml").write_text(text)
    kept = environment_file(str(tmp_path / "mine" / "square.toml")).text
    assert kept is not None
    (tmp_path / "copy.toml").write_text(kept)
    original, copied = (coopenv.load_scenario(tmp_path / name) for name in ("mine/square.toml", "copy.toml"))
    assert copied == original


def test_an_agent_names_files_of_its_folder(tmp_path: Path) -> None:
    card = 'title = "x"\ndescription = "x"\nentry = "mine.py:Mine"\nenvironments = ["square.toml", "facade"]\n'
    (tmp_path / "agent.toml").write_text(card)
    assert find_agent(tmp_path).environments == (str(tmp_path / "square.toml"), "facade")
