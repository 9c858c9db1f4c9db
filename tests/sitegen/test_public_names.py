"""Public names stay as they are, unless a change writes their file anew."""

from __future__ import annotations

import pytest

from sitegen import public_names


@pytest.fixture(scope="module")
def report() -> str:
    return public_names.report()


def test_public_names_are_those_of_the_file(report: str) -> None:
    now, held = (text.splitlines() for text in (report, public_names.FILE.read_text(encoding="utf-8")))
    gone, new = sorted({*held} - {*now}), sorted({*now} - {*held})
    assert not gone and not new, (
        f"gone or changed: {gone}; new: {new}. Public names: see docs/stability.md, then run `make names`"
    )
    assert now == held
