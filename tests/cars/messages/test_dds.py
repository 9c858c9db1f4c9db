"""Messages of cars on real DDS: their bytes and names beside those of CycloneDDS.

A stand-in for zenoh-bridge-ros2dds takes samples of DDS under `rt/NAME` with types `pkg::msg::dds_::T_`, and passes on
their CDR under NAME. CycloneDDS encodes and decodes all samples by its own codec.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages import codec
from coopenv.cars.settings.profile import SVEA, CarProfile, Role, load_profile
from tests.helpers.fakes import EXACT, OVERTAKING, Stage

pytest.importorskip("cyclonedds", reason="needs cyclonedds, which has no wheel for this platform")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

PATIENCE = 60.0  # s until a sample must be there
NUMBERS = {name: getattr(types, name) for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32")}
NUMBERS |= {"uint64": types.uint64, "float32": types.float32, "float64": types.float64, "bool": bool, "string": str}
KINDS = sorted({topic.type for name in ("svea", "diffdrive") for topic in load_profile(name).topics.values()})
LOOPBACK = """<CycloneDDS><Domain id="any"><General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery>
<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


@cache
def struct(kind: str) -> Any:
    """Return the type of DDS of a ROS 2 type."""
    package, _, name = kind.split("/")
    fields = {field: dds_type(node) for field, node in codec.ros2().fielddefs[kind][1]}
    return make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)


def dds_type(node: Any) -> Any:
    """Return the type of a field, which rosbags describes."""
    shape, of = node
    if shape.name == "BASE":
        return NUMBERS[of[0]]
    if shape.name == "NAME":
        return struct(of)
    return types.array[dds_type(of[0]), of[1]] if shape.name == "ARRAY" else types.sequence[dds_type(of[0])]


def draw(node: Any, rng: np.random.Generator) -> tuple[Any, Any]:
    """Return a random value of a field as this project and as DDS have it."""
    shape, of = node
    if shape.name == "NAME":
        pairs = {field: draw(inner, rng) for field, inner in codec.ros2().fielddefs[of][1]}
        ours, theirs = ({field: pair[k] for field, pair in pairs.items()} for k in (0, 1))
        return codec.make(of, **ours), struct(of)(**theirs)
    if shape.name == "BASE":
        if of[0] == "string":
            text = "".join(map(chr, rng.integers(97, 123, rng.integers(0, 9))))
            return text, text
        if of[0] == "bool":
            flag = bool(rng.integers(2))
            return flag, flag
        if of[0].startswith("float"):
            value = float(np.float32(rng.normal()))
        else:
            bounds = np.iinfo(of[0])
            value = int(rng.integers(bounds.min, bounds.max, dtype=of[0], endpoint=True))
        return value, value
    drawn = [draw(of[0], rng) for _ in range(of[1] if shape.name == "ARRAY" else int(rng.integers(4)))]
    ours, theirs = [a for a, _ in drawn], [b for _, b in drawn]
    return ours, theirs


def dds_bytes(sample: Any) -> bytes:
    """Return the CDR of a sample; padding at its end does not count."""
    return bytes(sample.serialize(use_version_2=False))


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_are_those_of_dds(kind: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        ours, theirs = draw((Nodetype.NAME, kind), rng)
        payload = codec.encode(ours)
        assert payload[4:] == dds_bytes(theirs)[4:]
        assert struct(kind).deserialize(payload) == theirs
        assert codec.encode(codec.decode(dds_bytes(theirs), kind)) == payload


class Bridge:
    """One end of DDS: what is put there under a key goes out as a sample, and samples come as (key, CDR)."""

    def __init__(self, profile: CarProfile, car: str, writes: tuple[Role, ...], reads: tuple[Role, ...]) -> None:
        self._participant = DomainParticipant(DOMAIN)
        qos = Qos(Policy.Reliability.Reliable(duration(seconds=10)), Policy.History.KeepAll)
        keys = {role: profile.topic_of(car, role) for role in (*writes, *reads)}
        self._types = {key: struct(profile.topics[role].type) for role, key in keys.items()}
        topics = {key: Topic(self._participant, f"rt/{key}", kind) for key, kind in self._types.items()}
        self._writers = {keys[role]: DataWriter(self._participant, topics[keys[role]], qos=qos) for role in writes}
        self._readers = {keys[role]: DataReader(self._participant, topics[keys[role]], qos=qos) for role in reads}

    def wait_for_peers(self) -> None:
        """Wait until every topic has its other end."""
        wait(lambda: all(w.get_matched_subscriptions() for w in self._writers.values()))
        wait(lambda: all(r.get_matched_publications() for r in self._readers.values()))

    def put(self, key: str, payload: bytes) -> bool:
        """Write a message; False: not a topic of this end."""
        if key in self._writers:
            self._writers[key].write(self._types[key].deserialize(payload))
        return key in self._writers

    def take(self, count: int) -> list[tuple[str, bytes]]:
        """Return so many messages, as they come."""
        found: list[tuple[str, bytes]] = []

        def enough() -> bool:
            for key, reader in self._readers.items():
                found.extend((key, dds_bytes(sample)) for sample in reader.take(N=1000))
            return len(found) >= count

        wait(enough)
        return found


def wait(until: Any) -> None:
    end = time.monotonic() + PATIENCE
    while not until():
        assert time.monotonic() < end, "nothing has come over DDS"
        time.sleep(0.01)


DOMAIN = 1 + os.getpid() % 200


@pytest.fixture(scope="module")
def domain() -> Iterator[Domain]:
    """A domain of DDS on the loopback."""
    yield Domain(DOMAIN, LOOPBACK)


SENSED = (Role.DETECTIONS, Role.WHEEL, Role.IMU, Role.TRUTH, Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)


@pytest.mark.parametrize("name", ["svea", "diffdrive"])
def test_a_car_on_dds_is_read_and_driven(name: str, domain: Domain) -> None:
    profile = SVEA if name == "svea" else load_profile(name)
    stage = Stage("svea_overtaking", OVERTAKING, EXACT, profile=profile)
    ros, zenoh = Bridge(profile, "svea7", SENSED, (Role.MANUAL,)), Bridge(profile, "svea7", (Role.MANUAL,), SENSED)
    ros.wait_for_peers()
    zenoh.wait_for_peers()
    stage.run(1.05)
    sent = [(a.topic, a.payload) for a in stage.hub_arrivals if ros.put(a.topic, a.payload)]
    come = zenoh.take(len(sent))
    assert sorted(come) == sorted(sent) and {key for key, _ in come} == {profile.topic_of("svea7", r) for r in SENSED}
    read = stage.roles_read(Arrival(key, payload, stage.wall + stage.now) for key, payload in come)
    assert {Role.DETECTIONS, Role.WHEEL, Role.IMU, Role.TRUTH} <= read
    for _ in range(20):
        zenoh.put(
            profile.topic_of("svea7", Role.MANUAL),
            write_drive(stage.wall + stage.now, profile.command, MotionCommand(0.1, 0.3)),
        )
        for key, payload in ros.take(1):
            stage.network.publish(key, payload)
        stage.run(0.05)
    assert stage.cars["svea7"].world.twist[0][0] == pytest.approx(0.3, abs=0.02)
