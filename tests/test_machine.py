"""What is said of the machine, and variables that other processes are to see."""

from __future__ import annotations

import os

import pytest

from coopenv.base.installation import available_cores, environment, versions


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


def test_what_is_not_installed_has_no_version() -> None:
    assert set(versions("numpy", "no-such-distribution")) == {"python", "numpy"}
