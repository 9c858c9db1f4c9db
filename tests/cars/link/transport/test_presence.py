"""Heartbeats, for networks that do not know who is there."""

from __future__ import annotations

import pytest

from coopenv.cars.transport import nats
from coopenv.cars.transport.nats import LEASE, Presence


def test_a_name_is_there_while_any_of_its_ends_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(nats.time, "monotonic", lambda: now[0])
    seen: list[tuple[str, bool]] = []
    watcher = Presence(lambda name, payload: None)
    ends = [Presence(watcher.hear) for _ in range(2)]
    watcher.watch("fleet/alive/*", lambda *change: seen.append(change))
    for end in ends:
        end.announce("fleet/alive/svea7")
    ends[0].announce("fleet/other")
    assert seen == [("fleet/alive/svea7", True)]
    ends[0].leave()
    assert len(seen) == 1
    now[0] += 0.9 * LEASE
    ends[1].beat()
    now[0] += 0.9 * LEASE
    watcher.beat()
    assert len(seen) == 1
    now[0] += 0.2 * LEASE
    watcher.beat()
    assert seen[1:] == [("fleet/alive/svea7", False)]
    ends[1].beat()
    assert seen[2:] == [("fleet/alive/svea7", True)]
