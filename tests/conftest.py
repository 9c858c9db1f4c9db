"""Shared fixtures."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("MPLBACKEND", "Agg")


# The same examples at every run: a failure is then a change of the code, not of the luck.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True, scope="session")
def _few_threads() -> None:
    """Small matrices: more BLAS threads only get in each other's way."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
