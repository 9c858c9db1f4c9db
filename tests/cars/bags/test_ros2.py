"""Recordings as plain ROS 2 bags: other readers take them, and coopenv reads the same episode back."""

from __future__ import annotations

import warnings
from collections import Counter
from functools import cache
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from coopenv import CoopenvError
from coopenv.base.errors import DataWarning
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.ros2 import START, export_bag, write_bag
from coopenv.cli.app import main
from coopenv.measurements.sensor import Sensor
from coopenv.observers import Recording, run
from coopenv.observers.contract import SensorNoise
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.sources.mcap import read_recording, write_recording

pytest.importorskip("rosbags", reason="needs the extra 'log'")

ARRAYS = ("rotation", "translation", "velocity", "angular_velocity", "landmarks", "inbox_tick", "due")
STARTS = ("start_rotation", "start_position", "start_covariance", "truth.position", "truth.rotation")
ENVIRONMENTS = ("crossing_path", "svea_overtaking", "busy_intersection", "take_turns")
"""A moving landmark and a pixel camera; two cars; cameras without pixels; landmarks that are drawn."""
SEED = 3
PUNCTUAL = {f"camera.{name}": 0.0 for name in ("latency", "latency_error", "latency_jitter")}


@cache
def recorded(name: str) -> Recording:
    return record(load_scenario(name, {"horizon": 1.0, **PUNCTUAL}), SEED)


