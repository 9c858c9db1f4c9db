"""Channels that the map of a bag does not name, whatever their encoding, type, definition and contents."""

from __future__ import annotations

import sqlite3
import struct
import warnings
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import pytest

from coopenv import CoopenvError, DataError
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.definitions import BagChannel, decode
from coopenv.cars.bags.files import BagFile
from coopenv.cli.app import main
from tests.helpers import bags

pytest.importorskip("rosbags", reason="needs the extra 'log'")

SEPARATOR = "=" * 80 + "\n"
EVENT = "bool data\n---\nbool success\nstring message\n"
FOREIGN: dict[str, tuple[str, str, str, bytes, bytes]] = {
    "a note in JSON": ("json", "Note", "jsonschema", b"{}", b'{"lap": 1}'),
    "protobuf": ("protobuf", "foxglove.Log", "protobuf", b"\xff\xfe", b"\x08\x01"),
    "no schema": ("cdr", "", "", b"", b"\x00\x01\x00\x00"),
    "a service event": ("cdr", "std_srvs/srv/SetBool_Event", "ros2msg", EVENT.encode(), bytes(64)),
    "a definition that does not parse": ("cdr", "lab_msgs/msg/Report", "ros2msg", b"float32 <x>\n", bytes(8)),
    "an undefined part": ("cdr", "lab_msgs/msg/Report", "ros2msg", b"lab_msgs/Missing what\n", bytes(8)),
    "a definition in Latin-1": ("cdr", "lab_msgs/msg/Report", "ros2msg", b"float32 x # \xb0C\n", bytes(8)),
    "an empty definition": ("cdr", "lab_msgs/msg/Report", "", b"", bytes(8)),
    "OMG IDL": ("cdr", "sensor_msgs::msg::dds_::Imu_", "omgidl", b"module {", bytes(8)),
    "a packed message that is damaged": (
        "cdr",
        "std_msgs/msg/String",
        "ros2msg",
        b"string data\n",
        b"\x28\xb5\x2f\xfd!",
    ),
    "bytes that are no message": ("cdr", "sensor_msgs/msg/Temperature", "ros2msg", b"std_msgs/Header h\n", b"\xff"),
    "ROS 1": ("ros1", "std_msgs/String", "ros1msg", b"string data\n", struct.pack("<I", 2**31) + b"x"),
    "another serialisation": ("cbor", "std_msgs/msg/String", "ros2msg", b"string data\n", b"\xa0"),
}
"""Encoding of the message; name, encoding and text of the schema; bytes."""
LEFT_OUT = {"a note in JSON": "json", "protobuf": "protobuf", "no schema": "no type", "another serialisation": "cbor"}


