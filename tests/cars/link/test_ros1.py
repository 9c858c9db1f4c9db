"""ROS 1 topics, with Debian's rospy and master on the loopback."""

from __future__ import annotations

import gc
import os
import socket
import struct
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.link import ros1
from coopenv.cars.link.connect import open_transport
from coopenv.cars.link.ros1 import ENVELOPE, open_ros1, opened, sealed
from coopenv.cars.link.transport import Address, LinkError
from coopenv.cars.messages.codec import decode, encode, header, make
from coopenv.cars.messages.codec import ros1 as types_of_ros1
from coopenv.cars.settings.deployment import parse_deployment
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.brokers import ros_master
from tests.helpers.processes import started, wait_until
from tests.helpers.wire import free_port, heard_by, listening

TYPES = dict.fromkeys(("agent7/riccatiPoint", "agent8/riccatiPoint"), "geometry_msgs/msg/PointStamped")

AUTHORS = """
import os, sys, rospy
from geometry_msgs.msg import PointStamped
os.environ.update(ROS_MASTER_URI=sys.argv[1], ROS_IP="127.0.0.1")
rospy.init_node("authors", disable_signals=True)
back = rospy.Publisher("/agent8/riccatiPoint", PointStamped, queue_size=10)
def answer(message):
    message.point.x, message.point.z = message.point.z, message.point.x
    back.publish(message)
rospy.Subscriber("/agent7/riccatiPoint", PointStamped, answer)
print("ready", flush=True)
sys.stdin.read()
"""
"""A node with the messages that Debian has made of the definitions, without anything of ours."""


def authors(endpoint: str) -> AbstractContextManager[subprocess.Popen[str]]:
    uri = endpoint.replace("tcp/", "http://")
    return started((sys.executable, "-c", AUTHORS, uri), Path.cwd(), stdin=subprocess.PIPE)


def point(x: float) -> bytes:
    return struct.pack("<IIII", 0, 3, 4, 3) + b"map" + struct.pack("<3d", x, 2.0, 7.0)


def test_without_rospy_one_line_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(CoopenvError, match=r"^ROS 1 needs rospy: install Debian's python3-rospy [^\n]+$"):
        open_ros1("tcp/127.0.0.1:11311", {})


@given(payload=st.binary(max_size=99), attachment=st.binary(max_size=99))
def test_an_envelope_is_a_message_of_bytes(payload: bytes, attachment: bytes) -> None:
    message = types_of_ros1().deserialize_ros1(sealed(payload, attachment), ENVELOPE)
    assert bytes(message.data[4:]) == attachment + payload
    assert opened(sealed(payload, attachment)) == (payload, attachment)


@given(message=st.binary(max_size=64))
def test_malformed_envelopes_are_not_opened(message: bytes) -> None:
    found = opened(message)
    assert found is None or sealed(*found) == message


@pytest.mark.filterwarnings("error")
def test_a_missing_master_is_reported_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1, "rospy", lambda: None)  # it is not asked before there is a master
    began = time.monotonic()
    nobody = Address("tcp", "127.0.0.1", free_port())
    with pytest.raises(LinkError, match=r"^tcp/127\.0\.0\.1:\d+: no ROS master there \(Connection refused\)$"):
        ros1.join(nobody, 0.5)
    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        pytest.raises(LinkError, match=r"no ROS master there \(timed out\)$"),
    ):
        ros1.join(Address("tcp", "127.0.0.1", mute.getsockname()[1]), 0.5)
    assert time.monotonic() - began < 20.0
    gc.collect()  # a connection left open warns here


@pytest.mark.ros1
def test_a_node_of_the_authors_stack_understands_the_bytes() -> None:
    with ros_master() as endpoint, authors(endpoint):
        ours = open_ros1(endpoint, TYPES)
        heard = heard_by(ours, "agent8/riccatiPoint")
        wait_until(lambda: heard, lambda: ours.publish("agent7/riccatiPoint", point(1.0)))
        ours.close()
        assert heard[0].topic == "agent8/riccatiPoint"
        assert heard[0].payload[16:] == b"map" + struct.pack("<3d", 7.0, 2.0, 1.0)
        servers = listening(os.getpid())  # those of rospy
        assert servers and all("0100007F" in place for place in servers)


@pytest.mark.ros1
def test_a_node_goes_on_when_its_master_is_back() -> None:
    with ros_master() as endpoint:
        ours = open_ros1(endpoint, TYPES)
        heard = heard_by(ours, "agent8/riccatiPoint")
        ours.publish("agent7/riccatiPoint", point(1.0))
    with ros_master() as endpoint, authors(endpoint):
        wait_until(lambda: heard, lambda: ours.publish("agent7/riccatiPoint", point(2.0)))
        ours.close()
    assert heard[-1].payload[19:] == struct.pack("<3d", 7.0, 2.0, 2.0)


@pytest.mark.ros1
def test_a_process_is_a_node_of_one_master_only() -> None:
    with ros_master() as endpoint:
        open_ros1(endpoint, {}).close()
        with pytest.raises(LinkError, match=r"this process is a node of http://.* already"):
            open_ros1(endpoint.replace("127.0.0.1", "localhost"), {})


@pytest.mark.ros1
def test_a_deployment_reaches_the_authors_stack(tmp_path: Path) -> None:
    cars = [{"name": f"svea{n}", "agent": n} for n in (7, 8)]
    with ros_master() as endpoint, authors(endpoint):
        network = {"kind": "ros1", "connect": [endpoint]}
        fleet = parse_deployment({"environment": "e", "cars": cars, "network": network}, tmp_path / "lab.toml")
        station = open_transport(fleet)
        heard = heard_by(station, SVEA.topic_of("svea8", Role.POINT))
        message = encode(make("geometry_msgs/msg/PointStamped", header=header(5, "map"), point=(1.0, 2.0, 3.0)))
        wait_until(lambda: heard, lambda: station.publish(SVEA.topic_of("svea7", Role.POINT), message))
        station.close()
    received_point = decode(heard[0].payload, SVEA.topics[Role.POINT].type).point
    assert (received_point.x, received_point.y, received_point.z) == (3.0, 2.0, 1.0)
