"""Zenoh between processes, and its certificates."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.link.connect import open_transport
from coopenv.cars.link.transport import Address, Arrival, LinkError, address_of
from coopenv.cars.link.zenoh import Zenoh, open_zenoh
from coopenv.cars.settings.deployment import Deployment, DeploymentError, parse_deployment
from tests.helpers.brokers import Authority
from tests.helpers.processes import wait_until
from tests.helpers.wire import ECHO, PING, PONG, free_endpoint, free_port, heard_by, listening, running, seen_by


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def router(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    with running("router", endpoint) as process:
        yield process


@pytest.fixture
def client(endpoint: str, router: subprocess.Popen[str]) -> Iterator[Zenoh]:
    with closing(open_zenoh("client", connect=[endpoint])) as opened:
        yield opened


def answered(client: Zenoh, heard: list[Arrival]) -> None:
    """Send pings until one comes back."""
    before = len(heard)
    wait_until(lambda: len(heard) > before, lambda: client.publish(PING, b"abc", b"signed"))


@pytest.mark.parametrize("listen", ["subscribe", "watch"])
def test_a_process_that_raises_ends_though_its_session_is_open(endpoint: str, listen: str) -> None:
    script = f"""
from coopenv.cars.link.zenoh import open_zenoh
open_zenoh("router", listen=["{endpoint}"]).{listen}("any/**", print)
raise SystemExit(3)
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == 3


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_two_processes_talk_and_one_that_is_killed_or_frozen_is_missed(
    endpoint: str, client: Zenoh, number: signal.Signals
) -> None:
    with running("echo", endpoint) as echo:
        heard, seen = heard_by(client, PONG), seen_by(client)
        answered(client, heard)
        assert (heard[0].topic, heard[0].payload, heard[0].attachment) == (PONG, b"cba", b"signed")
        assert abs(heard[0].received - time.time_ns()) < 60e9
        wait_until(lambda: seen == [(ECHO, True)])
        echo.send_signal(number)
        began = time.monotonic()
        wait_until(lambda: seen == [(ECHO, True), (ECHO, False)])
        assert time.monotonic() - began < 8.0  # by default Zenoh would take ten seconds


def test_a_router_that_has_frozen_keeps_no_sender_waiting_for_long(
    client: Zenoh, router: subprocess.Popen[str]
) -> None:
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
    router.kill()


def test_a_missing_router_is_reported_in_time(endpoint: str) -> None:
    began = time.monotonic()
    with pytest.raises(LinkError, match=rf"^{endpoint}: no Zenoh there \(Connection refused\)$"):
        open_zenoh("client", connect=[endpoint], timeout=0.5)
    assert time.monotonic() - began < 10.0


def test_a_silent_endpoint_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # as a firewall may: it takes the connection, and that is it
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(LinkError, match=rf"^{endpoint}: no Zenoh there \(no answer within 0\.5 s\)$"):
            open_zenoh("client", connect=[endpoint], timeout=0.5)


def test_a_taken_port_is_reported(endpoint: str) -> None:
    with (
        closing(open_zenoh("router", listen=[endpoint])),
        pytest.raises(LinkError, match=r"Address already in use"),
    ):
        open_zenoh("router", listen=[endpoint])


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7447", "tcp/127.0.0.1", "tls/127.0.0.1:7447"])
def test_malformed_endpoints_and_missing_certificates_are_refused(endpoint: str) -> None:
    with pytest.raises(CoopenvError, match=r"is no endpoint|go together"):
        open_zenoh("client", connect=[endpoint])


def test_processes_listen_at_the_given_endpoints_alone(endpoint: str, router: subprocess.Popen[str]) -> None:
    port = int(endpoint.rpartition(":")[2])
    with running("echo", endpoint) as echo:
        assert listening(router.pid) == [f"tcp 0100007F:{port:04X}"]
        assert listening(echo.pid) == []


@pytest.fixture
def fleet(tmp_path: Path) -> Authority:
    return Authority(tmp_path, "fleet")


@pytest.fixture
def guarded(fleet: Authority) -> Iterator[str]:
    """Yield where a router listens that wants certificates."""
    where = f"tls/127.0.0.1:{free_port()}"
    with closing(open_zenoh("router", listen=[where], tls=fleet.tls("router"))):
        yield where


def deployment(folder: Path, guarded: str, **tls: str) -> Deployment:
    network = {"connect": [guarded], "tls": {"root_ca": "fleet.pem", **tls}}
    return parse_deployment({"environment": "e", "cars": [{"name": "svea7"}], "network": network}, folder / "lab.toml")


