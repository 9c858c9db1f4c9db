"""CPU time of the tests by wing, and its limits."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.helpers import cpu_time
from tests.helpers.cpu_time import LIMITS, CpuTime, wing_of

QUICK = "not slow and not browser"


def measured(seconds: dict[str, float]) -> CpuTime:
    """Return the sums of a run with a test of two phases in each wing."""
    costs = CpuTime()
    for wing, each in seconds.items():
        properties = [("cpu", each / 2), ("compilation", 1.0)]
        report: Any = SimpleNamespace(nodeid=f"tests/{wing}/deep/test_x.py::test", user_properties=properties)
        for _ in range(2):
            costs.pytest_runtest_logreport(report)
    return costs


def test_wings_are_the_top_folders_of_the_tests() -> None:
    assert wing_of("tests/api/terms/test_map.py::test_a[x/y]") == "api" and wing_of("tests/test_cli.py::test_a") == "."
    assert measured({"world": 1.0, "api": 3.0}).by_wing() == {"api": 3.0, "world": 1.0}


def test_a_wing_above_its_share_is_named_if_the_whole_suite_ran(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_time, "LIMITS", {"world": 0.5, "api": 0.6})
    above = measured({"world": 6.0, "api": 4.0})
    (line,) = above.excesses(QUICK)
    assert line.startswith("world: 60.0%") and above.excesses("") == []
    assert measured({"world": 5.0, "api": 5.0}).excesses(QUICK) == measured({"world": 6.0}).excesses(QUICK) == []


def test_limits_leave_room_for_one_another() -> None:
    assert 1.3 < sum(LIMITS.values()) < 2.5 and max(LIMITS.values()) < 0.4
