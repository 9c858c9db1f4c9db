"""All kinds of hostile input: some of it here, and as much as it takes marked as slow."""

from __future__ import annotations

import pytest

from tests.fuzz.harness import run_cases
from tests.fuzz.large import CASES as LARGE
from tests.fuzz.some import CASES, KINDS

ALL = {"states": 1000, "scenarios": 3000, "mrclam": 500, "mcap": 2000}
"""How many cases of a kind the slow tests run."""


def test_some() -> None:
    outcome = run_cases("tests.fuzz.some", range(len(CASES)), hang_s=60.0)
    assert not outcome.failures, "\n".join(f"{CASES[n]}: {why}" for n, why in sorted(outcome.failures.items())[:5])
    for kind, (_, count) in KINDS.items():
        for word in ("accepted", "refused"):  # or the cases would show nothing
            assert outcome.taken[f"{kind} {word}"] > count // 20
    assert outcome.taken["large accepted"] == len(LARGE)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_all(kind: str) -> None:
    first, last = KINDS[kind][1], ALL[kind]
    outcome = run_cases(f"tests.fuzz.{kind}", range(first, last))
    print(dict(outcome.taken), f"longest {outcome.longest_s:.2f} s")  # with pytest -s
    assert not outcome.failures, "\n".join(f"{kind} {n}: {why}" for n, why in sorted(outcome.failures.items())[:5])
    assert sum(outcome.taken.values()) == last - first
    for word in ("accepted", "refused"):
        assert outcome.taken[word] > (last - first) // 20


def test_a_crash_a_hang_and_an_error_are_failures_of_their_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.harness.HANG_S", 2.0)
    outcome = run_cases("tests.fuzz.failing", range(6))
    assert outcome.taken == {"accepted": 3}
    assert outcome.failures.keys() == {1, 2, 4}
    assert "ended the process (-11)" in outcome.failures[1]
    assert "hangs" in outcome.failures[2] and "ZeroDivisionError" in outcome.failures[4]
