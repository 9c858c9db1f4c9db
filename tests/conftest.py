"""Shared fixtures."""

from __future__ import annotations

import os

import pytest

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture(autouse=True, scope="session")
def _few_threads() -> None:
    """Small matrices: more BLAS threads only get in each other's way."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