@cache
def read_back(name: str, folder: Path) -> Recording:
    write_bag(recorded(name), folder / name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return record(Bag([folder / name], folder / name / "topics.toml"), SEED)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ros2")


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_same_ticks_are_read_back(name: str, folder: Path) -> None:
    """But for the frame of tick 0, which observers do not use."""
    sent, found = recorded(name), read_back(name, folder)
    for array in (*ARRAYS, *STARTS):
        assert_allclose(attrgetter(array)(found), attrgetter(array)(sent), rtol=0.0, atol=1e-8, err_msg=array)
    assert_array_equal(found.visible[1:], sent.visible[1:])
    expected = np.where(sent.visible[1:, ..., None], sent.bearings[1:], np.nan)
    assert_allclose(found.bearings[1:], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("observer", ["riccati", "robust"])
def test_observers_estimate_the_same(observer: str, folder: Path) -> None:
    for name in ENVIRONMENTS[:3]:
        sent, found = run(observer, recorded(name)), run(observer, read_back(name, folder))
        assert not sent.failure
        assert_allclose(found.position, sent.position, rtol=0.0, atol=1e-9)
        assert_allclose(found.rotation, sent.rotation, rtol=0.0, atol=1e-9)


def messages_of(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return time (ns) and message by topic, as rosbags reads them, by the definitions in the bag."""
    from rosbags.highlevel import AnyReader

    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([bag]) as reader:
        for connection, time, data in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(data, connection.msgtype)))
    return found


def test_rosbags_reads_standard_messages_alone(folder: Path) -> None:
    read_back("svea_overtaking", folder)
    found, sent = messages_of(folder / "svea_overtaking"), recorded("svea_overtaking")
    kinds = Counter(message.__msgtype__.split("/")[0] for rows in found.values() for _, message in rows)
    assert kinds.keys() == {f"{name}_msgs" for name in ("aruco", "geometry", "nav", "sensor", "tf2", "visualization")}
    assert all(time == stamp_of(message) for rows in found.values() for time, message in rows if stamp_of(message))
    assert len(found["/vehicle_1/truth"]) == len(found["/vehicle_2/imu"]) == sent.ticks
    [(_, info)] = found["/vehicle_1/camera_info"]
    camera = load_scenario("svea_overtaking").cameras[0]
    assert (info.width, info.height) == camera.image_size and tuple(info.d) == camera.distortion
    assert (info.k[0], info.k[4]) == camera.focal_length and (info.k[2], info.k[5]) == camera.principal_point
    [(_, tree)] = found["/tf_static"]
    mounted = tree.transforms[0].transform
    q = mounted.rotation
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    assert_allclose(turned, camera.to_body(), atol=1e-12)
    assert (mounted.translation.x, mounted.translation.y, mounted.translation.z) == camera.position


def stamp_of(message: Any) -> int:
    about = getattr(message, "header", None)
    return 0 if about is None else int(about.stamp.sec) * 10**9 + int(about.stamp.nanosec)


def test_the_pose_of_the_odometry_is_the_integral_of_its_twist(folder: Path) -> None:
    """By small steps of a held twist."""
    read_back("svea_overtaking", folder)
    rows = messages_of(folder / "svea_overtaking")["/vehicle_1/odometry"]
    for (t0, a), (t1, b) in pairwise(rows[1:41]):
        R, p = pose_of(a)
        steps, seconds = 200, (t1 - t0) * 1e-9
        v, w = (np.array([u.x, u.y, u.z]) for u in (a.twist.twist.linear, a.twist.twist.angular))
        half = Rotation.from_rotvec(0.5 * w * seconds / steps).as_matrix()
        for _ in range(steps):
            R = R @ half
            p = p + R @ v * seconds / steps
            R = R @ half
        found_R, found_p = pose_of(b)
        assert_allclose(p, found_p, atol=1e-9)
        assert_allclose(R, found_R, atol=1e-9)


def pose_of(message: Any) -> tuple[np.ndarray, np.ndarray]:
    q, at = message.pose.pose.orientation, message.pose.pose.position
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([at.x, at.y, at.z])


def test_estimates_have_their_covariance(tmp_path: Path) -> None:
    """On the map: for the paper's observer the error of a position is d = Rhat (e - (Rhat^T phat) x theta)."""
    sent = recorded("crossing_path")
    export_bag(sent, tmp_path / "bag", "riccati")
    estimates = run("riccati", sent)
    rows = messages_of(tmp_path / "bag")["/vehicle_1/estimate"]
    assert len(rows) == sent.ticks
    origin = np.array(load_scenario("crossing_path").map.origin)
    message, R, p, P = rows[40][1], estimates.rotation[40, 0], estimates.position[40, 0], estimates.covariance[40, 0]
    assert_allclose(pose_of(message)[1], p + origin, atol=1e-12)
    x, y, z = R.T @ p
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    J = np.hstack([-R @ cross, R])
    assert_allclose(message.pose.covariance.reshape(6, 6)[:3, :3], J @ P @ J.T, atol=1e-12)


def test_frames_have_the_stamp_of_their_exposure(tmp_path: Path) -> None:
    write_bag(
        record(load_scenario("crossing_path", {"horizon": 0.2, **PUNCTUAL, "camera.latency": 0.05}), 0), tmp_path / "b"
    )
    rows = messages_of(tmp_path / "b")["/vehicle_1/detections"][1:]
    assert [time - stamp_of(message) for time, message in rows] == [50_000_000] * 13


def test_every_channel_is_cdr_and_the_metadata_are_those_of_rosbag2(folder: Path) -> None:
    from mcap.reader import make_reader

    read_back("svea_overtaking", folder)
    with (folder / "svea_overtaking" / "svea_overtaking.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        count = summary.statistics.message_count
    import yaml

    about = yaml.safe_load((folder / "svea_overtaking" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert about["storage_identifier"] == "mcap" and about["relative_file_paths"] == ["svea_overtaking.mcap"]
    counts = [topic["message_count"] for topic in about["topics_with_message_count"]]
    assert about["message_count"] == count == sum(counts)
    first = about["starting_time"]["nanoseconds_since_epoch"]
    assert START * 10**9 - first == 16_666_667  # one frame, without detections, before tick 0


def test_record_and_export_write_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, bag, other = tmp_path / "log.mcap", tmp_path / "bag", tmp_path / "log"
    write_recording(recorded("crossing_path"), log)
    assert main(["export", str(log), "--format", "ros2"]) == 0
    changes = [text for key, value in PUNCTUAL.items() for text in ("--override", f"{key}={value}")]
    line = ["record", "crossing_path", "--override", "horizon=1", *changes, "--seed", str(SEED), "--ros", "--no-replay"]
    assert main([*line, "--out", str(bag)]) == 0
    found, again = messages_of(bag), messages_of(other)
    assert found.keys() == again.keys() and "/vehicle_1/estimate" in found
    assert [repr(m) for m in found["/vehicle_1/odometry"]] == [repr(m) for m in again["/vehicle_1/odometry"]]
    assert main([*line, "--out", str(bag)]) == 2
    assert "exists already" in capsys.readouterr().err
    out = tmp_path / "back.mcap"
    assert main(["import", str(bag), "--map", str(bag / "topics.toml"), "--seed", str(SEED), "--out", str(out)]) == 0
    assert_allclose(read_recording(out).translation, recorded("crossing_path").translation, atol=1e-8)


def test_measurements_without_a_standard_message_are_named(tmp_path: Path) -> None:
    K = 5
    recording = Recording.from_arrays(
        dt=0.1,
        landmarks=[[1.0, 0.0, 0.0]],
        velocity=np.zeros((K, 1, 3)),
        angular_velocity=np.zeros((K, 1, 3)),
        bearings=np.broadcast_to([1.0, 0.0, 0.0], (K, 1, 2, 3)) * [[[[1.0], [np.nan]]]],
        noise=SensorNoise(0.01, 0.01, 0.1, 0.01),
        start_position=[[0.0, 0.0, 0.0]],
        start_rotation=[np.eye(3)],
        sensors=(Sensor("distance", "range", np.array([0.1]), np.array([0]), np.zeros(3), np.eye(3)),),
        readings={"distance": np.broadcast_to([[1.0], [np.nan]], (K, 1, 2, 1))},
    )
    with pytest.warns(DataWarning, match="left out, since no standard message has their measurements: distance"):
        write_bag(recording, tmp_path / "bag")
    assert not (tmp_path / "bag" / "topics.toml").exists()
    assert len(messages_of(tmp_path / "bag")["/vehicle_1/detections"]) == K + 1


def test_an_observer_that_fails_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(CoopenvError, match="no_such_observer"):
        export_bag(recorded("crossing_path"), tmp_path / "bag", "no_such_observer")
    assert not (tmp_path / "bag").exists()