def test_those_of_the_fleet_talk(tmp_path: Path, fleet: Authority, guarded: str) -> None:
    fleet.certify("station")
    wanted = deployment(tmp_path, guarded, certificate="station.pem", key="station.key")
    with closing(open_transport(wanted)) as one, closing(open_transport(wanted)) as other:
        heard = heard_by(other, "fleet/x")
        wait_until(lambda: heard, lambda: one.publish("fleet/x", b"secret", b"signed"))
    assert (heard[0].payload, heard[0].attachment) == (b"secret", b"signed")


def test_a_router_of_another_authority_is_refused(tmp_path: Path, fleet: Authority, guarded: str) -> None:
    other = Authority(tmp_path, "other")
    fleet.certify("station")
    wanted = deployment(tmp_path, guarded, root_ca=other.file.name, certificate="station.pem", key="station.key")
    with pytest.raises(LinkError, match=rf"^{guarded}: no Zenoh there \(its certificate is refused: .*issuer.*\)$"):
        open_transport(wanted, timeout=1.0)


def test_a_router_with_another_address_in_its_certificate_is_refused(tmp_path: Path, fleet: Authority) -> None:
    where = f"tls/127.0.0.1:{free_port()}"
    fleet.certify("station")
    wanted = deployment(tmp_path, where, certificate="station.pem", key="station.key")
    with (
        closing(open_zenoh("router", listen=[where], tls=fleet.tls("r", "127.0.0.2"))),
        pytest.raises(LinkError, match=r"its certificate is refused: .*127\.0\.0\.1"),
    ):
        open_transport(wanted, timeout=1.0)


def test_clients_without_a_certificate_of_the_fleet_are_refused(tmp_path: Path, guarded: str) -> None:
    Authority(tmp_path, "other").certify("stranger")
    for shown in ({}, {"certificate": "stranger.pem", "key": "stranger.key"}):
        with pytest.raises(LinkError, match=rf"^{guarded}: no Zenoh there \([^\n]+\)$"):
            open_transport(deployment(tmp_path, guarded, **shown), timeout=1.0)


BAD = {
    "no such authority": ({"root_ca": "none.pem"}, "network.tls.root_ca: {0}/none.pem: cannot be read (No such file"),
    "no authority": ({"root_ca": "a.key"}, "network.tls.root_ca: {0}/a.key holds no certificate in PEM"),
    "no such key": ({"key": "none.key"}, "network.tls.key: {0}/none.key: cannot be read (No such file"),
    "an open key": ({"key": "open.key"}, "network.tls.key: {0}/open.key can be read by others; run: chmod 600"),
    "another's key": ({"key": "b.key"}, "network.tls.certificate, tls.key: {0}/a.pem and {0}/b.key are no certificate"),
}


@pytest.mark.parametrize("case", BAD)
def test_files_that_cannot_be_used_are_named_in_one_line(tmp_path: Path, fleet: Authority, case: str) -> None:
    changed, said = BAD[case]
    for name in ("a", "b", "open"):
        fleet.certify(name)
    (tmp_path / "open.key").chmod(0o644)
    with pytest.raises(DeploymentError) as caught:
        open_transport(deployment(tmp_path, "tls/127.0.0.1:1", **{"certificate": "a.pem", "key": "a.key", **changed}))
    assert said.format(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_endpoints_have_three_parts() -> None:
    assert address_of("tcp/127.0.0.1:7447") == Address("tcp", "127.0.0.1", 7447)
    assert address_of("tls/car.lab:0#iface=eth0") == Address("tls", "car.lab", 0)
    assert address_of("tcp/[::1]:7447") == Address("tcp", "::1", 7447)
    assert address_of("tcp/[::1]:7447").authority == "[::1]:7447"


def test_loopback_addresses_are_recognised() -> None:
    here = ["127.0.0.1", "127.1.2.3", "[::1]", "localhost", "LocalHost"]
    hosts = [*here, "0.0.0.0", "10.0.0.1", "[::]", "[fe80::1]", "localhost.lab", "127.0.0.1.lab", "car"]
    assert [host for host in hosts if address_of(f"tcp/{host}:7447").loopback] == here


@pytest.mark.parametrize(
    "text", ["", "tcp", "tcp/", "tcp/a", "tcp/a:b", "tcp/a:65536", "http/a:1", "tcp/a b:1", "tcp/a:1\n"]
)
def test_malformed_endpoints_are_refused(text: str) -> None:
    with pytest.raises(CoopenvError, match="is no endpoint, expected for example"):
        address_of(text)
