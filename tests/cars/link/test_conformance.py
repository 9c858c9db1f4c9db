"""Common behaviour of all networks, and the names and types of the authors' topics."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.fake.lockstep import Hub, HubTransport
from coopenv.cars.link.nats import open_nats
from coopenv.cars.link.ros1 import Authors, open_ros1, routes_of
from coopenv.cars.link.transport import Arrival, Transport, matcher
from coopenv.cars.link.zenoh import open_zenoh
from coopenv.cars.messages.codec import decode, encode, header, make, ros1
from coopenv.cars.messages.readings import CarPose, read
from coopenv.cars.settings.deployment import Car, DeploymentError
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.brokers import nats_server, ros_master
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


def ros1_network(folder: Path) -> Iterator[Connect]:
    with ros_master() as endpoint:  # one for all tests: a process can be a node of one master only
        yield lambda: open_ros1(endpoint, {})


NETWORKS = [
    pytest.param(local, id="local"),
    pytest.param(zenoh, id="zenoh"),
    pytest.param(nats, id="nats", marks=pytest.mark.nats),
    pytest.param(ros1_network, id="ros1", marks=pytest.mark.ros1),
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
    wait_until(lambda: heard, lambda: sender.publish("fleet/settle", b""))


def test_messages_arrive_in_order_with_their_attachments(connect: Connect) -> None:
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


def test_presence_is_seen_by_earlier_and_later_connections(connect: Connect) -> None:
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


CAR = Car(name="svea1", agent=7)
STAMP = 3_000_000_004
POINT = struct.pack("<IIII", 0, 3, 4, 3) + b"map" + struct.pack("<3d", 1.5, -2.0, 0.25)
ESTIMATE, HEARD = SVEA.topic_of("svea1", Role.ESTIMATE), SVEA.topic_of("svea1", Role.POINT)


def ends() -> tuple[Authors, HubTransport, list[Arrival]]:
    """Return a translating end, a plain one on the same network and what that hears."""
    hub = Hub()
    plain, heard = hub.connect(), []  # type: ignore[var-annotated]
    plain.subscribe("**", heard.append)
    return Authors(hub.connect(), routes_of(CAR)), plain, heard


def test_an_estimate_is_the_43_bytes_of_a_riccati_point_and_itself() -> None:
    authors, _, heard = ends()
    pose = {"pose": ((1.5, -2.0, 0.25), (0.0, 0.0, 0.6, 0.8)), "covariance": np.eye(6)}
    estimate = encode(make(SVEA.topics[Role.ESTIMATE].type, header=header(STAMP, "map"), pose=pose))
    authors.publish(ESTIMATE, estimate, b"signed")
    assert [(a.topic, a.payload, a.attachment) for a in heard] == [
        (ESTIMATE, estimate, b"signed"),
        ("agent7/riccatiPoint", POINT, b""),
    ]
    assert len(POINT) == 43


def test_a_riccati_point_is_a_position_without_orientation_or_covariance() -> None:
    authors, plain, _ = ends()
    heard = heard_by(authors, HEARD)
    plain.publish("agent7/riccatiPoint", struct.pack("<I", 77) + POINT[4:], b"signed")
    plain.publish("agent8/riccatiPoint", POINT)
    assert [(a.topic, a.attachment) for a in heard] == [(HEARD, b"signed")]
    message = decode(heard[0].payload, SVEA.topics[Role.POINT].type)
    reading = read(Role.POINT, message)
    assert isinstance(reading, CarPose)
    np.testing.assert_array_equal(reading.position, [1.5, -2.0, 0.25])
    assert reading.rotation is None
    assert reading.covariance is None
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP


def test_a_command_of_the_gate_is_the_low_level_request() -> None:
    """0.2 rad to the left and 0.8 m/s, as KTH's interface says it."""
    authors, _, heard = ends()
    message = make(SVEA.topics[Role.MANUAL].type, y=-286.48, z=500.0 - 5 * 100 * 0.8 / 1.7, aux3=1000.0)
    authors.publish(SVEA.topic_of("svea1", Role.MANUAL), encode(message))
    sent = {arrival.topic: arrival.payload for arrival in heard}["agent7/lli/ctrl_request"]
    assert struct.unpack("<bb", sent[:2]) == (36, 70)
    assert len(sent) == 4


