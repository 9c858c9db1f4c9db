"""Files whose check sums are right and whose contents are not: each is refused in one line that says where."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopenv import DataError
from coopenv.sources import mcap_container as container
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.worlds import Replay
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.mcap_edits import Sent, edit
from tests.helpers.recordings import simulated

pytest.importorskip("mcap", reason="needs the extra 'log'")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "drive.mcap"
    write_recording(simulated("busy_intersection", horizon=0.1, v2x__delay=1), path)
    return path


def refused(path: Path, why: str) -> str:
    with pytest.raises(DataError, match=why) as caught:
        read_recording(path)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and len(message) < 700
    return message


def put(key: str, value: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return a change of one dotted key."""

    def change(facts: dict[str, Any]) -> dict[str, Any]:
        *path, last = key.split(".")
        node: Any = facts
        for part in path:
            node = node[int(part) if isinstance(node, list) else part]
        node[int(last) if isinstance(node, list) else last] = value
        return facts

    return change


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        ("order", [5, 6, 7, 8, 9], r"order: \(5, 6, 7, 8, 9\) is no order of 0 \.\. 4"),
        ("order", [1, 0, 2, 3, 4], "vehicles in another order than recorded"),
        ("dt", 0.0, "dt: 0.0 is not in 1e-05 .. 1000"),
        ("dt", 0.5, r"scenario: ticks of 0.0166667 s, recorded 0.5 s"),
        ("staleness", -1.0, "staleness: -1.0 is not positive"),
        ("ticks", 10**12, "tick|would need .* GiB of memory"),
        ("ticks", 6, "tick 6: the recording ends at tick 5"),
        ("ticks", 8, "tick 7 is missing"),
        ("setups", [], "setups: List should have at least 1 item"),
        ("setups.1.targets", [0, 99], "setups.1.targets: not different targets of 0 .. 7 without 4"),
        ("setups.1.targets", [0], "vehicle_2 has other neighbours than in its setup"),
        ("setups.1.vehicle", 7, "setups.1.vehicle: 7 instead of 1"),
        ("setups.1.name", "vehicle_1", "topic '/vehicle_1|name"),
        ("setups.0.landmarks", 99, "cannot reshape|not as many names"),
        ("setups.0.target_names", ["a"] * 8, "two targets have the same name"),
        ("setups.0.target_names.0", "a b", "is no name"),
        (
            "setups.1.planar",
            True,
            "recorded with an earlier version: robots on a plane .*; convert the data set again$",
        ),
        ("setups.2.gains.k", 0.5, "setups.2.gains.k: 0.5 is not in 0.5"),
        ("setups.2.gains.q", [1.0], "setups.2.gains.q: not 8 positive numbers"),
        ("setups.2.noise.odometry_period", 0.0, "odometry_period: 0.0 is not in"),
        ("setups.2.noise.image_axis", [1.0, 1.0, 0.0], "image_axis: not a unit vector"),
        ("start_rotation.0", np.diag([1.0, 1.0, -1.0]).tolist(), "start_rotation of vehicle_1: not a rotation"),
        ("start_rotation", [], r"start_rotation: expected an array of shape \(5, 3, 3\) .* got float64"),
        ("start_covariance.3", np.zeros((6, 6)).tolist(), "start_covariance of vehicle_4: not a symmetric"),
        ("start_position.3.1", 1e300, "start_position.3.1: Input should be less than or equal to"),
        ("scenario.rates.camera", 30.0, "scenario: ticks of 0.0333333 s"),
        ("scenario.rates.observer", 20.0, "scenario: corrections due at other ticks"),
        ("scenario.v2x.period", 3, "scenario: another radio"),
    ],
)
def test_headers(key: str, value: Any, why: str, written: Path, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    edit(written, path, header=put(key, value))
    refused(path, why)


@pytest.mark.parametrize("number", ["NaN", "1e999"])
@pytest.mark.parametrize("key", ["dt", "setups.0.gains.k", "start_position.0.0"])
def test_non_finite_numbers(number: str, key: str, written: Path, tmp_path: Path) -> None:
    import json

    def change(facts: dict[str, Any]) -> bytes:
        return json.dumps(put(key, "HERE")(facts)).replace('"HERE"', number).encode()

    edit(written, tmp_path / "hostile.mcap", header=change)
    refused(tmp_path / "hostile.mcap", r"recording.json: .*(finite|less than|greater than|Invalid JSON|over a hundred)")


def test_a_scenario_of_others(written: Path, tmp_path: Path) -> None:
    """More vehicles than recorded would make kernels read behind the arrays."""
    path, other = tmp_path / "hostile.mcap", simulated(FOUR_WAY, horizon=0.1).scenario
    assert other is not None
    edit(written, path, header=put("scenario", other.model_dump(mode="json")))
    refused(path, "scenario: other landmarks or vehicles than the setups")

    def more(facts: dict[str, Any]) -> dict[str, Any]:
        vehicle = facts["scenario"]["vehicles"][-1]
        for i in range(20):
            pose = {**vehicle["initial_pose"], "position": [100.0 + 10 * i, 0.0, 0.0]}
            facts["scenario"]["vehicles"].append({**vehicle, "initial_pose": pose})
        return facts

    edit(written, path, header=more)
    refused(path, "scenario: other landmarks or vehicles than the setups")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (b"", "recording.json"),
        (b"[]", "recording.json: .*should be an object"),
        (b"[" * 100_000, "recording.json"),
        (b"\xff\xfe", "recording.json"),
        (b'{"ticks": 1' + b"0" * 6000 + b"}", "recording.json"),
    ],
)
def test_invalid_headers(text: bytes, why: str, written: Path, tmp_path: Path) -> None:
    edit(written, tmp_path / "hostile.mcap", header=lambda facts: text)
    refused(tmp_path / "hostile.mcap", why)


