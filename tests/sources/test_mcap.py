"""A recording comes back from its file bit for bit, viewers can read the file, and broken files are distinguished."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from coopenv import DataError
from coopenv.cli.app import main
from coopenv.mrclam.recording import load_dataset, recording_of
from coopenv.observers import Recording, run
from coopenv.observers.sensed import Truth
from coopenv.scenario import parse_scenario
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.mcap_container import Container
from tests.helpers import mrclam_files
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.recordings import differences, simulated

pytest.importorskip("mcap", reason="needs the extra 'log'")


def through(recording: Recording, folder: Path) -> Recording:
    path = folder / "drive.mcap"
    write_recording(recording, path)
    return read_recording(path)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("busy_intersection", {}),
        ("busy_intersection", {"v2x__delay": 3, "v2x__loss": 0.4, "v2x__staleness": 0.2, "observer__k": 2.0}),
        (FOUR_WAY, {"rates__observer": 25.0}),
        ("crossing_path", {}),
    ],
)
def test_simulated_recordings_come_back_bit_for_bit(name: str, overrides: dict[str, Any], tmp_path: Path) -> None:
    made = simulated(name, **overrides)
    assert differences(made, through(made, tmp_path)) == []


@pytest.mark.parametrize("variant", ["landmarks", "landmarks+robots", "blind"])
def test_robots_come_back_bit_for_bit(variant: Any, tmp_path: Path) -> None:
    mrclam_files.write(tmp_path, seconds=6.0)
    made = recording_of(load_dataset("mrclam_6", tmp_path), variant)
    assert differences(made, through(made, tmp_path)) == []


floats = st.floats(-1e9, 1e9, width=64)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_numbers_come_back_bit_for_bit(data: st.DataObject, tmp_path: Path) -> None:
    """Denormals and minus zero, truth that is not known, landmarks that move, bearings nobody counts."""
    made = simulated("crossing_path", horizon=1 / 60)

    def drawn(shape: tuple[int, ...]) -> np.ndarray:
        size = int(np.prod(shape))
        return np.array(data.draw(st.lists(floats, min_size=size, max_size=size))).reshape(shape)

    def flags(shape: tuple[int, ...]) -> np.ndarray:
        size = int(np.prod(shape))
        return np.array(data.draw(st.lists(st.booleans(), min_size=size, max_size=size)), bool).reshape(shape)

    unknown, visible = flags(made.truth.position.shape[:2]), flags(made.visible.shape)
    bearings = Rotation.random(visible.size, random_state=0).as_matrix()[:, 0].reshape(*visible.shape, 3)
    odd = replace(
        made,
        translation=drawn(made.translation.shape),
        velocity=drawn(made.velocity.shape),
        bearings=np.where((visible | flags(visible.shape))[..., None], bearings, np.nan),
        visible=visible,
        landmarks=drawn(made.landmarks.shape),
        due=flags(made.due.shape),
        truth=Truth(
            np.where(unknown[..., None, None], np.nan, made.truth.rotation),
            np.where(flags(made.truth.position.shape[:2])[..., None], np.nan, made.truth.position),
        ),
        scenario=None,
    )
    assert differences(odd, through(odd, tmp_path)) == []


def test_viewers_find_standard_messages_at_their_times(tmp_path: Path) -> None:
    """Read by the library alone, with the definitions that the file carries."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    made, path = simulated(), tmp_path / "drive.mcap"
    write_recording(made, path)
    store = get_typestore(Stores.EMPTY)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        for schema in summary.schemas.values():
            assert schema.encoding == "ros2msg"
            found = get_types_from_msg(schema.data.decode(), schema.name)
            store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
        topics = {channel.topic for channel in summary.channels.values()}
        names = ("odometry", "increment", "bearings", "v2x", "truth", "truth_exact")
        assert topics == {f"/vehicle_{i}/{name}" for i in range(1, 6) for name in names} | {"/landmarks"}
        shown = list(reader.iter_messages("/vehicle_3/truth"))
        assert len(shown) == made.ticks
        for schema, _, message in shown[::20]:
            pose = store.deserialize_cdr(message.data, schema.name)
            k = round(message.log_time * 60e-9)
            stamp = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
            assert_allclose([message.log_time * 1e-9, stamp], k / 60.0, atol=1e-9)
            q, p = pose.pose.orientation, pose.pose.position
            assert [p.x, p.y, p.z] == made.truth.position[k, 2].tolist()
            R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
            assert_allclose(R, made.truth.rotation[k, 2], atol=1e-12)
        (_, _, points) = next(reader.iter_messages("/landmarks"))
        poses = store.deserialize_cdr(points.data, "geometry_msgs/msg/PoseArray").poses
        assert [[q.position.x, q.position.y, q.position.z] for q in poses] == made.landmarks[0].tolist()


