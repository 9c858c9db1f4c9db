"""The reader process: what it hands over, what ends it, and that it leaves nothing behind."""

from __future__ import annotations

import io
import os
import signal
import struct
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coopenv import CoopenvError, DataError
from coopenv.cars.bags import reader, streams
from coopenv.cars.bags.definitions import BagChannel
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.reader import ReaderError, in_reader
from coopenv.cars.messages import codec
from coopenv.cli.app import main
from coopenv.sources.mcap_container import Allowance, TooLargeError
from tests.helpers import bags

pytest.importorskip("rosbags", reason="needs the extra 'log'")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere bags are read in the program")

CHANNEL = BagChannel("/t", "std_msgs/msg/String", "cdr", "ros2msg", "string data\n")
TEXTS = st.text(max_size=20).filter(lambda text: text.isascii() or text.encode("utf-8", "ignore").decode() == text)
RECORDS = st.tuples(
    st.builds(BagChannel, TEXTS, TEXTS, TEXTS, TEXTS, TEXTS),
    st.integers(-(2**63), 2**63 - 1),
    st.one_of(st.none(), st.binary(max_size=50)),
)


def children() -> set[str]:
    """Return the processes that this one has begun."""
    return {pid for task in Path("/proc/self/task").glob("*/children") for pid in task.read_text().split()}


@pytest.fixture(autouse=True)
def no_child_is_left() -> Iterator[None]:
    before = children()
    yield
    assert not children() - before


@settings(max_examples=25, deadline=None)
@given(st.lists(RECORDS, max_size=5))
def test_records_come_back_unchanged(records: list[reader.Record]) -> None:
    assert [*in_reader(lambda: iter(records), 0)] == records


def test_the_child_ends_with_its_reader() -> None:
    def endless() -> Iterator[reader.Record]:
        while True:
            yield CHANNEL, 1, b"x" * 1000

    records = in_reader(endless, 0)
    assert next(records) == (CHANNEL, 1, b"x" * 1000)
    records.close()  # type: ignore[attr-defined]


def crash() -> Iterator[reader.Record]:
    yield CHANNEL, 1, b"first"
    os.kill(os.getpid(), signal.SIGSEGV)
    yield CHANNEL, 2, b"never"


def test_a_crash_is_an_error_after_what_was_read() -> None:
    found = []
    with pytest.raises(ReaderError, match="ended by SIGSEGV"):
        for record in in_reader(crash, 0):
            found.append(record)
    assert found == []  # nothing was flushed before it


def spend() -> Iterator[reader.Record]:
    while True:
        pass
    yield


def fill() -> Iterator[reader.Record]:
    kept = [bytearray(2**24)]
    while True:
        kept.append(bytearray(2**24))
    yield


def write() -> Iterator[reader.Record]:
    Path(os.environ["COOPENV_TEST_FILE"]).write_text("x", encoding="utf-8")
    yield


