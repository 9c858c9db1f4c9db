"""NATS with Debian's broker on the loopback."""

from __future__ import annotations

import asyncio
import os
import signal
import struct
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.link import transport
from coopenv.cars.link.connect import open_transport
from coopenv.cars.link.nats import MOST_WAITING, Letter, Outbox, open_nats, subject_of, subjects_of
from coopenv.cars.link.transport import LEASE, MOST_PRESENT, HeartbeatTransport, LinkError, matcher
from coopenv.cars.messages.codec import encode, make
from coopenv.cars.settings.deployment import parse_deployment
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.brokers import Authority, nats_server
from tests.helpers.processes import wait_until
from tests.helpers.wire import free_port, heard_by, listening, seen_by

POINT = struct.pack("<IIII", 1, 2, 3, 3) + b"map" + struct.pack("<3d", 1.0, 2.0, 3.0)


def test_a_missing_broker_is_reported_in_time() -> None:
    began = time.monotonic()
    endpoint = f"nats/127.0.0.1:{free_port()}"
    before = threading.active_count()
    with pytest.raises(LinkError, match=rf"^{endpoint}: no NATS broker there \(Connection refused\)$"):
        open_nats([endpoint], timeout=0.5)
    assert time.monotonic() - began < 10.0
    assert threading.active_count() <= before


@pytest.mark.nats
def test_a_plain_client_sees_the_authors_wire(tmp_path: Path) -> None:
    import nats

    async def exchange(url: str, send: Any) -> list[Any]:
        client = await nats.connect(url)
        got = await client.subscribe("agent7.riccatiPoint")
        await client.flush()
        send()
        messages = [await got.next_msg(30.0) for _ in range(2)]
        await client.publish("agent8.riccatiPoint", POINT)
        await client.publish("agent8.riccatiPoint", POINT, headers={"Coopenv-Attachment": "no base64!"})
        await client.close()
        return messages

    port = free_port()
    with nats_server(port, tmp_path):
        ours = open_nats([f"nats/127.0.0.1:{port}"])
        heard = heard_by(ours, "*/riccatiPoint")

        def send() -> None:
            ours.publish("agent7/riccatiPoint", POINT)
            ours.publish("agent7/riccatiPoint", POINT, b"\0signed")

        plain, signed = asyncio.run(exchange(f"nats://127.0.0.1:{port}", send))
        assert (plain.subject, plain.data, plain.headers) == ("agent7.riccatiPoint", POINT, None)
        assert (signed.data, signed.headers) == (POINT, {"Coopenv-Attachment": "AHNpZ25lZA=="})
        wait_until(lambda: len(heard) == 4)
        ours.close()
    others = [arrival for arrival in heard if arrival.topic == "agent8/riccatiPoint"]
    assert [(arrival.payload, arrival.attachment) for arrival in others] == [(POINT, b"")] * 2


@pytest.mark.nats
def test_a_connection_goes_on_when_its_broker_is_back_and_sends_nothing_old(tmp_path: Path) -> None:
    port = free_port()
    heard: list[bytes] = []
    with nats_server(port, tmp_path):
        before = listening(os.getpid())
        ours = open_nats([f"nats/127.0.0.1:{port}"])
        assert listening(os.getpid()) == before
        ours.subscribe("fleet/x", lambda arrival: heard.append(arrival.payload))
        seen = seen_by(ours)
        ours.announce("fleet/alive/svea7")
        wait_until(lambda: seen)
    wait_until(lambda: len(seen) == 2)
    for _ in range(100):
        ours.publish("fleet/x", b"old")
    ours.subscribe("fleet/y", lambda arrival: heard.append(arrival.payload))
    with nats_server(port, tmp_path):

        def both() -> bool:
            ours.publish("fleet/x", b"new x")
            ours.publish("fleet/y", b"new y")
            return {b"new x", b"new y"} <= set(heard)

        wait_until(both)
        wait_until(lambda: len(seen) == 3)
        ours.close()
    assert b"old" not in heard
    assert [there for _, there in seen] == [True, False, True]


@pytest.mark.nats
def test_a_broker_that_has_frozen_keeps_neither_senders_nor_memory(tmp_path: Path) -> None:
    port = free_port()
    with nats_server(port, tmp_path) as broker:
        ours = open_nats([f"nats/127.0.0.1:{port}"])
        os.kill(broker.pid, signal.SIGSTOP)
        began = time.monotonic()
        for _ in range(3 * MOST_WAITING):
            ours.publish("fleet/x", bytes(10_000))
        assert time.monotonic() - began < 10.0
        assert len(ours._outbox._other) <= MOST_WAITING
        ours.publish("fleet/stop", b"", reliable=True)
        os.kill(broker.pid, signal.SIGCONT)
        ours.close()


