"""Observers named by where they stand, in the registry and in an environment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.observers import registry
from coopenv.observers.registry import find, named, portable
from coopenv.observers.single_frame import DeadReckoning

SOURCE = """
from coopenv.observers.single_frame import DeadReckoning

class Mine(DeadReckoning):
    pass

class Riccati(DeadReckoning):
    pass

number = 3
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "mine.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    for known in ("_registered", "_places"):
        monkeypatch.setattr(registry, known, {})
    return tmp_path


class Other(DeadReckoning):
    """An observer of this program."""


def test_a_place_gets_the_name_of_its_class(folder: Path) -> None:
    assert named("mine.py:Mine") == "Mine" == named(f"{folder}/mine.py:Mine")
    assert find("Mine") is find("mine.py:Mine")
    assert portable("Mine") == f"{folder.resolve()}/mine.py:Mine"
    assert (
        named("coopenv.observers.error_state_filters:Ukf") == "Ukf"
        and portable("Ukf") == "coopenv.observers.error_state_filters:Ukf"
    )


def test_classes_get_their_name() -> None:
    assert named(Other) == "Other" == named(Other)
    assert portable("Other") is Other and find(Other) is Other
    assert named("riccati") == "riccati" == portable("riccati")


def test_a_name_that_is_taken_comes_with_the_file(folder: Path) -> None:
    (folder / "yours.py").write_text(SOURCE)
    assert (named("mine.py:Mine"), named("yours.py:Mine")) == ("Mine", "yours.Mine")
    (folder / "riccati.py").write_text(SOURCE.replace("Mine", "riccati"))
    assert named("riccati.py:riccati") == "riccati.riccati"
    (folder / "deep").mkdir()
    (folder / "deep/yours.py").write_text(SOURCE)
    with pytest.raises(CoopenvError, match=r"'Mine' and 'yours\.Mine' exist already"):
        named("deep/yours.py:Mine")


def test_a_class_that_is_defined_once_more_takes_the_place_of_the_old_one() -> None:
    def defined() -> type:
        return type("Mine", (DeadReckoning,), {"__module__": __name__})

    first, second = defined(), defined()
    assert named(first) == named(second) == "Mine"
    assert find("Mine") is second


@pytest.mark.parametrize("observer", ["mine.py:number", 3, lambda setup: None, object()])
def test_what_is_no_observer(observer: object) -> None:
    with pytest.raises(CoopenvError, match="expected a"):
        named(observer)  # type: ignore[arg-type]


@pytest.mark.parametrize("observer", ["mine.py:Mine", Other])
def test_in_an_environment(observer: str | type) -> None:
    """It estimates as the observer of the zoo that it is derived from."""
    options = {"dtype": "float64", "overrides": {"horizon": 0.5}}
    estimates = []
    for choice in (observer, "dead_reckoning"):
        env = coopenv.parallel_env("overtaking", observer=choice, **options)
        env.reset(seed=0)
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
        estimates.append(env.engine.view("estimate_position").copy())
    np.testing.assert_allclose(*estimates, rtol=1e-9)


def test_a_scenario_cannot_name_code() -> None:
    with pytest.raises(CoopenvError, match=r"observer\.name"):
        coopenv.load_scenario("overtaking", {"observer.name": "mine.py:Mine"})
