"""Marks for parametrised tests."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

LARGEST = ("large_crossing", "urban_crossing")
"""Environments whose figures take longest; the quick tests do without them where others ask the same."""


def largest_slow(environments: Iterable[str]) -> list[Any]:
    """Return environments as parameters, the largest ones marked slow."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in LARGEST else name for name in environments]
