"""TLS of the transport: who has no certificate of the fleet's authority gets nowhere."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.deployment import Deployment, DeploymentError, parse_deployment
from coopenv.cars.transport.base import Address, Certificates, LinkError, address_of, trouble_at
from coopenv.cars.transport.zenoh import open_transport, open_zenoh
from tests.helpers.authority import Authority
from tests.helpers.processes import wait_until
from tests.helpers.wire import free_port, heard_by


@pytest.fixture
def fleet(tmp_path: Path) -> Authority:
    return Authority(tmp_path, "fleet")


@pytest.fixture
def endpoint(fleet: Authority) -> Iterator[str]:
    """Yield where a router listens that wants certificates."""
    where = f"tls/127.0.0.1:{free_port()}"
    with closing(open_zenoh("router", listen=[where], tls=Certificates(fleet.file, *fleet.certify("router")))):
        yield where


def deployment(folder: Path, endpoint: str, **tls: str) -> Deployment:
    network = {"connect": [endpoint], "tls": {"root_ca": "fleet.pem", **tls}}
    return parse_deployment({"environment": "e", "cars": [{"name": "svea7"}], "network": network}, folder / "lab.toml")


def test_those_of_the_fleet_talk(tmp_path: Path, fleet: Authority, endpoint: str) -> None:
    fleet.certify("station")
    wanted = deployment(tmp_path, endpoint, certificate="station.pem", key="station.key")
    with closing(open_transport(wanted)) as one, closing(open_transport(wanted)) as other:
        heard = heard_by(other, "fleet/x")
        wait_until(lambda: one.publish("fleet/x", b"secret", b"signed") or heard)  # type: ignore[func-returns-value]
    assert (heard[0].payload, heard[0].attachment) == (b"secret", b"signed")


def test_a_router_of_another_authority_is_refused(tmp_path: Path, fleet: Authority, endpoint: str) -> None:
    other = Authority(tmp_path, "other")
    fleet.certify("station")
    wanted = deployment(tmp_path, endpoint, root_ca=other.file.name, certificate="station.pem", key="station.key")
    with pytest.raises(LinkError, match=rf"^{endpoint}: no Zenoh there \(its certificate is refused: .*issuer.*\)$"):
        open_transport(wanted, timeout=1.0)


def test_a_router_with_another_address_in_its_certificate_is_refused(tmp_path: Path, fleet: Authority) -> None:
    where = f"tls/127.0.0.1:{free_port()}"
    fleet.certify("station")
    wanted = deployment(tmp_path, where, certificate="station.pem", key="station.key")
    with (
        closing(open_zenoh("router", listen=[where], tls=Certificates(fleet.file, *fleet.certify("r", "127.0.0.2")))),
        pytest.raises(LinkError, match=r"its certificate is refused: .*127\.0\.0\.1"),
    ):
        open_transport(wanted, timeout=1.0)


def test_who_shows_no_certificate_or_a_foreign_one_is_refused(tmp_path: Path, endpoint: str) -> None:
    Authority(tmp_path, "other").certify("stranger")
    for shown in ({}, {"certificate": "stranger.pem", "key": "stranger.key"}):
        with pytest.raises(LinkError, match=rf"^{endpoint}: no Zenoh there \([^\n]+\)$"):
            open_transport(deployment(tmp_path, endpoint, **shown), timeout=1.0)


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


def test_what_is_on_this_computer_and_what_may_be_elsewhere() -> None:
    here = ["127.0.0.1", "127.1.2.3", "[::1]", "localhost", "LocalHost"]
    hosts = [*here, "0.0.0.0", "10.0.0.1", "[::]", "[fe80::1]", "localhost.lab", "127.0.0.1.lab", "car"]
    assert [host for host in hosts if address_of(f"tcp/{host}:7447").loopback] == here


@pytest.mark.parametrize(
    "text", ["", "tcp", "tcp/", "tcp/a", "tcp/a:b", "tcp/a:65536", "http/a:1", "tcp/a b:1", "tcp/a:1\n"]
)
def test_what_is_none_is_refused(text: str) -> None:
    with pytest.raises(CoopenvError, match="is no endpoint, expected for example"):
        address_of(text)


def test_the_reason_of_a_failure_is_found() -> None:
    assert trouble_at(Address("tcp", "127.0.0.1", free_port()), None, 1.0) == "Connection refused"
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert trouble_at(Address("tcp", "127.0.0.1", server.getsockname()[1]), None, 1.0) is None
