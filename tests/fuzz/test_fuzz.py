"""All kinds of hostile input: some of it here, and as much as it takes marked as slow."""

from __future__ import annotations

import os
import signal
import time

import pytest

from tests.fuzz import large
from tests.fuzz.harness import run_cases

COUNTS = {"states": (40, 1000), "scenarios": (20, 3000), "mrclam": (60, 500), "mcap": (40, 2000)}
"""How many cases of a kind: quick, and all."""


def check(kind: str, first: int, last: int) -> None:
    outcome = run_cases(f"tests.fuzz.{kind}", range(first, last))
    print(dict(outcome.taken), f"longest {outcome.longest_s:.2f} s")  # with pytest -s
    assert not outcome.failures, "\n".join(f"{kind} {n}: {why}" for n, why in sorted(outcome.failures.items())[:5])
    assert sum(outcome.taken.values()) == last - first
    for word in ("accepted", "refused"):  # or the cases would show nothing
        assert outcome.taken[word] > (last - first) // 20


@pytest.mark.parametrize("kind", COUNTS)
def test_some(kind: str) -> None:
    check(kind, 0, COUNTS[kind][0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", COUNTS)
def test_all(kind: str) -> None:
    check(kind, *COUNTS[kind])


def test_large_scenarios_load_at_once() -> None:
    outcome = run_cases("tests.fuzz.large", range(len(large.CASES)), hang_s=60.0)
    assert outcome.taken == {"accepted": len(large.CASES)}, outcome.failures


def case(number: int) -> str:
    """Crash (1), hang (2), raise (4), or go well."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 2:
        time.sleep(1000)
    if number == 4:
        raise ZeroDivisionError
    return "accepted"


def test_a_crash_a_hang_and_an_error_are_failures_of_their_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.harness.HANG_S", 2.0)
    outcome = run_cases(__name__, range(6))
    assert outcome.taken == {"accepted": 3}
    assert outcome.failures.keys() == {1, 2, 4}
    assert "ended the process (-11)" in outcome.failures[1]
    assert "hangs" in outcome.failures[2] and "ZeroDivisionError" in outcome.failures[4]
