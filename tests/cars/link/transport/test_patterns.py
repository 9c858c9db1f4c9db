"""Patterns mean what Zenoh's key expressions mean."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.transport.base import matcher

zenoh = pytest.importorskip("zenoh", reason="needs the extra 'svea'")

PARTS = st.sampled_from(["fleet", "svea7", "a.b", "*", "**"])


@given(
    pattern=st.lists(PARTS, min_size=1, max_size=5),
    topic=st.lists(st.sampled_from(["fleet", "svea7", "a.b", "axb"]), min_size=1, max_size=5),
)
def test_patterns_match_as_in_zenoh(pattern: list[str], topic: list[str]) -> None:
    meant = zenoh.KeyExpr.autocanonize("/".join(pattern))
    assert matcher("/".join(pattern))("/".join(topic)) == meant.includes(zenoh.KeyExpr("/".join(topic)))
