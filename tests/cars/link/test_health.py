"""`coopenv svea health` hears whoever reaches the router: what is no word of a gate fills nothing and hides none."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from itertools import repeat
from typing import Any

import pytest

from coopenv.cars.codec import MOST_BYTES, encode, make
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.transport.base import Arrival
from coopenv.cli.svea import next_status

TOPIC = SVEA.topic_of("svea7", Role.GATE)


class Crowded:
    """A network on which all comes at once as soon as somebody listens."""

    def __init__(self, payloads: Iterator[bytes]) -> None:
        self._payloads = payloads

    def subscribe(self, pattern: str, callback: Any) -> None:
        for payload in self._payloads:
            callback(Arrival(pattern, payload, 0))


def status() -> bytes:
    return encode(make(SVEA.topics[Role.GATE].type))


def heard(payloads: Iterator[bytes]) -> Any:
    return next_status(Crowded(payloads), TOPIC, 0.2)  # type: ignore[arg-type]


def test_the_first_word_of_a_gate_is_found_among_others() -> None:
    assert heard(iter([b"", b"nonsense", status() + bytes(MOST_BYTES), status(), b"nonsense"])).state == ""


@pytest.mark.parametrize("size", [60_000, MOST_BYTES + 1, 1_000_000])
def test_a_flood_fills_no_memory(size: int) -> None:
    heard(iter([status()]))  # what is loaded at the first time does not count
    tracemalloc.start()
    try:
        assert heard(b"\xff" * size for _ in repeat(None, 300)) is None
        assert tracemalloc.get_traced_memory()[1] < 4e6
    finally:
        tracemalloc.stop()
