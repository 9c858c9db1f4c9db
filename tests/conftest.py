"""Shared fixtures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings

from tests.helpers.chromium import chromium

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("MPLBACKEND", "Agg")
# Small matrices: more BLAS threads only get in each other's way. Read when NumPy is loaded, so not in a fixture.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")


# The same examples at every run: a failure is then a change of the code, not of the luck.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a slow machine write no more than a fast one."""
    monkeypatch.setattr("coopenv.runs.console.LINE_PERIOD", 3600.0)
    monkeypatch.setattr("coopenv.runs.console.HINT_FROM", 3600.0)
    monkeypatch.setattr("coopenv.runs.console.COMPILE_NOTICE_AFTER", 3600.0)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser without a screen; of one module, as no two can be there at once, nor an event loop beside it."""
    with chromium() as started:
        yield started
