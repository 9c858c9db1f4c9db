"""Classes of the user's own, by file and by module; what is known of the machine."""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path

import pytest

from coopenv.base import installation
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import (
    absolute_reference,
    available_cores,
    environment,
    is_reference,
    load_reference,
    versions,
)

SOURCE = """
from dataclasses import dataclass
from helper_beside import VALUE

@dataclass
class Mine:
    value: int = VALUE
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "mine.py").write_text(SOURCE)
    (tmp_path / "helper_beside.py").write_text("VALUE = 7\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "helper_beside", raising=False)
    return tmp_path


def test_a_class_in_a_file_is_loaded_once_and_imports_its_neighbours(folder: Path) -> None:
    path = list(sys.path)
    mine = load_reference("mine.py:Mine")
    assert dataclasses.is_dataclass(mine) and mine().value == 7
    assert (
        load_reference(f"{folder}/mine.py:Mine") is mine and load_reference(absolute_reference("mine.py:Mine")) is mine
    )
    assert sys.path == path and "mine" not in sys.modules


def test_files_of_one_name_are_two_modules(folder: Path) -> None:
    (folder / "other").mkdir()
    (folder / "other/mine.py").write_text("class Mine: value = 8")
    assert (load_reference("mine.py:Mine")().value, load_reference("other/mine.py:Mine").value) == (7, 8)


def test_modules_are_found_from_here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_reference("os.path:join") is os.path.join
    (folder / "module_found_from_here.py").write_text("class Mine: pass")
    assert load_reference("module_found_from_here:Mine").__module__ == "module_found_from_here"
    monkeypatch.delitem(sys.modules, "module_found_from_here")


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("mine.py:Mien", r"no 'Mien' in mine\.py \(did you mean 'Mine'\?\)"),
        ("yours.py:Mine", r"no such file: .*yours\.py"),
        ("mine.py:", "expected file.py:Name"),
        (":Mine", "expected file.py:Name"),
        ("mine.py:a b", "expected file.py:Name"),
        ("no.such.module:Mine", "cannot be loaded: ModuleNotFoundError"),
        ("raises.py:Mine", "cannot be loaded: ZeroDivisionError: division by zero$"),
        ("leaves.py:Mine", "cannot be loaded: SystemExit: 3$"),
        ("ends.py:Mine", "cannot be loaded: GeneratorExit$"),
        ("broken.py:Mine", "cannot be loaded: SyntaxError"),
    ],
)
def test_mistakes_are_one_line(folder: Path, reference: str, message: str) -> None:
    (folder / "raises.py").write_text("1 / 0\nclass Mine: ...")
    (folder / "leaves.py").write_text("raise SystemExit(3)\nclass Mine: ...")
    (folder / "ends.py").write_text("raise GeneratorExit\nclass Mine: ...")
    (folder / "broken.py").write_text("class Mine(")
    with pytest.raises(CoopenvError, match=message) as caught:
        load_reference(reference)
    assert "\n" not in str(caught.value)


def test_names_are_no_references() -> None:
    assert is_reference("mine.py:Mine") and not is_reference("riccati")


def test_a_file_that_changes_within_a_second_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    path, second = tmp_path / "own.py", 1_700_000_000_000_000_000
    for value in (3, 4):
        path.write_text(f"VALUE = {value}\n")
        os.utime(path, ns=(second, second + value))
        assert load_reference(f"{path}:VALUE") == value


def test_variables_are_as_before_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COOPENV_TEST_ONE", "7")
    monkeypatch.delenv("COOPENV_TEST_OTHER", raising=False)
    with pytest.raises(ZeroDivisionError), environment({"COOPENV_TEST_ONE": "1", "COOPENV_TEST_OTHER": "2"}):
        assert (os.environ["COOPENV_TEST_ONE"], os.environ["COOPENV_TEST_OTHER"]) == ("1", "2")
        raise ZeroDivisionError
    assert os.environ["COOPENV_TEST_ONE"] == "7"
    assert "COOPENV_TEST_OTHER" not in os.environ


def test_cores_are_counted_where_there_is_no_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert available_cores() == 1


def test_missing_distributions_have_no_version() -> None:
    assert set(versions("numpy", "no-such-distribution")) == {"python", "numpy"}


def test_an_interruption_of_own_code_stays_one() -> None:
    with pytest.raises(KeyboardInterrupt), installation.blamed("own code"):
        raise KeyboardInterrupt
    with (
        pytest.raises(CoopenvError, match=r"own code failed at test_installation\.py:\d+: GeneratorExit"),
        installation.blamed("own code"),
    ):
        raise GeneratorExit
