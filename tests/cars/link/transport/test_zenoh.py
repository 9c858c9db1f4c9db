"""Zenoh over the loopback, each end a process of its own."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from functools import cached_property

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.transport.base import Arrival, LinkError
from coopenv.cars.transport.zenoh import Zenoh, open_zenoh
from tests.helpers.processes import wait_until
from tests.helpers.wire import ECHO, PING, PONG, free_endpoint, heard_by, listening, running, seen_by


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def client(endpoint: str) -> Iterator[Zenoh]:
    """Return a client of a router that the test itself starts first."""

    class Lazy:
        @cached_property
        def opened(self) -> Zenoh:
            return open_zenoh("client", connect=[endpoint])

        def __getattr__(self, name: str) -> object:
            return getattr(self.opened, name)

    lazy = Lazy()
    yield lazy  # type: ignore[misc]
    if "opened" in vars(lazy):
        lazy.opened.close()


def answered(client: Zenoh, heard: list[Arrival]) -> None:
    """Send pings until one comes back."""
    before = len(heard)

    def ping() -> bool:
        client.publish(PING, b"abc", b"signed")
        return len(heard) > before

    wait_until(ping)


def test_two_processes_talk_and_a_killed_one_is_missed(endpoint: str, client: Zenoh) -> None:
    with running("router", endpoint), running("echo", endpoint) as echo:
        heard = heard_by(client, PONG)
        seen = seen_by(client)
        answered(client, heard)
        assert (heard[0].topic, heard[0].payload, heard[0].attachment) == (PONG, b"cba", b"signed")
        assert abs(heard[0].received - time.time_ns()) < 60e9
        wait_until(lambda: seen == [(ECHO, True)])
        echo.kill()
        wait_until(lambda: seen == [(ECHO, True), (ECHO, False)])


def test_a_frozen_process_is_missed(endpoint: str, client: Zenoh) -> None:
    with running("router", endpoint), running("echo", endpoint) as echo:
        seen = seen_by(client)
        wait_until(lambda: seen)
        os.kill(echo.pid, signal.SIGSTOP)
        began = time.monotonic()
        wait_until(lambda: len(seen) == 2)
        assert time.monotonic() - began < 8.0  # by default Zenoh would take ten seconds


def test_a_session_goes_on_when_its_router_is_back(endpoint: str, client: Zenoh) -> None:
    with running("router", endpoint):
        heard, seen = heard_by(client, PONG), seen_by(client)
        with running("echo", endpoint):
            answered(client, heard)
            wait_until(lambda: seen == [(ECHO, True)])
    wait_until(lambda: seen[-1] == (ECHO, False))
    client.publish(PING, b"into the void", urgent=True, reliable=True)
    with running("router", endpoint), running("echo", endpoint):
        answered(client, heard)
        wait_until(lambda: seen[-1] == (ECHO, True))
    assert all(arrival.payload == b"cba" for arrival in heard)


def test_a_router_that_has_frozen_keeps_no_sender_waiting_for_long(endpoint: str, client: Zenoh) -> None:
    with running("router", endpoint) as router:
        client.publish(PING, b"")
        os.kill(router.pid, signal.SIGSTOP)
        longest = []

        def send() -> None:
            for _ in range(400):
                began = time.monotonic()
                client.publish(PING, bytes(60_000), urgent=True, reliable=True)
                longest.append(time.monotonic() - began)

        sender = threading.Thread(target=send, daemon=True)
        sender.start()
        sender.join(30.0)
        assert not sender.is_alive()
        assert max(longest) < 4.0  # by default Zenoh would wait for five seconds


def test_a_router_that_is_not_there_is_said_in_time(endpoint: str) -> None:
    began = time.monotonic()
    with pytest.raises(LinkError, match=rf"^{endpoint}: no Zenoh there \(Connection refused\)$"):
        open_zenoh("client", connect=[endpoint], timeout=0.5)
    assert time.monotonic() - began < 10.0


def test_who_does_not_answer_is_said() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # as a firewall may: it takes the connection, and that is it
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(LinkError, match=rf"^{endpoint}: no Zenoh there \(no answer within 0\.5 s\)$"):
            open_zenoh("client", connect=[endpoint], timeout=0.5)


def test_a_port_that_is_taken_is_said(endpoint: str) -> None:
    with (
        closing(open_zenoh("router", listen=[endpoint])),
        pytest.raises(LinkError, match=r"Address already in use"),
    ):
        open_zenoh("router", listen=[endpoint])


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7447", "tcp/127.0.0.1", "tls/127.0.0.1:7447"])
def test_what_is_no_endpoint_or_lacks_certificates_is_refused(endpoint: str) -> None:
    with pytest.raises(CoopenvError, match=r"is no endpoint|go together"):
        open_zenoh("client", connect=[endpoint])


def test_nothing_is_listened_at_but_what_was_asked_for(endpoint: str) -> None:
    port = int(endpoint.rpartition(":")[2])
    with running("router", endpoint) as router, running("echo", endpoint) as echo:
        assert listening(router.pid) == [f"tcp 0100007F:{port:04X}"]
        assert listening(echo.pid) == []
