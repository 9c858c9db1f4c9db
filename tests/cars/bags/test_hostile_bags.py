"""Bags of others that unpack to far more than they are: refused in one line, before the memory or the disk is taken."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from coopenv import CoopenvError, DataError
from coopenv.backends.mcap import container
from coopenv.cars import codec
from coopenv.cars.bags import files
from coopenv.cli import main
from tests.helpers import bags

pytest.importorskip("rosbags", reason="needs the extra 'log'")

TOPIC, KIND = "/blob", "std_msgs/msg/String"
LARGE = 40 * 2**20
"""Bytes of a message of zeros, more than any may have."""


def bomb(path: Path, form: str, size: int = LARGE, count: int = 1) -> Path:
    """Write a bag whose messages are zeros; `form` is the storage and what of it is compressed."""
    storage, _, mode = form.partition(" ")
    if storage == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        path = path.with_suffix(".bag")
        bag: Any = Writer1(path)
        bag.set_compression(Writer1.CompressionFormat[mode])
        store = codec.ros1()
    else:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        bag, store = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]), codec.ros2()
        if mode:
            bag.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with bag:
        connection = bag.add_connection(TOPIC, KIND, typestore=store)
        for number in range(count):
            bag.write(connection, 10**9 + number, bytes(size))
    return path


def read(path: Path) -> int:
    """Return how many messages a bag yields."""
    with files.BagFile(path) as bag:
        return sum(1 for _ in bag.messages([TOPIC]))


@pytest.mark.parametrize(
    "form", ["mcap STORAGE", "mcap MESSAGE", "mcap FILE", "sqlite3 MESSAGE", "sqlite3 FILE", "ros1 BZ2", "ros1 LZ4"]
)
def test_a_bag_that_unpacks_to_far_more_than_it_is(form: str, tmp_path: Path) -> None:
    assert read(bomb(tmp_path / "small", form, 2**20, 3)) == 3
    path = bomb(tmp_path / "drive", form)
    tracemalloc.start()
    with pytest.raises(DataError, match=r"drive\S*: .*would unpack to .*more than") as caught:
        read(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "\n" not in str(caught.value)
    assert peak < 2.5 * container.AT_ONCE


def test_a_value_of_a_database_that_is_too_large(tmp_path: Path) -> None:
    assert read(bomb(tmp_path / "small", "sqlite3", 2**20, 3)) == 3
    with pytest.raises(DataError, match=r"drive: .*too big"):
        read(bomb(tmp_path / "drive", "sqlite3"))


def test_chunks_that_unpack_to_much_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bomb(tmp_path / "drive", "mcap STORAGE", 2**20, 4)
    assert read(path) == 4
    monkeypatch.setattr(container, "AT_ONCE", 2 * 2**20)
    with pytest.raises(DataError, match="would unpack to"):
        read(path)


def test_listing_the_topics_is_within_limits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(bomb(tmp_path / "drive", "sqlite3 FILE"))]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert "would unpack to more than 50 times its size" in captured.err


def test_other_programs_use_rosbags_without_limits(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    assert read(bomb(tmp_path / "small", "mcap", 100)) == 1
    path = bomb(tmp_path / "drive", "mcap STORAGE")
    with AnyReader([path]) as reader:
        assert [len(data) for _, _, data in reader.messages()] == [LARGE]


def test_a_version_of_rosbags_that_cannot_be_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbags.rosbag2 import reader

    path = bags.write(tmp_path / "drive", bags.messages(bags.drive(0.5)), "mcap")
    monkeypatch.delattr(reader, "zstd")
    files._guard_rosbags.cache_clear()
    with pytest.raises(CoopenvError, match=r"^this version of rosbags would unpack without limits"):
        read(path)
