"""Clocks of sources and recorders brought to one, against clocks that were set apart on purpose."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.bags.log import reconcile, recorders, regularity

MS = 1_000_000
clocks = st.integers(-(10**12), 10**12)


@given(st.lists(clocks, min_size=2, max_size=4), clocks)
def test_recorders_that_share_a_source_are_brought_together(ahead: list[int], truth: int) -> None:
    """Everything is received at once; `ahead` are the clocks of cars that record themselves and motion capture."""
    files = [{f"car{i}": 0, "truth": clock - truth} for i, clock in enumerate(ahead)]
    found = reconcile(files, 20 * MS, {})
    assert found.recorders == tuple(ahead[0] - clock for clock in ahead)
    for i, clock in enumerate(ahead):
        offset = ahead[0] - clock
        shift = found.shifts[f"car{i}"]
        assert shift.offset == offset and shift.added == (offset if abs(offset) > 20 * MS else 0)
    assert found.shifts["truth"].offset == ahead[0] - truth


def test_recorders_are_reached_through_others() -> None:
    files = [{"a": 0}, {"b": 7}, {"b": 10, "a": 5}]
    assert recorders(files) == [0, -2, -5]  # -5 by a, and 10 - 7 back by b


def test_files_with_nothing_in_common_keep_their_stamps() -> None:
    found = reconcile([{"a": 900 * MS}, {"b": 900 * MS}], 20 * MS, {})
    assert found.shifts["a"].added == 900 * MS
    assert found.shifts["b"].added == 0 and not found.shifts["b"].linked


def test_what_somebody_says_counts() -> None:
    found = reconcile([{"a": 900 * MS, "b": 3 * MS}], 20 * MS, {"a": 5 * MS})
    assert found.shifts["a"].added == 5 * MS and found.shifts["b"].added == 0
    assert reconcile([{"a": 900 * MS}], float("inf"), {}).shifts["a"].added == 0


def test_gaps_are_counted() -> None:
    stamps = np.array([0, 10, 20, 30, 130, 140]) * MS
    rate, gap, gaps = regularity(stamps)
    assert rate is not None and abs(rate - 5 / 0.14) < 1e-9 and gap == 0.1 and gaps == 1
    assert regularity(stamps[:1]) == (None, None, None)
