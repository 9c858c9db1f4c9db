"""A gate on a network within this process."""

from __future__ import annotations

import time
import tracemalloc
from collections import Counter
from collections.abc import Callable
from random import Random

import pytest

from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.gate import Gate, GateMode, Reason
from coopenv.cars.gate.process import GateConnection, run
from coopenv.cars.gate.wheel_command import NEUTRAL, MotionCommand, write_drive
from coopenv.cars.link.clock import CLOCK
from coopenv.cars.messages.codec import decode
from coopenv.cars.settings.profile import SVEA, Role
from tests.cars.gate import messages
from tests.cars.gate.bench import CAR, LIMITS, OTHER, STATION, Bench, messages_of_strangers
from tests.cars.gate.station import Station


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


def test_a_tick_sends_the_command_that_it_returns() -> None:
    link, station = pair()
    assert station.present
    payloads = [link.tick() for _ in range(9)]
    assert (len(station.since()), len(station.statuses)) == (9, 3)
    assert decode(payloads[-1], SVEA.topics[Role.MANUAL].type).z == 500.0


def test_news_is_sent_at_once_and_its_own_stops_do_not_stop_it_again() -> None:
    link, station = pair()
    link.tick()
    station.send(Role.STOP, messages.stop())
    assert link.news.is_set()
    link.publish_status()
    assert station.status.state == "stopped" and len(station.stops) == 2 and not link.news.is_set()
    repeated: list[tuple[bytes, bytes]] = []
    link.transport.subscribe(SVEA.topic_of(CAR, Role.STOP), lambda a: repeated.append((a.payload, a.attachment)))
    link.publish_status()
    station.send(Role.ARM, messages.arm(time.time_ns(), "s", station.status.nonce))
    station.send_raw(Role.STOP, *repeated[0])  # on its way since before the arming
    link.publish_status()
    assert (station.status.state, station.status.session) == ("armed", "s")
    station.session = "s"
    station.command()
    link.tick()
    assert station.since()[-1].speed > 0.0


def test_another_arming_of_an_armed_gate_is_news() -> None:
    link, station = pair()
    link.tick()
    for session in ("s", "t"):
        station.send(Role.ARM, messages.arm(time.time_ns(), session, station.status.nonce))
        assert link.news.is_set()
        link.publish_status()
        assert station.status.session == session


@pytest.mark.parametrize(
    ("payload", "answers"),
    [
        (write_drive(1, SVEA.command, NEUTRAL), 0),  # of a second gate: no answer for ever
        (write_drive(1, SVEA.command, MotionCommand(0.0, 0.3)), 1),
        (b"\0\0\0\0 in another byte order", 1),
    ],
)
def test_a_command_of_another_to_the_wheels_stops_the_car(payload: bytes, answers: int) -> None:
    link, station = pair()
    link.guard()
    station.send(Role.ARM, messages.arm(time.time_ns(), "s", link.gate.nonce))
    sent = [link.tick() for _ in range(5)]
    assert station.status.state == "armed" and link.gate.state is GateMode.ARMED, "its own are no others"
    nonce, wheels = link.gate.nonce, list[bytes]()
    link.transport.subscribe(SVEA.topic_of(CAR, Role.MANUAL), lambda arrival: wheels.append(arrival.payload))
    for command, count in ((payload, 1), (sent[1], 2)):  # a repetition of its own is not its own
        station.send(Role.MANUAL, command)
        assert link.gate.state is GateMode.STOPPED and link.gate.nonce != nonce and link.news.is_set()
        link.publish_status()
        assert (station.status.state, station.count("foreign")) == ("stopped", count)
    assert len(wheels) == 2 + answers and station.since()[-1] == NEUTRAL


def test_an_exception_leaves_the_car_in_neutral() -> None:
    link, station = pair(Broken)
    with pytest.raises(RuntimeError, match="broken"):
        run(link)
    assert len(station.since()) == 3 + 5
    assert set(station.since()) == {NEUTRAL}


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
    assert set(reasons) == set(Reason) - {Reason.NOT_ARMED, Reason.FOREIGN}  # each kind of them has been there
    status = bench.status()
    counts = dict(zip(status.rejections, status.counts.tolist(), strict=True))
    assert counts == {**{str(reason): reasons[reason] for reason in Reason}}
    assert (status.accepted, status.last_sequence) == (10, 10)
    assert grown < GROWTH
    # Not a number in a genuine command has closed it at the first; the station's next command goes on.
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.TIMED_OUT
    assert bench.drive(1).speed > 0.0