def test_commands_reach_the_low_level_only_through_the_gate() -> None:
    authors, _, heard = ends()
    topic = SVEA.topic_of("svea1", Role.COMMAND)
    authors.publish(topic, encode(make(SVEA.topics[Role.COMMAND].type)), b"signed")
    assert [(arrival.topic, arrival.attachment) for arrival in heard] == [(topic, b"signed")]


NAMES = {
    Role.DETECTIONS: "agent7/pixy_node/objectsInfo",
    Role.BEARINGS: "agent7/pixy_landmark_detection/objectsBearing",
    Role.CAMERA_INFO: "agent7/pixy_node/camera_info",
    Role.WHEEL: "agent7/actuation_twist",
    Role.TRUTH: "qualisys/svea1/odom",
    Role.POINT: "agent7/riccatiPoint",
}


def filled(kind: str, draw: Any) -> Any:
    """Return a message of a type full of numbers."""
    message = make(kind)

    def fill(part: Any) -> None:
        for name, value in vars(part).items():
            if name == "__msgtype__":
                continue
            if isinstance(value, np.ndarray):
                value[:] = draw(st.floats(-1e3, 1e3))
            elif isinstance(value, str):
                setattr(part, name, draw(st.text(max_size=9, alphabet="abc/_")))
            elif isinstance(value, bool | int):
                setattr(part, name, type(value)(draw(st.integers(0, 1))))
            elif isinstance(value, float):
                setattr(part, name, draw(st.floats(width=32, allow_nan=False)))
            elif isinstance(value, list):
                block = "ObjectInfo" if name == "objects" else "ObjectBearing"
                value.extend(filled(f"pixy_camera/msg/{block}", draw) for _ in range(draw(st.integers(0, 3))))
            else:
                fill(value)

    fill(message)
    return message


@given(data=st.data(), role=st.sampled_from(list(NAMES)))
def test_exact_counterparts_come_back_as_the_bytes_they_were(data: st.DataObject, role: Role) -> None:
    sender, plain, on_the_wire = ends()
    receiver = Authors(plain, routes_of(CAR))
    heard = heard_by(receiver, "fleet/**")
    sent = encode(filled(SVEA.topics[role].type, data.draw))
    sender.publish(SVEA.topic_of("svea1", role), sent, b"signed")
    assert [arrival.topic for arrival in on_the_wire] == [NAMES[role]]
    assert ros1().deserialize_ros1(on_the_wire[0].payload, SVEA.topics[role].type).header.seq == 0
    assert [(a.topic, a.payload, a.attachment) for a in heard] == [(SVEA.topic_of("svea1", role), sent, b"signed")]


def test_bytes_that_are_no_such_message_go_no_further() -> None:
    authors, plain, heard = ends()
    back = heard_by(authors, HEARD)
    plain.publish("agent7/riccatiPoint", b"junk")
    authors.publish(SVEA.topic_of("svea1", Role.WHEEL), b"junk")
    assert not back
    assert [arrival.payload for arrival in heard] == [b"junk"]


def test_messages_of_ours_and_presences_pass_untouched() -> None:
    authors, plain, _ = ends()
    back = heard_by(authors, "**")
    seen = seen_by(authors)
    plain.announce("fleet/alive/svea1")
    plain.publish("fleet/svea1/coopenv/gate", b"anything", b"signed")
    plain.publish("agent7/riccatiPoint", POINT)
    assert seen == [("fleet/alive/svea1", True)]
    assert [arrival.topic for arrival in back] == ["fleet/svea1/coopenv/gate", HEARD]
    authors.close()
    plain.publish("fleet/svea1/coopenv/gate", b"anything")
    assert len(back) == 2


def test_a_car_has_the_number_of_its_marker_or_needs_one() -> None:
    assert {route.name for route in routes_of(Car(name="c", marker=3))} >= {"agent3/riccatiPoint", "qualisys/c/odom"}
    with pytest.raises(DeploymentError, match=r"^cars: c: agent is missing: "):
        routes_of(Car(name="c"))


def test_every_counterpart_has_another_name_unless_it_is_of_the_same_thing() -> None:
    names = [route.name for route in routes_of(CAR)]
    assert len(names) == len(set(names)) + 1
    assert {route.role for route in routes_of(CAR) if route.exact} == set(NAMES)
