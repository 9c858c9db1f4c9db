"""Drives on tape, as other tools read them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from coopenv.backends.svea.tape import ATTACHMENT, NAME, Tape
from coopenv.backends.svea.taped import Taped
from coopenv.errors import OutputError
from coopenv.svea.codec import encode, header, make
from coopenv.svea.definitions import TICK
from coopenv.svea.topics import TICK_TOPIC, TOPICS, Role, topic_of
from coopenv.svea.transport.local import Hub
from coopenv.svea.warm_up import empty

WHEEL, FRAMES = topic_of("svea7", Role.WHEEL), topic_of("svea7", Role.DETECTIONS)
TYPES = {WHEEL: TOPICS[Role.WHEEL].type, FRAMES: TOPICS[Role.DETECTIONS].type}


@pytest.fixture
def written(tmp_path: Path) -> Path:
    tape = Tape(tmp_path / "drive.mcap", json.dumps({"cars": 1}).encode(), TYPES)
    tape.begin(10**9, 2**64 - 1, 3)
    for k in range(20):
        now = 10**9 + k * 10**7
        twist = make(
            TYPES[WHEEL], header=header(now - 5, "base_link"), twist=empty("geometry_msgs/msg/TwistWithCovariance")
        )
        twist.twist.twist.linear.x = 0.1 * k
        tape.write(WHEEL, encode(twist), now)
        frame = make(TYPES[FRAMES], header=header(now), objects=[empty("pixy_camera/msg/ObjectInfo")] * (k % 3))
        tape.write(FRAMES, encode(frame), now)
        tape.write("fleet/nobody/knows", b"123", now)
        tape.tick(k + 1, now)
    tape.close()
    return tmp_path / "drive.mcap"


def test_rosbags_reads_it_as_a_bag_of_ros_2(written: Path) -> None:
    with AnyReader([written]) as reader:
        found = {c.topic: c.msgtype for c in reader.connections}
        assert found == {f"/{WHEEL}": TYPES[WHEEL], f"/{FRAMES}": TYPES[FRAMES], f"/{TICK_TOPIC}": TICK}
        messages = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    speeds = [m.twist.twist.linear.x for topic, _, m in messages if topic == f"/{WHEEL}"]
    assert speeds == [0.1 * k for k in range(20)]
    assert [len(m.objects) for topic, _, m in messages if topic == f"/{FRAMES}"] == [k % 3 for k in range(20)]
    first = next(m for topic, _, m in messages if topic == f"/{TICK_TOPIC}")
    assert (first.index, first.key, first.episode) == (0, 2**64 - 1, 3)


def test_the_mcap_library_reads_it(written: Path) -> None:
    with written.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 61
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
        assert [a.name for a in reader.iter_attachments()] == [ATTACHMENT]
        assert [m.name for m in reader.iter_metadata()] == [NAME]
        times = [message.log_time for _, _, message in reader.iter_messages(topics=[f"/{WHEEL}"])]
    assert times == [10**9 + k * 10**7 for k in range(20)]


def test_what_goes_out_is_on_tape_as_well(tmp_path: Path) -> None:
    hub, heard = Hub(), []
    hub.connect().subscribe(WHEEL, heard.append)
    tape = Tape(tmp_path / "drive.mcap", b"{}", TYPES)
    tape.begin(1, 0, 0)
    Taped(hub.connect(), tape).publish(WHEEL, encode(empty(TYPES[WHEEL])), b"signature")
    tape.close()
    assert [arrival.attachment for arrival in heard] == [b"signature"]
    with AnyReader([tmp_path / "drive.mcap"]) as reader:
        assert [c.topic for c in reader.connections] == [f"/{WHEEL}"] and reader.message_count == 1


@pytest.mark.parametrize(("name", "why"), [("drive.bag", r"must end in \.mcap"), ("no/drive.mcap", "cannot write to")])
def test_where_none_can_be_written_is_said(tmp_path: Path, name: str, why: str) -> None:
    with pytest.raises(OutputError, match=why):
        Tape(tmp_path / name, b"{}", TYPES)


def test_nothing_is_overwritten(written: Path) -> None:
    before = written.read_bytes()
    with pytest.raises(OutputError, match="exists already"):
        Tape(written, b"{}", TYPES)
    assert written.read_bytes() == before
