"""All kinds of hostile input: some of it here, and as much as it takes marked as slow.

A case that crashes or hangs ends the process with a traceback; its number is then in the file `case` of the test.
"""

from __future__ import annotations

import faulthandler
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.fuzz import mcap, scenarios, states

KINDS = {"states": (states, 20, 1000), "scenarios": (scenarios, 20, 3000), "mcap": (mcap, 20, 2000)}
"""A module of cases, and how many of them run here and in the slow tests."""
LONGEST = 60.0
"""A case may take so long, s."""


def outcomes(module: Any, numbers: Iterable[int], note: Path) -> Counter[str]:
    """Return how often input was taken in which way, such as "accepted" and "refused"; a case raises what is wrong."""
    module.prepare()
    found = Counter[str]()
    try:
        for number in numbers:
            note.write_text(f"{module.__name__} {number}", encoding="utf-8")
            faulthandler.dump_traceback_later(LONGEST, exit=True)
            found[module.case(number)] += 1
    finally:
        faulthandler.cancel_dump_traceback_later()
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("all_of_them", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_hostile_input(kind: str, all_of_them: bool, tmp_path: Path) -> None:
    module, some, most = KINDS[kind]
    numbers = range(some, most) if all_of_them else range(some)
    found = outcomes(module, numbers, tmp_path / "case")
    for word in ("accepted", "refused"):  # or the cases would show nothing
        assert found[word] > len(numbers) // 20
