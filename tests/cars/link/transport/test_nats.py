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

from coopenv.cars.codec import empty, encode
from coopenv.cars.deployment import parse_deployment
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.transport.base import Arrival, Certificates, LinkError
from coopenv.cars.transport.nats import MOST_WAITING, open_nats
from coopenv.cars.transport.zenoh import open_transport
from tests.helpers.authority import Authority
from tests.helpers.brokers import nats_server
from tests.helpers.processes import wait_until
from tests.helpers.wire import free_port, listening

POINT = struct.pack("<IIII", 1, 2, 3, 3) + b"map" + struct.pack("<3d", 1.0, 2.0, 3.0)


def test_no_broker_is_said_in_time() -> None:
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
        heard: list[Arrival] = []
        ours.subscribe("*/riccatiPoint", heard.append)

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
    seen: list[tuple[str, bool]] = []
    with nats_server(port, tmp_path):
        before = listening(os.getpid())
        ours = open_nats([f"nats/127.0.0.1:{port}"])
        assert listening(os.getpid()) == before
        ours.subscribe("fleet/x", lambda arrival: heard.append(arrival.payload))
        ours.watch("fleet/alive/*", lambda *change: seen.append(change))
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
    station = Certificates(fleet.file, *fleet.certify("station"))
    files = ("--tlscert", str(certificate), "--tlskey", str(key), "--tlscacert", str(fleet.file))
    endpoint = [f"tls/127.0.0.1:{port}"]
    with nats_server(port, tmp_path, "--tlsverify", *files):
        ours = open_nats(endpoint, station)
        heard: list[Arrival] = []
        ours.subscribe("fleet/x", heard.append)
        ours.publish("fleet/x", b"secret")
        wait_until(lambda: heard)
        ours.close()
        with pytest.raises(LinkError, match="its certificate is refused: "):
            open_nats(endpoint, Certificates(other.file), timeout=1.0)
        with pytest.raises(LinkError, match=r"no NATS broker there \([^\n]+\)$"):
            open_nats(endpoint, Certificates(fleet.file), timeout=1.0)


@pytest.mark.nats
def test_a_deployment_reaches_cars_over_the_authors_wire(tmp_path: Path) -> None:
    port = free_port()
    cars, network = [{"name": "svea1", "agent": 7}], {"kind": "nats", "connect": [f"nats/127.0.0.1:{port}"]}
    fleet = parse_deployment({"environment": "e", "cars": cars, "network": network}, tmp_path / "lab.toml")
    bearings, gate = SVEA.topic_of("svea1", Role.BEARINGS), SVEA.topic_of("svea1", Role.GATE)
    with nats_server(port, tmp_path):
        car, station = open_transport(fleet), open_transport(fleet)
        heard: list[Arrival] = []
        station.subscribe("fleet/svea1/**", heard.append)
        sent = encode(empty(SVEA.topics[Role.BEARINGS].type))
        car.publish(bearings, sent, b"signed")
        car.publish(gate, b"status", reliable=True)
        wait_until(lambda: len(heard) == 2)
        car.close()
        station.close()
    assert {(a.topic, a.payload, a.attachment) for a in heard} == {(bearings, sent, b"signed"), (gate, b"status", b"")}