@pytest.mark.nats
def test_tls_of_the_broker(tmp_path: Path) -> None:
    fleet, other, port = Authority(tmp_path, "fleet"), Authority(tmp_path, "other"), free_port()
    certificate, key = fleet.certify("broker")
    station = fleet.tls("station")
    files = ("--tlscert", str(certificate), "--tlskey", str(key), "--tlscacert", str(fleet.file))
    endpoint = [f"tls/127.0.0.1:{port}"]
    with nats_server(port, tmp_path, "--tlsverify", *files):
        ours = open_nats(endpoint, station)
        heard = heard_by(ours, "fleet/x")
        ours.publish("fleet/x", b"secret")
        wait_until(lambda: heard)
        ours.close()
        with pytest.raises(LinkError, match="its certificate is refused: "):
            open_nats(endpoint, other.tls(), timeout=1.0)
        with pytest.raises(LinkError, match=r"no NATS broker there \([^\n]+\)$"):
            open_nats(endpoint, fleet.tls(), timeout=1.0)


@pytest.mark.nats
def test_a_deployment_reaches_cars_over_the_authors_wire(tmp_path: Path) -> None:
    port = free_port()
    cars, network = [{"name": "svea1", "agent": 7}], {"kind": "nats", "connect": [f"nats/127.0.0.1:{port}"]}
    fleet = parse_deployment({"environment": "e", "cars": cars, "network": network}, tmp_path / "lab.toml")
    bearings, gate = SVEA.topic_of("svea1", Role.BEARINGS), SVEA.topic_of("svea1", Role.GATE)
    with nats_server(port, tmp_path):
        car, station = open_transport(fleet), open_transport(fleet)
        heard = heard_by(station, "fleet/svea1/**")
        sent = encode(make(SVEA.topics[Role.BEARINGS].type))
        car.publish(bearings, sent, b"signed")
        car.publish(gate, b"status", reliable=True)
        wait_until(lambda: len(heard) == 2)
        car.close()
        station.close()
    assert {(a.topic, a.payload, a.attachment) for a in heard} == {(bearings, sent, b"signed"), (gate, b"status", b"")}


def test_a_subject_is_the_topic_with_dots() -> None:
    assert subject_of("agent7/riccatiPoint") == "agent7.riccatiPoint"


def covers(subject: str, topic: str) -> bool:
    """Say what a NATS server delivers: `*` is a token, `>` at the end one or more."""
    wanted, tokens = subject.split("."), topic.split("/")
    for i, token in enumerate(wanted):
        if token == ">":
            return len(tokens) > i
        if i >= len(tokens) or token not in ("*", tokens[i]):
            return False
    return len(tokens) == len(wanted)


@given(
    pattern=st.lists(st.sampled_from(["a", "b", "*", "**"]), min_size=1, max_size=4),
    topic=st.lists(st.sampled_from(["a", "b"]), min_size=1, max_size=4),
)
def test_no_topic_is_missed_and_none_comes_twice(pattern: list[str], topic: list[str]) -> None:
    times = sum(covers(subject, "/".join(topic)) for subject in subjects_of("/".join(pattern)))
    assert times <= 1
    if matcher("/".join(pattern))("/".join(topic)):
        assert times == 1


class End(HeartbeatTransport):
    """An end whose heartbeats reach one other."""

    def __init__(self, other: HeartbeatTransport | None = None) -> None:
        super().__init__()
        self._other = other

    def _send_heartbeat(self, name: str, payload: bytes) -> None:
        if self._other is not None:
            self._other.heartbeat(name, payload)

    def _receive_heartbeats(self) -> None: ...

    def _end(self) -> None: ...


def test_a_name_is_present_while_any_of_its_ends_sends_heartbeats(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(transport.time, "monotonic", lambda: now[0])
    watcher = End()
    ends = [End(watcher) for _ in range(2)]
    seen = seen_by(watcher)  # type: ignore[arg-type]
    for end in ends:
        end.announce("fleet/alive/svea7")
    ends[0].announce("fleet/other")
    assert seen == [("fleet/alive/svea7", True)]
    ends[0].close()
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


def test_names_of_strangers_take_limited_room_and_no_place_of_those_that_are_there() -> None:
    watcher = End()
    car = End(watcher)
    seen = seen_by(watcher)  # type: ignore[arg-type]
    car.announce("fleet/alive/svea7")
    watcher.heartbeat("fleet/alive/" + 1000 * "x", b"+id")
    for k in range(2 * MOST_PRESENT):
        watcher.heartbeat(f"fleet/alive/mallory{k}", b"+id")
    car.beat()
    assert len(seen) == len(watcher._last) == MOST_PRESENT
    car.close()
    assert seen[-1] == ("fleet/alive/svea7", False)


def letter(number: int) -> Letter:
    return "t", bytes([number]), b""


def test_urgent_ones_overtake_and_the_oldest_go_first_when_there_is_no_room() -> None:
    outbox = Outbox(2)
    for number in range(4):
        outbox.put(letter(number), urgent=False)
    outbox.put(letter(9), urgent=True)
    assert [outbox.take() for _ in range(4)] == [letter(9), letter(2), letter(3), None]


def test_a_patient_sender_waits_for_room_and_loses_nothing() -> None:
    outbox = Outbox(1)
    outbox.put(letter(1), urgent=True)
    sender = threading.Thread(target=lambda: outbox.put(letter(2), urgent=True, patience=60.0), daemon=True)
    sender.start()
    time.sleep(0.1)
    assert sender.is_alive()
    assert outbox.take() == letter(1)
    sender.join(60.0)
    assert outbox.take() == letter(2)
