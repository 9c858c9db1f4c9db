"""CPU time of tests by wing, which is the top folder of `tests`: printed after each run, and limited in a whole run.

CPU time of a test is that of its process and of the processes that it has started and waited for. It hardly depends on
other work of the machine. Compilation of kernels and functions is a row of its own, as a warm cache has none.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Generator
from functools import wraps
from typing import Any

import pytest

from coopenv.estimation import compiled
from coopenv.world import launch

SHOWN = 40
"""Slowest tests that are listed."""
LIMITS = {
    "observers": 0.30,
    "bench": 0.28,
    "cars": 0.31,
    "api": 0.20,
    ".": 0.20,
    "world": 0.18,
    "sources": 0.12,
    "benchmarks": 0.10,
    "runs": 0.10,
    "sitegen": 0.10,
    "viz": 0.10,
    "mrclam": 0.09,
    "policies": 0.08,
    "estimation": 0.06,
    "scenario": 0.06,
    "cli": 0.05,
    "fuzz": 0.04,
    "evaluation": 0.03,
    "foxglove": 0.03,
}
"""Largest share of a wing in the CPU time of a whole run without slow tests, about 1.5 times its present share."""
COMPILATION = "compilation"
OTHER = "."
"""Wing of the files that stand in no folder of `tests`."""


def wing_of(test: str) -> str:
    """Return the wing of a test by its node id, such as `world` for `tests/world/test_camera.py::test_lens`."""
    folders = test.partition("::")[0].split("/")[1:-1]
    return folders[0] if folders else OTHER


def used() -> float:
    """Return the CPU time (s) of this process and of its children that have ended."""
    return sum(os.times()[:4])


class CpuTime:
    """A plugin of pytest: workers measure their tests, the process that controls them adds up, prints and judges."""

    def __init__(self) -> None:
        self.by_test: dict[str, float] = defaultdict(float)
        self.compilation = 0.0
        self._compiling = self._since = 0.0

    def measure_compilation(self) -> None:
        """Measure from now on the time in which this process compiles or loads kernels and functions."""
        for module, name in ((launch, "_launch"), (compiled, "_made")):
            setattr(module, name, self._measured(getattr(module, name)))

    def _measured(self, load: Any) -> Any:
        @wraps(load)
        def measured(*given: Any) -> Any:
            before = used()
            try:
                return load(*given)
            finally:
                self._compiling += used() - before

        return measured

    def pytest_runtest_logstart(self) -> None:
        self._since, self._compiling = used(), 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        now = used()
        report.user_properties += [(COMPILATION, self._compiling), ("cpu", now - self._since - self._compiling)]
        self._since, self._compiling = now, 0.0
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        of = dict(report.user_properties)
        self.by_test[report.nodeid] += of.get("cpu", 0.0)
        self.compilation += of.get(COMPILATION, 0.0)

    def by_wing(self) -> dict[str, float]:
        """Return the CPU time (s) of each wing, the largest first."""
        sums: dict[str, float] = defaultdict(float)
        for test, seconds in self.by_test.items():
            sums[wing_of(test)] += seconds
        return dict(sorted(sums.items(), key=lambda pair: -pair[1]))

    def excesses(self, markers: str) -> list[str]:
        """Return a line for each wing that takes more than its share of a whole run; none of a part of the tests.

        Args:
            markers: expression by which tests are selected, pytest's option `-m`.
        """
        wings = self.by_wing()
        if "not slow" not in markers or LIMITS.keys() - wings.keys():
            return []
        total = sum(wings.values())
        return [
            f"{wing}: {seconds / total:.1%} of the CPU time of all tests, more than {LIMITS[wing]:.1%}; see its slowest"
            for wing, seconds in wings.items()
            if seconds > LIMITS.get(wing, 1.0) * total
        ]

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        controls = not hasattr(session.config, "workerinput")
        if controls and exitstatus == pytest.ExitCode.OK and self.excesses(session.config.option.markexpr):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        slowest = sorted(self.by_test.items(), key=lambda pair: -pair[1])[:SHOWN]
        terminalreporter.section(f"CPU time (s) of the {len(slowest)} slowest tests and of each wing")
        for test, seconds in slowest:
            terminalreporter.write_line(f"{seconds:7.2f}  {test}")
        wings = self.by_wing()
        total = max(sum(wings.values()), 1e-9)
        for wing, seconds in wings.items():
            terminalreporter.write_line(f"{seconds:7.1f}  {seconds / total:6.1%}  {wing}")
        terminalreporter.write_line(f"{self.compilation:7.1f}          {COMPILATION}")
        for line in self.excesses(terminalreporter.config.option.markexpr):
            terminalreporter.write_line(line)
