"""A gate on a network within this process, ticked by hand as a fake car does."""

from __future__ import annotations

import time
import tracemalloc
from collections import Counter
from collections.abc import Callable
from random import Random

import pytest

from coopenv.cars.codec import decode
from coopenv.cars.gate.core import Gate, GateMode, Reason
from coopenv.cars.gate.process import CLOCK, GateConnection, run
from coopenv.cars.profile import NEUTRAL, SVEA, Role
from tests.cars.link.gate import messages
from tests.cars.link.gate.bench import CAR, LIMITS, OTHER, STATION, Bench, messages_of_strangers
from tests.cars.link.gate.station import Station
from tests.helpers.hub import Hub


class Broken(Gate):
    """Fails at its fourth tick and ever after."""

    ticks = 0

    def tick(self) -> bytes:
        self.ticks += 1
        if self.ticks >= 4:
            raise RuntimeError("broken")
        return super().tick()


def pair(kind: Callable[..., Gate] = Gate) -> tuple[GateConnection, Station]:
    hub = Hub()
    station = Station(hub.connect(), None)
    return GateConnection(kind(CAR, LIMITS, CLOCK), hub.connect()), station


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
    link.publish_status()
    assert station.status.state == "stopped" and station.stops == 2 and not link.news.is_set()
    repeated: list[tuple[bytes, bytes]] = []
    link._transport.subscribe(SVEA.topic_of(CAR, Role.STOP), lambda a: repeated.append((a.payload, a.attachment)))
    link.publish_status()
    station.send(Role.ARM, messages.arm(time.time_ns(), "s", station.status.nonce))
    station.send_raw(Role.STOP, *repeated[0])  # on its way since before the arming
    link.publish_status()
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
        link.publish_status()
        assert station.status.session == session


def test_an_exception_leaves_the_car_in_neutral() -> None:
    link, station = pair(Broken)
    with pytest.raises(RuntimeError, match="broken"):
        run(link)
    assert len(station.outputs) == 3 + 5
    assert {drive for _, drive in station.outputs} == {NEUTRAL}


WARM, MEASURED, ALL = 16_000, 18_000, 20_000
GROWTH = 4096  # bytes, of what the interpreter keeps for itself


def test_no_bad_message_is_accepted_or_kept() -> None:
    bench = Bench()
    assert bench.arm() is None
    bench.drive(10)
    bad = messages_of_strangers(Random(5), STATION, OTHER, "s1", bench.sequence, lambda: bench.wall)
    reasons: Counter[Reason | None] = Counter()
    used = 0
    for i in range(ALL):
        reasons[bench.gate.arrive(*next(bad))] += 1
        if i == WARM:
            tracemalloc.start()
        elif i == MEASURED:
            used = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - used
    tracemalloc.stop()
    assert None not in reasons
    assert set(reasons) == set(Reason) - {Reason.NOT_ARMED}  # each kind of them has been there
    status = bench.status()
    counts = dict(zip(status.rejections, status.counts.tolist(), strict=True))
    assert counts == {**{str(reason): reasons[reason] for reason in Reason}}
    assert (status.accepted, status.last_sequence) == (10, 10)
    assert grown < GROWTH
    # Not a number in a genuine command has closed it at the first; the station's next command goes on.
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.TIMED_OUT
    assert bench.drive(1).speed > 0.0