def test_time_memory_and_files_are_limited(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(reader, "SECONDS", 1)
    monkeypatch.setattr(reader, "MEMORY", 2**28)
    monkeypatch.setenv("COOPENV_TEST_FILE", str(tmp_path / "file"))
    with pytest.raises(ReaderError, match=r"ended by SIG(XCPU|KILL)"):
        [*in_reader(spend, 0)]
    with pytest.raises(Exception, match=r"^$") as raised:
        [*in_reader(fill, 0)]
    assert type(raised.value).__name__ == "MemoryError"
    with pytest.raises(Exception, match="File too large"):
        [*in_reader(write, 0)]
    assert not (tmp_path / "file").exists() or not (tmp_path / "file").stat().st_size


@pytest.mark.parametrize("error", [TooLargeError("too much"), ValueError("no bag"), KeyError("a")])
def test_errors_keep_name_and_text(error: Exception) -> None:
    def failing() -> Iterator[reader.Record]:
        raise error
        yield

    with pytest.raises(Exception, match=str(error)) as raised:
        [*in_reader(failing, 0)]
    assert type(raised.value).__name__ == type(error).__name__
    assert isinstance(raised.value, TooLargeError) == isinstance(error, TooLargeError)


def test_a_hole_of_a_library_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At the first look at the file, and at the second one, when the messages are read."""
    path = next(bags.write(tmp_path / "bag", bags.sent()[:200], "mcap").glob("*.mcap"))
    read = streams.FORMS[".mcap"]

    def hole(after: int) -> Any:
        def entries(*given: Any) -> Iterator[Any]:
            for n, entry in enumerate(read(*given)):
                if n == after:
                    os.kill(os.getpid(), signal.SIGABRT)
                yield entry

        return entries

    monkeypatch.setitem(streams.FORMS, ".mcap", hole(0))
    assert main(["import", str(path)]) == 2
    error = capsys.readouterr().err
    assert "the process that reads the file ended by SIGABRT" in error and error.count("\n") == 1
    monkeypatch.setitem(streams.FORMS, ".mcap", read)
    with BagFile(path) as bag:
        monkeypatch.setitem(streams.FORMS, ".mcap", hole(100))
        with pytest.raises(DataError, match=r"bag\.mcap: the process that reads the file ended by SIGABRT"):
            [*bag.messages(bag.topics)]


def test_a_want_of_memory_at_the_second_look_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = next(bags.write(tmp_path / "bag", bags.sent()[:200], "mcap").glob("*.mcap"))
    with BagFile(path) as bag:
        read = streams.FORMS[".mcap"]

        def hungry(*given: Any) -> Iterator[Any]:
            for n, entry in enumerate(read(*given)):
                if n == 100:
                    raise MemoryError
                yield entry

        monkeypatch.setitem(streams.FORMS, ".mcap", hungry)
        with pytest.raises(DataError, match=r"bag\.mcap: MemoryError$"):
            [*bag.messages(bag.topics)]


def test_a_frame_with_other_fields_is_refused_alone(tmp_path: Path) -> None:
    kind, text = "sensor_msgs/msg/CompressedImage", "std_msgs/Header header\nuint8 data\n"
    _, opened, _ = bags.writer(tmp_path / "bag", "mcap")
    with opened as bag:
        connection = bag.add_connection("/frames", kind, msgdef=text, rihs01="RIHS01_0")
        bag.write(connection, 1, b"\0\1\0\0" + bytes(13))
    with BagFile(tmp_path / "bag") as found:
        [(_, _, decoded)] = found.messages(["/frames"])
        with pytest.raises(CoopenvError):
            decoded()


def test_compressed_frames_come_as_raw_ones(tmp_path: Path) -> None:
    """In shades of grey or with colours; a damaged one is refused alone."""
    cv2 = pytest.importorskip("cv2")
    from coopenv.cars.messages.vision import frame_of

    shades = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    good = cv2.imencode(".png", shades)[1].ravel()
    kind, frames = "sensor_msgs/msg/CompressedImage", [good, good[: len(good) // 3], good]
    _, opened, store = bags.writer(tmp_path / "bag", "mcap")
    with opened as bag:
        connection = bag.add_connection("/frames", kind, typestore=store)
        for k, data in enumerate(frames, 1):
            message = codec.make(kind, header=codec.header(k, "eye"), format="png", data=data)
            bag.write(connection, k, codec.encode(message))
    for colours, wanted in ((False, "GRAY"), (True, "BGR")):
        with BagFile(tmp_path / "bag", colours) as opened_bag, warnings.catch_warnings():
            warnings.simplefilter("error")
            rows = [*opened_bag.messages(["/frames"])]
            assert opened_bag.topics == {"/frames": kind} and len(rows) == 3
            with pytest.raises(Exception, match="no JPEG or PNG image that OpenCV reads"):
                rows[1][2]()
            for _, received, decoded in (rows[0], rows[2]):
                found = decoded()
                assert found.__msgtype__ == "sensor_msgs/msg/Image" and found.header.frame_id == "eye"
                assert codec.stamp_of(found) == received
                mode = cv2.IMREAD_COLOR if colours else cv2.IMREAD_GRAYSCALE
                np.testing.assert_array_equal(frame_of(found, wanted), cv2.imdecode(good, mode))  # type: ignore[arg-type]


def test_a_record_that_states_more_than_its_file_takes_no_memory() -> None:
    """A length of 4 GB is that of a damaged file, which is read up to there."""
    size = struct.pack("<I", 2**32 - 1)

    class Few(io.BytesIO):
        def read(self, amount: int | None = -1) -> bytes:
            assert amount is not None and amount <= 64
            return super().read(amount)

    with pytest.raises(EOFError):
        [*streams._ros1_records(Few(bytes(4) + size), Allowance(8), 8)]
