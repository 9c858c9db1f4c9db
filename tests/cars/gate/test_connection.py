"""A gate on a network within this process, and its codec, which reads and writes the bytes that rosbags does."""

from __future__ import annotations

import time
import tracemalloc
from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.gate import ARM, BOOL, COMMAND, STATUS, Gate, GateMode, Reason
from coopenv.cars.gate.process import GateConnection, run
from coopenv.cars.gate.wheel_command import NEUTRAL, MotionCommand, write_drive
from coopenv.cars.link.clock import CLOCK
from coopenv.cars.messages.cdr import Malformed, read, write
from coopenv.cars.messages.codec import decode, encode, header, make
from coopenv.cars.settings.profile import SVEA, Role
from tests.cars.gate import messages
from tests.cars.gate.bench import CAR, LIMITS, OTHER, STATION, Bench, messages_of_strangers
from tests.cars.gate.messages import arm, framed_command, stop
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
    link._transport.subscribe(SVEA.topic_of(CAR, Role.STOP), lambda a: repeated.append((a.payload, a.attachment)))
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
    station.send(Role.ARM, messages.arm(time.time_ns(), "s", link._gate.nonce))
    sent = [link.tick() for _ in range(5)]
    assert station.status.state == "armed" and link._gate.state is GateMode.ARMED, "its own are no others"
    nonce, wheels = link._gate.nonce, list[bytes]()
    link._transport.subscribe(SVEA.topic_of(CAR, Role.MANUAL), lambda arrival: wheels.append(arrival.payload))
    for command, count in ((payload, 1), (sent[1], 2)):  # a repetition of its own is not its own
        station.send(Role.MANUAL, command)
        assert link._gate.state is GateMode.STOPPED and link._gate.nonce != nonce and link.news.is_set()
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


TEXT = st.text(st.characters(codec="utf-8"), max_size=12)
STAMP = st.integers(0, 2**31 * 10**9 - 1)
FLOAT = st.floats(width=32)
USUAL = st.floats(-1e6, 1e6, width=32)
COUNT = st.integers(0, 2**64 - 1)


@given(STAMP, TEXT, st.tuples(FLOAT, FLOAT, FLOAT, FLOAT, FLOAT))
def test_commands_are_read_as_they_were_written(stamp: int, frame: str, fields: Any) -> None:
    found = read(framed_command(stamp, frame, fields), COMMAND)
    assert found[:2] == [stamp, frame]
    assert np.array_equal(found[2:], fields, equal_nan=True)


@given(STAMP, TEXT, TEXT, TEXT, st.booleans())
def test_armings_are_read_as_they_were_written(stamp: int, frame: str, session: str, nonce: str, armed: bool) -> None:
    message = make(SVEA.topics[Role.ARM].type, header=header(stamp, frame), session=session, nonce=nonce, armed=armed)
    assert read(encode(message), ARM) == [stamp, frame, session, nonce, armed]


@pytest.mark.parametrize("value", [True, False])
def test_stops_are_those_of_rosbags(value: bool) -> None:
    assert write("?", value) == stop(value)
    assert read(stop(value), BOOL) == [value]


@given(STAMP, st.lists(USUAL, min_size=12, max_size=12), st.integers(0, 2**16 - 1), st.integers(0, 255))
def test_manual_control_is_that_of_rosbags(stamp: int, numbers: list[float], buttons: int, extensions: int) -> None:
    given = iter([*numbers[:4], buttons, buttons // 2, extensions, *numbers[4:]])
    neutral = {name: (kind, next(given)) for name, (kind, _) in SVEA.command.neutral.items()}
    message, drive = SVEA.command.model_copy(update={"neutral": neutral}), MotionCommand(0.1, -0.2)
    fields = message.values(drive)
    payload = write_drive(stamp, message, drive)
    assert payload == encode(make(SVEA.topics[Role.MANUAL].type, header=header(stamp), **fields))
    found = decode(payload, SVEA.topics[Role.MANUAL].type)
    assert all(getattr(found, k) == pytest.approx(v, rel=1e-6) for k, v in fields.items())


@given(STAMP, TEXT, TEXT, TEXT, COUNT, COUNT, st.dictionaries(TEXT, COUNT, max_size=5))
def test_the_status_is_that_of_rosbags(
    stamp: int, session: str, nonce: str, state: str, accepted: int, last: int, counts: dict[str, int]
) -> None:
    lists = [*counts], [*counts.values()]
    payload = write(STATUS, stamp, "", session, nonce, state, accepted, last, *lists)
    fields: dict[str, Any] = {"session": session, "nonce": nonce, "state": state}
    fields |= {"accepted": accepted, "last_sequence": last}
    fields |= {"rejections": list(counts), "counts": np.array(list(counts.values()), dtype=np.uint64)}
    assert payload == encode(make(SVEA.topics[Role.GATE].type, header=header(stamp), **fields))
    found = decode(payload, SVEA.topics[Role.GATE].type)
    assert dict(zip(found.rejections, found.counts.tolist(), strict=True)) == counts


WHOLE = [
    (COMMAND, Role.COMMAND, framed_command(5, "abc:1", (0.1, 0.2, 0.3, 0.4, 0.5))),
    (ARM, Role.ARM, arm(7, "abc", "nonce")),
    (BOOL, Role.STOP, stop()),
]


@pytest.mark.parametrize(("fields", "role", "payload"), WHOLE)
def test_every_other_length_is_refused(fields: tuple[str, ...], role: Role, payload: bytes) -> None:
    for length in range(len(payload)):
        with pytest.raises(Malformed):
            read(payload[:length], fields)
        with pytest.raises(CoopenvError):
            decode(payload[:length], SVEA.topics[role].type)
    for more in range(1, 4):  # padding that some writers add
        assert read(payload + bytes(more), fields) == read(payload, fields)
    with pytest.raises(Malformed, match="too long"):
        read(payload + bytes(4), fields)


@given(st.sampled_from(WHOLE), st.binary(max_size=80), st.booleans())
def test_bytes_are_read_as_rosbags_reads_them_or_refused(what: Any, raw: bytes, plausible: bool) -> None:
    fields, role, _ = what
    payload = b"\0\1\0\0" + raw if plausible else raw
    try:
        found = read(payload, fields)
    except Malformed:
        return
    other = decode(payload, SVEA.topics[role].type)
    if role is Role.STOP:
        assert found == [bool(other.data)]
    else:
        assert found[1] == other.header.frame_id


def test_stamps_and_texts_that_make_no_sense_are_refused() -> None:
    good = framed_command(5, "abc:1", (0.0,) * 5)
    for place, byte in ((11, 0xFF), (12, 0xFF), (15, 0x7F), (16, 0xC3), (21, 0x31), (1, 0)):
        with pytest.raises(Malformed):
            read(good[:place] + bytes([byte]) + good[place + 1 :], COMMAND)
