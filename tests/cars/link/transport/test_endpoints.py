"""Endpoints, and why one cannot be reached."""

from __future__ import annotations

import socket

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.transport.base import Address, address_of, trouble_at
from tests.helpers.wire import free_port


def test_endpoints_have_three_parts() -> None:
    assert address_of("tcp/127.0.0.1:7447") == Address("tcp", "127.0.0.1", 7447)
    assert address_of("tls/car.lab:0#iface=eth0") == Address("tls", "car.lab", 0)
    assert address_of("tcp/[::1]:7447") == Address("tcp", "::1", 7447)
    assert address_of("tcp/[::1]:7447").authority == "[::1]:7447"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "[::1]", "localhost", "LocalHost"])
def test_what_is_on_this_computer(host: str) -> None:
    assert address_of(f"tcp/{host}:7447").loopback


@pytest.mark.parametrize("host", ["0.0.0.0", "10.0.0.1", "[::]", "[fe80::1]", "localhost.lab", "127.0.0.1.lab", "car"])
def test_what_may_be_elsewhere(host: str) -> None:
    assert not address_of(f"tcp/{host}:7447").loopback


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
