"""What every transport does, tried on each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.transport.base import Transport, matcher
from coopenv.cars.transport.nats import open_nats
from coopenv.cars.transport.ros1 import open_ros1
from coopenv.cars.transport.zenoh import open_zenoh
from tests.helpers.brokers import nats_server, ros_master
from tests.helpers.hub import Hub
from tests.helpers.processes import wait_until
from tests.helpers.wire import free_endpoint, free_port, heard_by, seen_by

Connect = Callable[[], Transport]


def local(folder: Path) -> Iterator[Connect]:
    yield Hub().connect


def zenoh(folder: Path) -> Iterator[Connect]:
    endpoint = free_endpoint()
    router = open_zenoh("router", listen=[endpoint])
    yield lambda: open_zenoh("client", connect=[endpoint])
    router.close()


def nats(folder: Path) -> Iterator[Connect]:
    port = free_port()
    with nats_server(port, folder):
        yield lambda: open_nats([f"nats/127.0.0.1:{port}"])


def ros1(folder: Path) -> Iterator[Connect]:
    with ros_master() as endpoint:  # one for all tests: a process can be a node of one master only
        yield lambda: open_ros1(endpoint, {})


NETWORKS = [
    pytest.param(local, id="local"),
    pytest.param(zenoh, id="zenoh"),
    pytest.param(nats, id="nats", marks=pytest.mark.nats),
    pytest.param(ros1, id="ros1", marks=pytest.mark.ros1),
]


@pytest.fixture(params=NETWORKS)
def connect(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Connect]:
    """Open connections to one network; all end with the test."""
    with ExitStack() as stack:
        for opened in request.param(tmp_path):

            def ending(opened: Connect = opened) -> Transport:
                transport = opened()
                stack.callback(transport.close)
                return transport

            yield ending
            stack.close()


def settle(sender: Transport, receiver: Transport) -> None:
    """Wait until what the receiver has subscribed to is known to the sender."""
    heard = heard_by(receiver, "fleet/settle")

    def arrived() -> bool:
        sender.publish("fleet/settle", b"")
        return bool(heard)

    wait_until(arrived)


def test_messages_arrive_in_order_with_what_is_beside_them(connect: Connect) -> None:
    sender, receiver = connect(), connect()
    heard = heard_by(receiver, "fleet/svea7/x")
    settle(sender, receiver)
    payloads = [bytes([i]) * (i + 1) for i in range(50)]
    for payload in payloads:
        sender.publish("fleet/svea7/x", payload, b"\0signed\xff" + payload, reliable=True)
    wait_until(lambda: len(heard) == 50)
    assert [arrival.payload for arrival in heard] == payloads
    assert [arrival.attachment for arrival in heard] == [b"\0signed\xff" + payload for payload in payloads]
    assert {arrival.topic for arrival in heard} == {"fleet/svea7/x"}


def test_patterns_choose(connect: Connect) -> None:
    sender, receiver = connect(), connect()
    one, all_, exact = (heard_by(receiver, p) for p in ("fleet/*/x", "fleet/a/**", "fleet/a/x/y"))
    settle(sender, receiver)

    def complete() -> bool:  # on ROS 1 a pattern finds new topics a moment later
        for topic in ("fleet/b/y", "fleet/a/x", "fleet/b/x", "fleet/a/x/y", "fleet/a"):
            sender.publish(topic, topic.encode(), urgent=True, reliable=True)
        return len({a.topic for a in all_}) >= 3 and len({a.topic for a in one}) >= 2 and bool(exact)

    wait_until(complete)
    assert {arrival.topic for arrival in one} == {"fleet/a/x", "fleet/b/x"}
    assert {arrival.topic for arrival in all_} == {"fleet/a", "fleet/a/x", "fleet/a/x/y"}
    assert {arrival.topic for arrival in exact} == {"fleet/a/x/y"}
    assert all(arrival.payload == arrival.topic.encode() for arrival in (*one, *all_, *exact))


def test_who_is_there_is_seen_by_those_who_came_before_and_after(connect: Connect) -> None:
    early, car, late = connect(), connect(), connect()
    everything, seen = heard_by(early, "**"), seen_by(early)
    car.announce("fleet/alive/svea7")
    car.announce("fleet/elsewhere/svea7")
    wait_until(lambda: seen)
    seen_late = seen_by(late)
    wait_until(lambda: seen_late)
    car.close()
    wait_until(lambda: len(seen) == 2 and len(seen_late) == 2)
    assert seen == seen_late == [("fleet/alive/svea7", True), ("fleet/alive/svea7", False)]
    assert not everything


def test_a_closed_connection_is_silent(connect: Connect) -> None:
    sender, closed, receiver = connect(), connect(), connect()
    heard, unheard = heard_by(receiver, "fleet/x"), heard_by(closed, "fleet/x")
    settle(sender, closed)
    settle(sender, receiver)
    closed.close()
    closed.close()
    closed.publish("fleet/x", b"closed")
    sender.publish("fleet/x", b"open", reliable=True)
    wait_until(lambda: heard)
    assert [arrival.payload for arrival in heard] == [b"open"]
    assert not unheard


PARTS = st.sampled_from(["fleet", "svea7", "a.b", "*", "**"])


@given(
    pattern=st.lists(PARTS, min_size=1, max_size=5),
    topic=st.lists(st.sampled_from(["fleet", "svea7", "a.b", "axb"]), min_size=1, max_size=5),
)
def test_patterns_match_as_in_zenoh(pattern: list[str], topic: list[str]) -> None:
    keys = pytest.importorskip("zenoh", reason="needs the extra 'svea'").KeyExpr
    meant = keys.autocanonize("/".join(pattern)).includes(keys("/".join(topic)))
    assert matcher("/".join(pattern))("/".join(topic)) == meant