# What is no recording


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("log") / "drive.mcap"
    write_recording(simulated("crossing_path", horizon=0.1), path)
    return path.read_bytes()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda b: b[: len(b) // 2], "cut off, the end of the MCAP file is missing"),
        (lambda b: b[:5], "not an MCAP file"),
        (lambda b: b"", "not an MCAP file"),
        (lambda b: b"hello" * 100, "not an MCAP file"),
        (lambda b: b[:400] + bytes(200) + b[600:], "recording.json is damaged"),
        (lambda b: b[:8] + b[-8:], "damaged MCAP file"),
        (lambda b: b.replace(b'"staleness"', b'"staleless"'), "recording.json is damaged"),
        (lambda b: b.replace(b"coopenv recording 1", b"coopenv recording 9"), "format 'coopenv recording 9' is"),
    ],
)
def test_broken_files(change: Any, why: str, written: bytes, tmp_path: Path) -> None:
    path = tmp_path / "broken.mcap"
    path.write_bytes(change(written))
    with pytest.raises(DataError, match=why) as caught:
        read_recording(path)
    assert "broken.mcap" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", range(25))
def test_a_flipped_byte_never_goes_unnoticed_or_crashes(seed: int, written: bytes, tmp_path: Path) -> None:
    """Either the file is refused in one line, or the byte meant nothing (padding, library name, index)."""
    rng, path = np.random.default_rng(seed), tmp_path / "flipped.mcap"
    damaged = bytearray(written)
    damaged[int(rng.integers(len(damaged)))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(damaged))
    try:
        assert differences(simulated("crossing_path", horizon=0.1), read_recording(path)) == []
    except DataError as error:
        assert "flipped.mcap" in str(error)


def test_foreign_files(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(DataError, match=r"foreign\.mcap: an MCAP file, but no recording of coopenv"):
        read_recording(path)
    with pytest.raises(DataError, match=r"nowhere\.mcap: cannot be read \(No such file"):
        read_recording(tmp_path / "nowhere.mcap")


# The command


def test_command_records_a_simulation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.mcap"
    arguments = ["record", FOUR_WAY, "--seed", "3", "--policy", "random", "--set", "horizon=1.0"]
    assert main([*arguments, "--out", str(path)]) == 0
    assert "4 vehicles, 61 ticks, 1 s" in capsys.readouterr().out
    read = read_recording(path)
    parked = simulated(FOUR_WAY, seed=3)
    assert read.scenario == parked.scenario
    assert not np.array_equal(read.truth.position[-1], parked.truth.position[-1])  # somebody drove
    assert main([*arguments, "--out", str(path)]) == 2
    assert "exists already; --force replaces it" in capsys.readouterr().err
    assert main([*arguments, "--force", "--out", str(path)]) == 0
    assert differences(read, read_recording(path)) == []


def test_command_records_robots(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mrclam_files.write(tmp_path, seconds=6.0)
    path, data = tmp_path / "robots.mcap", ["--data", str(tmp_path)]
    assert main(["record", "mrclam_6", *data, "--variant", "blind", "--out", str(path)]) == 0
    assert differences(recording_of(load_dataset("mrclam_6", tmp_path), "blind"), read_recording(path)) == []
    assert not capsys.readouterr().err
    if find_spec("viser"):
        page = path.with_suffix(".html").read_text(encoding="utf-8")
        assert "mrclam_6, observer self_calibrating" in page and "first" not in page.split("<details id")[1]
    (tmp_path / "MRCLAM_Dataset6" / "Robot5_Measurement.dat").write_text("")
    assert main(["record", "mrclam_6", *data, "--force", "--out", str(path)]) == 0
    assert capsys.readouterr().err == "warning: mrclam_6: no detections of robot 5\n"


def test_a_log_of_version_0_2_still_replays() -> None:
    """`overtaking`, seed 3, 1 s, written by version 0.2; the final errors, m, are those that it computed itself."""
    found = run("riccati", read_recording(Path(__file__).parent / "data" / "overtaking_0.2.mcap"))
    assert_allclose(found.position_error[-1], [0.11374381960407857, 0.035937081495087564], rtol=1e-6)


def messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Return topic, tick, time in ns and contents of the messages of a log."""
    found = Container(path).messages()
    return [(channel.topic, message.sequence, message.log_time, message.data) for channel, _, message in found]


def test_a_log_of_version_0_2_is_written_again_byte_for_byte(tmp_path: Path) -> None:
    saved, again = Path(__file__).parent / "data" / "overtaking_0.2.mcap", tmp_path / "again.mcap"
    write_recording(read_recording(saved), again, start=messages(saved)[0][2] / 1e9)
    assert messages(again) == messages(saved)


def test_an_array_that_may_be_absent_is_in_a_log_if_the_scenario_has_it(tmp_path: Path) -> None:
    plain = read_recording(Path(__file__).parent / "data" / "overtaking_0.2.mcap")
    assert plain.pan is None and plain.scenario is not None
    assert_array_equal(plain.filled("pan"), np.zeros((plain.ticks, len(plain.setups))))
    keys = plain.scenario.model_dump()
    keys["action"]["pan"] = {"limit": 1.0, "rate": 2.0}
    turning = parse_scenario(keys, "turning cameras")
    made = replace(plain, scenario=turning, pan=np.linspace(0.0, 1.0, 2 * plain.ticks).reshape(-1, 2))
    assert differences(made, through(made, tmp_path)) == []
    assert {"/vehicle_1/pan", "/vehicle_2/pan"} == {m[0] for m in messages(tmp_path / "drive.mcap") if "pan" in m[0]}
    for contradictory in (replace(made, pan=None), replace(plain, pan=made.pan)):
        with pytest.raises(DataError, match=r"recording: pan: "):
            write_recording(contradictory, tmp_path / "no.mcap")
