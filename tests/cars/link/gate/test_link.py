"""A gate on a network within this process, ticked by hand as a fake car does."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from coopenv.cars.codec import decode
from coopenv.cars.gate.core import Gate
from coopenv.cars.gate.process import CLOCK, Link, run
from coopenv.cars.profile import NEUTRAL, SVEA, Role
from coopenv.cars.transport.base import Hub
from tests.cars.link.gate import messages
from tests.cars.link.gate.bench import CAR, LIMITS
from tests.cars.link.gate.station import Station


class Broken(Gate):
    """Fails at its fourth tick and ever after."""

    ticks = 0

    def tick(self) -> bytes:
        self.ticks += 1
        if self.ticks >= 4:
            raise RuntimeError("broken")
        return super().tick()


def pair(kind: Callable[..., Gate] = Gate) -> tuple[Link, Station]:
    hub = Hub()
    station = Station(hub.connect(), None)
    return Link(kind(CAR, LIMITS, CLOCK), CAR, hub.connect()), station


def test_a_tick_sends_what_it_returns() -> None:
    link, station = pair()
    assert station.present
    payloads = [link.tick() for _ in range(9)]
    assert (len(station.outputs), station.statuses) == (9, 3)
    assert decode(payloads[-1], SVEA.topics[Role.MANUAL].type).z == 500.0


def test_news_is_told_at_once_and_its_own_stops_do_not_stop_it_again() -> None:
    link, station = pair()
    link.tick()
    station.send(Role.STOP, messages.stop())
    assert link.news.is_set()
    link.tell()
    assert station.status.state == "stopped" and station.stops == 2 and not link.news.is_set()
    repeated: list[tuple[bytes, bytes]] = []
    link._transport.subscribe(SVEA.topic_of(CAR, Role.STOP), lambda a: repeated.append((a.payload, a.attachment)))
    link.tell()
    station.send(Role.ARM, messages.arm(time.time_ns(), "s", station.status.nonce))
    station.send_raw(Role.STOP, *repeated[0])  # on its way since before the arming
    link.tell()
    assert (station.status.state, station.status.session) == ("armed", "s")
    station.session = "s"
    station.command()
    link.tick()
    assert station.outputs[-1][1].speed > 0.0


def test_another_arming_of_an_armed_gate_is_news() -> None:
    link, station = pair()
    link.tick()
    for session in ("s", "t"):
        station.send(Role.ARM, messages.arm(time.time_ns(), session, station.status.nonce))
        assert link.news.is_set()
        link.tell()
        assert station.status.session == session


def test_an_exception_leaves_the_car_in_neutral() -> None:
    link, station = pair(Broken)
    with pytest.raises(RuntimeError, match="broken"):
        run(link)
    assert len(station.outputs) == 3 + 5
    assert {drive for _, drive in station.outputs} == {NEUTRAL}
