"""Shared fixtures."""

from __future__ import annotations

import gc
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest
from hypothesis import settings

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("MPLBACKEND", "Agg")
# Small matrices: more BLAS threads only get in each other's way. Read when NumPy is loaded, so not in a fixture.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Containers often forbid byte code: each of hundreds of processes then compiles all the Python that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

from coopenv.estimation import compiled  # noqa: E402
from coopenv.world import launch  # noqa: E402
from tests.helpers.cpu_time import CpuTime  # noqa: E402

gc.set_threshold(20_000, 20, 20)  # otherwise a tenth of the time goes into looking for unused objects

MODULES_AT_MOST = 90
"""Warp modules that a run of the tests may compile: each costs a second or more with an empty cache."""
LONGEST_COMPILATION = 1200.0
"""s for which a worker waits for a module that another one compiles, before it compiles the module as well."""
STARTED = time.time()
COMPILED = pytest.StashKey[int]()
DRAWS_WITHOUT_A_GRAPHICS_CARD = [
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
]


# The same examples at every run: a failure is then a change of the code, not of the luck.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a slow machine write no more than a fast one."""
    monkeypatch.setattr("coopenv.runs.console.LINE_PERIOD", 3600.0)
    monkeypatch.setattr("coopenv.runs.console.HINT_FROM", 3600.0)
    monkeypatch.setattr("coopenv.runs.console.COMPILE_NOTICE_AFTER", 3600.0)


@pytest.fixture(autouse=True)
def no_look_through_all_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep frozen what all tests so far have left; a drive of cars looks through its own objects before it begins."""
    monkeypatch.setattr(gc, "unfreeze", lambda: None)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Debian's Chromium, headless; of one module, as no two can be there at once, nor an event loop beside it."""
    reason = "needs chromium and playwright: make test-browser"
    playwright = pytest.importorskip("playwright.sync_api", reason=reason)
    program = shutil.which("chromium")
    if program is None:
        pytest.skip(reason)
    with playwright.sync_playwright() as tools:
        started = tools.chromium.launch(executable_path=program, args=DRAWS_WITHOUT_A_GRAPHICS_CARD)
        yield started
        started.close()


def pytest_configure(config: pytest.Config) -> None:
    """Measure CPU time; let workers wait for one another's compilation, however slow a busy machine is."""
    for module in (launch, compiled):
        module.LONGEST_COMPILATION = LONGEST_COMPILATION
    costs = CpuTime()
    costs.measure_compilation()
    config.pluginmanager.register(costs, "cpu_time")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what runs SUMO where it is not installed: it is too large for `make test`."""
    if find_spec("libsumo") is None:
        for item in items:
            if "sumo_crossing" in re.split(r"[\[\]-]", item.name):
                item.add_marker(pytest.mark.skip(reason="needs the extra sumo: make test-sumo"))


def pytest_collection_finish() -> None:
    gc.freeze()


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Fail a run that compiled too many Warp modules; counted once, by the process that controls the workers."""
    if hasattr(session.config, "workerinput"):
        return
    launch.start_warp()
    folders = [launch.cache_folder() / name for name in launch.modules()]
    compiled = sum(folder.stat().st_mtime > STARTED for folder in folders)
    session.config.stash[COMPILED] = compiled
    if exitstatus == pytest.ExitCode.OK and compiled > MODULES_AT_MOST:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of Warp modules that the run compiled."""
    compiled = terminalreporter.config.stash.get(COMPILED, None)
    if compiled is not None:
        verdict = f", more than {MODULES_AT_MOST}" if compiled > MODULES_AT_MOST else ""
        terminalreporter.write_line(f"Warp modules compiled in this run: {compiled}{verdict}")