@cache
def sent() -> tuple[bags.Message, ...]:
    """The messages of a second of a drive."""
    return tuple(m for m in bags.sent() if m.stamp < 10**9)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the drive in two forms, and the map of its topics."""
    folder = tmp_path_factory.mktemp("plain")
    (folder / "topics.toml").write_text(bags.MAP)
    for form in ("mcap", "sqlite3"):
        bags.write(folder / form, sent(), form)
    return folder


def copied(source: Path, out: Path, extra: Iterable[tuple[str, str, str, bytes, bytes]]) -> Path:
    """Copy an MCAP file, with messages of further channels before its first, middle and last one."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as stream, out.open("wb") as target:
        rows = list(make_reader(stream).iter_messages(log_time_order=False))
        writer = Writer(target)
        writer.start(profile="ros2", library="test")
        ids: dict[str, int] = {}
        for number, (encoding, name, language, text, _) in enumerate(extra):
            schema = writer.register_schema(name, language, text) if name else 0
            ids[f"/foreign{number}"] = writer.register_channel(f"/foreign{number}", encoding, schema)
        for place, (schema, channel, message) in enumerate(rows):
            if place in (0, len(rows) // 2, len(rows) - 1):
                for number, (*_, data) in enumerate(extra):
                    writer.add_message(ids[f"/foreign{number}"], message.log_time, data, message.log_time)
            if channel.topic not in ids:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(ids[channel.topic], message.log_time, message.data, message.log_time)
        writer.finish()
    return out


def read(path: Path, topics: Path) -> tuple[str, list[str]]:
    """Return the samples of a bag, as text, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bag = Bag([path], topics)
    return repr(bag.log.samples), [str(w.message).partition(": ")[2] for w in caught]


@pytest.fixture(scope="module")
def unchanged(plain: Path) -> tuple[str, list[str]]:
    """The samples of the MCAP bag, as text, and its warnings."""
    return read(plain / "mcap" / "mcap.mcap", plain / "topics.toml")


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_channel_of_an_mcap_bag_has_no_effect(
    name: str, plain: Path, unchanged: tuple[str, list[str]], tmp_path: Path
) -> None:
    samples, quiet = unchanged
    path = copied(plain / "mcap" / "mcap.mcap", tmp_path / "more.mcap", [FOREIGN[name]])
    found, warned = read(path, plain / "topics.toml")
    more = [line for line in warned if line not in quiet]
    assert found == samples
    if name not in LEFT_OUT:
        assert not more
    else:
        [line] = more
        assert f"/foreign0 ({LEFT_OUT[name]})" in line


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


ODD = {
    "an attachment with a name in Latin-1": record(9, bytes(16) + text(b"\xb0.txt") + text(b"x") + bytes(12)),
    "a damaged attachment": record(9, b"\xff" * 7),
    "metadata in Latin-1": record(12, text(b"\xb0") + struct.pack("<I", 0)),
    "a topic in Latin-1": record(4, struct.pack("<HH", 900, 0) + text(b"/\xb0") + text(b"cdr") + struct.pack("<I", 0)),
    "a schema in Latin-1": record(3, struct.pack("<H", 900) + text(b"x/\xb0") + text(b"ros2msg") + text(b"")),
    "a channel that breaks off": record(4, b"\x01"),
    "a message that breaks off": record(5, b"\x01\x00"),
    "a message of no channel": record(5, struct.pack("<HIQQ", 999, 0, 1, 1)),
    "a private record": record(0x90, b"\xff" * 9),
}
"""Records that concern no topic of the map."""


@pytest.mark.parametrize("name", ODD)
def test_an_odd_record_of_an_mcap_bag_has_no_effect(
    name: str, plain: Path, unchanged: tuple[str, list[str]], tmp_path: Path
) -> None:
    data, path = (plain / "mcap" / "mcap.mcap").read_bytes(), tmp_path / "odd.mcap"
    header = 8 + 9 + struct.unpack_from("<Q", data, 9)[0]  # behind the magic and the first record
    path.write_bytes(data[:header] + ODD[name] + data[header:])
    assert read(path, plain / "topics.toml") == unchanged


def test_records_of_ros_1_that_make_no_sense_have_no_effect(plain: Path, tmp_path: Path) -> None:
    whole, path = bags.write(tmp_path / "drive", sent(), "ros1"), tmp_path / "odd.bag"
    data = whole.read_bytes()

    def field(name: bytes, value: bytes) -> bytes:
        return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value

    odd = b""
    for fields in (
        field(b"op", b"\x07"),  # a connection without a number and a topic
        field(b"op", b"\x07") + field(b"conn", b"\x09\x00\x00\x00"),  # without a topic
        field(b"op", b"\x02") + field(b"conn", b"\x00\x00\x00\x00"),  # a message without a time
        field(b"x", b"y"),
    ):
        odd += struct.pack("<I", len(fields)) + fields + struct.pack("<I", 0)
    begin = data.index(b"\n") + 1
    size = struct.unpack_from("<I", data, begin)[0]
    first = begin + 8 + size + struct.unpack_from("<I", data, begin + 4 + size)[0]
    path.write_bytes(data[:first] + odd + data[first:])
    assert read(path, plain / "topics.toml") == read(whole, plain / "topics.toml")


def test_foreign_topics_of_an_sqlite_bag_have_no_effect(plain: Path, tmp_path: Path) -> None:
    source, topics = plain / "sqlite3" / "sqlite3.db3", plain / "topics.toml"
    path = tmp_path / "more.db3"
    path.write_bytes(source.read_bytes())
    with sqlite3.connect(path) as database:
        columns = [row[1] for row in database.execute("pragma table_info(topics)")]
        for number, (encoding, name, language, text, data) in enumerate(FOREIGN.values(), 100):
            row = {"id": number, "name": f"/foreign{number}", "type": name, "serialization_format": encoding}
            values = [row.get(column, "") for column in columns]
            database.execute(f"insert into topics values ({','.join('?' * len(values))})", values)
            database.execute(
                "insert into message_definitions (topic_type, encoding, encoded_message_definition,"
                " type_description_hash) values (?, ?, cast(? as text), '')",
                (name, language, text),
            )
            database.execute("insert into messages (topic_id, timestamp, data) values (?, ?, ?)", (number, 1, data))
        row = {"id": 900, "name": "/o", "type": "std_msgs/msg/String"}
        values = [row.get(column, "") for column in columns]
        database.execute(f"insert into topics values ({','.join('?' * len(values))})", values)
        database.execute("update topics set serialization_format = cast(x'b0' as text) where id = 900")
        database.execute("insert into messages (topic_id, timestamp, data) values (9999, 1, x'00')")
        database.execute("insert into messages (topic_id, timestamp, data) values (900, 1, zeroblob(40000000))")
    database.close()
    samples, quiet = read(source, topics)
    found, warned = read(path, topics)
    [line] = [line for line in warned if line not in quiet]
    assert found == samples and "(cbor)" in line and "(json)" in line and "(ros1)" not in line


def test_a_drive_of_ros_1_in_mcap_is_read(plain: Path, tmp_path: Path) -> None:
    """As `mcap convert` writes it: names of types are short, and messages have the encoding of ROS 1."""
    from mcap.writer import Writer
    from rosbags.rosbag1 import Reader

    whole, path = bags.write(tmp_path / "drive", sent(), "ros1"), tmp_path / "converted.mcap"
    with Reader(whole) as bag, path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1", library="test")
        ids: dict[str, int] = {}
        for connection, received, data in bag.messages():
            if (topic := connection.topic) not in ids:
                text = connection.msgdef.data.encode()
                schema = writer.register_schema(connection.msgtype.replace("/msg/", "/"), "ros1msg", text)
                ids[topic] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(ids[topic], received, data, received)
        writer.finish()
    assert read(path, plain / "topics.toml") == read(whole, plain / "topics.toml")


def test_a_bag_without_a_topic_of_ros_names_the_encodings(tmp_path: Path, plain: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "notes.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="test")
        channel = writer.register_channel("/notes", "json", writer.register_schema("Note", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(DataError, match=r"notes\.mcap: no topics of ROS; .*/notes \(json\)$"):
        BagFile(path)


@pytest.mark.parametrize("content", [b"", b"hello"])
def test_no_repair_is_proposed_for_a_file_that_is_no_bag(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for suffix in (".bag", ".db3", ".mcap"):
        path = tmp_path / f"other{suffix}"
        path.write_bytes(content)
        assert main(["import", str(path)]) == 2
        error = capsys.readouterr().err
        assert "cannot be read as a ROS bag" in error and "mends" not in error


def many(kind: str, count: int) -> Callable[[int], str]:
    """Return the definition of a level of types, each of which has some of the next level."""
    return lambda level: (
        f"{SEPARATOR}MSG: x/{kind}{level}\n" + "".join(f"x/{kind}{level + 1} a{k}\n" for k in range(count))
    )


HOSTILE = {
    "values without bytes": ("x/Empty[] z\n" + SEPARATOR + "MSG: x/Empty\n", "values without bytes"),
    "an array of values without bytes": ("x/Empty[100000000] z\n" + SEPARATOR + "MSG: x/Empty\n", "over 1000 values"),
    "an array of texts": ("string[1000000] z\n", "over 1000 values"),
    "a type in itself": ("x/T a\n" + SEPARATOR + "MSG: x/T\nx/T b\n", "contains itself"),
    "types in types": (
        "x/A0 a\n" + "".join(map(many("A", 10), range(12))) + SEPARATOR + "MSG: x/A12\nuint8 x\n",
        "over 1000 values",
    ),
    "a long text": ("float64 x\n" * 20_000, "characters"),
    "a value per byte": ("x/T[] a\n" + SEPARATOR + "MSG: x/T\nuint8 b\n", "may hold over 300000 values"),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_definition_that_makes_messages_grow_is_refused(name: str, encoding: str) -> None:
    """Four bytes claim a count, and a megabyte of zeros follows."""
    text, why = HOSTILE[name]
    data = b"\0\1\0\0" * (encoding == "cdr") + struct.pack("<I", 2**31 - 1) + bytes(10**6)
    with pytest.raises(CoopenvError, match=why):
        decode(BagChannel("/t", "x/msg/M", encoding, "ros2msg", text), data)


def test_a_known_type_with_a_hostile_definition_is_read_by_ours() -> None:
    from coopenv.cars.messages import codec

    message = codec.make("geometry_msgs/msg/PointStamped", header=codec.header(5), point=(1.0, 2.0, 3.0))
    text = "std_msgs/Empty[] z\n" + SEPARATOR + "MSG: std_msgs/Empty\n"
    found = decode(BagChannel("/t", message.__msgtype__, "cdr", "ros2msg", text), codec.encode(message))
    assert (found.point.x, found.point.y, found.point.z) == (1.0, 2.0, 3.0)


def test_poses_in_transforms_are_named_where_there_is_no_motion_capture(plain: Path, tmp_path: Path) -> None:
    from coopenv.cars.messages import codec

    kind = "tf2_msgs/msg/TFMessage"
    parts = [("mocap", "svea3"), ("svea3", "camera"), ("mocap", "table")]
    transforms = [{"header": codec.header(5, parent), "child_frame_id": child} for parent, child in parts]
    text, _ = codec.ros2().generate_msgdef(kind, ros_version=2)
    tree = ("cdr", kind, "ros2msg", text.encode(), codec.encode(codec.make(kind, transforms=transforms)))
    other = ("cdr", kind, "ros2msg", b"uint8 x\n", b"\0\1\0\0\5")  # a type of that name with other fields
    captured = copied(plain / "mcap" / "mcap.mcap", tmp_path / "captured.mcap", [tree])
    assert not [line for line in read(captured, plain / "topics.toml")[1] if "transforms" in line]
    alone = bags.write(tmp_path / "alone", [m for m in sent() if "qualisys" not in m.topic], "mcap")
    path = copied(next(alone.glob("*.mcap")), tmp_path / "tree.mcap", [tree, other])
    [line] = [line for line in read(path, plain / "topics.toml")[1] if "transforms" in line]
    assert "/foreign0: mocap -> svea3;" in line and "table" not in line and "camera" not in line


def test_many_definitions_of_a_topic_matter_where_it_is_read(tmp_path: Path, plain: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "many.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        for k in range(40):
            schema = writer.register_schema("x/msg/T", "ros2msg", f"uint8 a{k}\n".encode())
            channel = writer.register_channel("/t", "cdr", schema)
            writer.add_message(channel, 1, b"\0\1\0\0\1", 1)
        writer.finish()
    with BagFile(path) as bag:
        assert bag.counts["/t"] == 40 and len(bag.times()["/t"][0]) == 40
        with pytest.raises(DataError, match=r"/t has over 32 types and definitions"):
            next(bag.messages(["/t"]))