# Ticks


@pytest.mark.parametrize("topic", ["increment", "bearings", "v2x", "truth_exact"])
def test_a_tick_that_comes_twice_in_place_of_another(topic: str, written: Path, tmp_path: Path) -> None:
    name, path = f"/vehicle_2/{topic}", tmp_path / "hostile.mcap"
    edit(written, path, messages=lambda m: [m._replace(tick=5) if (m.topic, m.tick) == (name, 6) else m])
    refused(path, f"{name}, tick 5: is there twice")
    edit(written, path, messages=lambda m: [] if (m.topic, m.tick) == (name, 4) else [m])
    refused(path, f"topic '{name}': tick 4 is missing")
    edit(written, path, messages=lambda m: [m._replace(tick=7) if (m.topic, m.tick) == (name, 6) else m])
    refused(path, f"{name}, tick 7: the recording ends at tick 6")
    edit(written, path, messages=lambda m: [] if m.topic == name else [m])
    refused(path, f"topic '{name}' is missing")


def test_landmarks_that_come_twice_or_late(written: Path, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    edit(written, path, messages=lambda m: [m, m] if m.topic == "/landmarks" else [m])
    refused(path, "/landmarks, tick 0: is there twice")
    edit(written, path, messages=lambda m: [m._replace(tick=3)] if m.topic == "/landmarks" else [m])
    refused(path, "topic '/landmarks' is missing")


def ending(number: np.generic) -> Callable[[bytes], bytes]:
    """Return a change of a message's last number."""
    return lambda data: data[:-8] + number.tobytes()


@pytest.mark.parametrize(
    ("topic", "change", "why"),
    [
        ("/vehicle_1/increment", lambda d: d[:50], r"/vehicle_1/increment, tick 0: "),
        ("/vehicle_1/increment", lambda d: b"", r"/vehicle_1/increment, tick 0: "),
        ("/vehicle_3/bearings", lambda d: d[:-9], r"/vehicle_3/bearings, tick 0: "),
        ("/vehicle_3/bearings", lambda d: d[:16] + b"\xff\xff\xff\xff" + d[20:], r"/vehicle_3/bearings, tick 0: "),
        ("/vehicle_1/v2x", lambda d: d[:-8], r"/vehicle_1/v2x, tick 0: "),
        ("/vehicle_1/increment", ending(np.float64(np.nan)), "angular_velocity of vehicle_1, tick 0"),
        ("/vehicle_1/increment", ending(np.float64(1e300)), "angular_velocity of vehicle_1, tick 0"),
        ("/vehicle_1/truth_exact", ending(np.float64(np.inf)), "truth.position of vehicle_1, tick 0"),
        ("/vehicle_1/v2x", ending(np.int64(9)), "inbox_tick of vehicle_1, tick 0: not -1"),
        ("/vehicle_1/v2x", ending(np.int64(-7)), "inbox_tick of vehicle_1, tick 0: not -1"),
        ("/vehicle_2/bearings", lambda d: d[:-24] + np.ones(3).tobytes(), "bearings of vehicle_2, tick 0: not unit"),
    ],
)
def test_messages(topic: str, change: Callable[[bytes], bytes], why: str, written: Path, tmp_path: Path) -> None:
    def first(m: Sent) -> Iterable[Sent]:
        return [m._replace(data=change(m.data)) if m.topic == topic and m.tick == 0 else m]

    edit(written, tmp_path / "hostile.mcap", messages=first)
    refused(tmp_path / "hostile.mcap", why)


def test_invalid_rotations(written: Path, tmp_path: Path) -> None:
    def scaled(m: Sent) -> Iterable[Sent]:
        if (m.topic, m.tick) != ("/vehicle_4/truth_exact", 3):
            return [m]
        numbers = np.frombuffer(m.data[-96:]).copy()
        numbers[:9] *= 2.0
        return [m._replace(data=m.data[:-96] + numbers.tobytes())]

    edit(written, tmp_path / "hostile.mcap", messages=scaled)
    refused(tmp_path / "hostile.mcap", "truth.rotation of vehicle_4, tick 3: not a rotation or unknown")


def test_swapped_and_renamed_channels(written: Path, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    edit(written, path, encoding="json")
    refused(path, r"holds coopenv_msgs/msg/\w+ \(ros2msg, json\), expected")
    edit(written, path, schema_encoding="protobuf")
    refused(path, r"\(protobuf, cdr\), expected")
    edit(written, path, schema_name=lambda name: "std_msgs/msg/String")
    refused(path, r"holds std_msgs/msg/String \(ros2msg, cdr\), expected")
    other = {"/vehicle_1/v2x": "/vehicle_1/increment", "/vehicle_1/increment": "/vehicle_1/v2x"}
    edit(written, path, messages=lambda m: [m._replace(topic=other.get(m.topic, m.topic))])
    refused(path, r"holds .*, expected")


# Sizes


def bomb(written: Path, target: Path, size: int, claimed: int | None = None) -> None:
    """Put a chunk of nothing but zeros behind the header of a recording."""
    import zstandard
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    compressor = zstandard.ZstdCompressor().compressobj(size=size)
    data = b"".join(compressor.compress(bytes(2**20)) for _ in range(size // 2**20)) + compressor.flush()
    builder = RecordBuilder()
    Chunk("zstd", data, 0, 0, 0, size if claimed is None else claimed).write(builder)
    original = written.read_bytes()
    target.write_bytes(original[:8] + builder.end() + original[8:])


@pytest.mark.parametrize("claimed", [None, 1000])
def test_a_chunk_that_unpacks_to_more_than_fits_is_not_unpacked(
    claimed: int | None, written: Path, tmp_path: Path
) -> None:
    path = tmp_path / "hostile.mcap"
    bomb(written, path, 1536 * 2**20, claimed)
    assert path.stat().st_size < 300_000
    tracemalloc.start()
    refused(path, r"damaged MCAP file \(a chunk of \d+ bytes would unpack to 1610612736, more than 33554432\)")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


def test_many_chunks_that_unpack_to_much(written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, more = tmp_path / "hostile.mcap", tmp_path / "more.mcap"
    bomb(written, path, 9 * 2**20)  # a million records of 9 bytes
    monkeypatch.setattr(container, "AT_ONCE", 16 * 2**20)
    bomb(path, more, 9 * 2**20)
    refused(more, r"would unpack to 9437184, more than [89]\d{6}\b")  # the limit is for both


def test_a_chunk_of_another_size_than_stated(written: Path, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    bomb(written, path, 2**20, claimed=2**20 + 1)
    refused(path, "a chunk unpacks to 1048576 bytes, not to the stated 1048577")


def test_a_record_that_goes_on_beyond_the_end(written: Path, tmp_path: Path) -> None:
    path, original = tmp_path / "hostile.mcap", written.read_bytes()
    path.write_bytes(original[:9] + (2**62).to_bytes(8, "little") + original[17:])
    refused(path, rf"damaged MCAP file \(HEADER record has length {2**62} that exceeds limit")


# Recordings made by programs


def test_replays_check_what_they_are_given(written: Path) -> None:
    good = read_recording(written)
    for change, why in (
        ({"order": (5, 6, 7, 8, 9)}, "order"),
        ({"period": 0}, "period"),
        ({"rotation": good.rotation * 1.01}, "rotation of vehicle_1, tick 0: not a rotation"),
        ({"landmarks": good.landmarks[:, :2]}, "landmarks: expected"),
        ({"visible": good.visible.astype(float)}, "visible: expected .* got float64"),
        ({"inbox_tick": np.where(good.inbox_tick == 1, 0, good.inbox_tick)[::-1].copy()}, "inbox_tick of"),
        ({"setups": ()}, "setups: there are none"),
    ):
        with pytest.raises(DataError, match=f"^drive: {why}"):
            Replay(replace(good, **change), "drive")


def test_unreadable_recordings_are_not_written(tmp_path: Path) -> None:
    made = simulated("crossing_path", horizon=0.1)
    with pytest.raises(DataError, match=r"^recording: dt: nan is not in"):
        write_recording(replace(made, dt=float("nan")), tmp_path / "drive.mcap")
    assert not list(tmp_path.iterdir())
