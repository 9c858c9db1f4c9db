"""Logs hold what Foxglove and Lichtblick show, in the published types, read back with other libraries.

The SDK encodes; Foxglove's own protobuf package and the mcap libraries decode.
"""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.cli.app import main
from coopenv.episode import Episode
from coopenv.estimation.poses import Coordinates, covariance_in_map
from coopenv.estimation.trajectory import Trajectory
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record_episode
from coopenv.scenario.sensing import Camera
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.worlds import Replay
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.recordings import differences, simulated

pytest.importorskip("foxglove", reason="needs the extra 'log'")
pytest.importorskip("mcap_protobuf", reason="needs the extra 'dev'")
START = 1_700_000_000.25


class Log:
    """A file, decoded: messages by topic as (schema, time in s, message)."""

    def __init__(self, path: Path) -> None:
        from mcap.reader import make_reader
        from mcap_protobuf.decoder import DecoderFactory

        self.messages: dict[str, list[tuple[Any, float, Any]]] = defaultdict(list)
        self.sizes: dict[str, int] = defaultdict(int)
        self.order: list[int] = []
        factory = DecoderFactory()
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema is not None
                encoding = channel.message_encoding
                decode = factory.decoder_for(encoding, schema) or (json.loads if encoding == "json" else bytes)
                self.messages[channel.topic].append((schema, message.log_time * 1e-9, decode(message.data)))
                self.sizes[channel.topic] += len(message.data)
                self.order.append(message.log_time)

    def __getitem__(self, topic: str) -> list[Any]:
        return [content for _, _, content in self.messages[topic]]

    def entities(self, topic: str, k: int = 0) -> dict[str, Any]:
        return {entity.id: entity for entity in self[topic][k].entities}


def xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def estimated(recording: Recording, observer: str) -> Episode:
    return replace(record_episode(Replay(recording, "log", {"observer.name": observer})), recording=recording)


def written(recording: Recording, observer: str, path: Path) -> tuple[Trajectory, Log]:
    from coopenv.foxglove.log_views import views

    episode = estimated(recording, observer)
    write_recording(recording, path, views=views(episode, start=START), start=START)
    return episode.trajectory, Log(path)


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, Trajectory, Log, Path]:
    made = simulated(FOUR_WAY, horizon=2.0, seed=1)
    path = tmp_path_factory.mktemp("log") / "drive.mcap"
    return (made, *written(made, "robust", path), path)


def test_schemas_are_those_that_foxglove_publishes(crossing: Any) -> None:
    """The descriptors in the file have every field of the published package, with the same number and type."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    found = {schema.name: schema for rows in crossing[2].messages.values() for schema, _, _ in rows}
    published = {name for name in found if name.startswith("foxglove.")}
    kinds = ("CameraCalibration", "CompressedImage", "FrameTransforms", "ImageAnnotations", "SceneUpdate")
    assert published == {f"foxglove.{kind}" for kind in kinds}
    for name in published:
        kind = name.removeprefix("foxglove.")
        module = import_module(f"foxglove_schemas_protobuf.{kind}_pb2")
        assert found[name].encoding == "protobuf"
        files = FileDescriptorSet.FromString(found[name].data).file
        (message,) = (m for f in files for m in f.message_type if f"{f.package}.{m.name}" == name)
        found_fields = {field.name: (field.number, field.type) for field in message.field}
        for field in getattr(module, kind).DESCRIPTOR.fields:
            assert found_fields[field.name] == (field.number, field.type), f"{name}.{field.name}"


def test_messages_come_in_the_order_of_time_with_wall_clock_stamps(crossing: Any) -> None:
    made, _, log, _ = crossing
    assert log.order == sorted(log.order)
    assert log.order[0] == round(START * 1e9)
    for k, (_, when, message) in zip(range(0, made.ticks, 3), log.messages["/tf"], strict=True):
        assert when == pytest.approx(START + k * made.dt, abs=1e-6)
        stamp = message.transforms[0].timestamp
        assert stamp.seconds + 1e-9 * stamp.nanos == pytest.approx(when, abs=1e-6)


def test_the_scene_has_buildings_roads_landmarks_with_names_and_vehicles(crossing: Any) -> None:
    made, _, log, _ = crossing
    scenario, world = made.scenario, log.entities("/scene/world")
    names = made.setups[0].target_names[: made.landmarks.shape[1]]
    assert {f"landmark {name}" for name in names} <= world.keys()
    assert {f"building {building.name}" for building in scenario.obstacles} <= world.keys()
    assert len(world["roads"].triangles[0].points) == 6 * len(scenario.roads)
    for i, name in enumerate(names):
        entity = world[f"landmark {name}"]
        assert entity.texts[0].text == name and entity.frame_id == "map"
        np.testing.assert_allclose(xyz(entity.spheres[0].pose.position), made.landmarks[0, i], rtol=1e-6, atol=1e-6)
    vehicles = log.entities("/scene/vehicles")
    assert vehicles.keys() == {f"vehicle_{i}{kind}" for i in range(1, 5) for kind in ("", " estimate")}
    box = vehicles["vehicle_2"]
    assert box.frame_locked and box.frame_id == "vehicle_2"
    np.testing.assert_allclose(xyz(box.cubes[0].size), scenario.vehicles[1].body.size, rtol=1e-6)


def test_transforms_are_the_poses(crossing: Any) -> None:
    made, result, log, _ = crossing
    for n, message in enumerate(log["/tf"]):
        frames = {t.child_frame_id: t for t in message.transforms}
        k = 3 * n
        for i in range(4):
            for name, R, p in (
                (f"vehicle_{i + 1}", made.truth.rotation[k, i], made.truth.position[k, i]),
                (f"vehicle_{i + 1}/estimate", result.rotation_estimate[k, i], result.position_estimate[k, i]),
            ):
                q = frames[name].rotation
                assert frames[name].parent_frame_id == "map"
                np.testing.assert_allclose(xyz(frames[name].translation), p, rtol=1e-6, atol=1e-5)
                np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), R, atol=1e-5)


def test_lines_of_sight_end_where_the_measured_bearings_point(crossing: Any) -> None:
    made, _, log, _ = crossing
    seen = 0
    for n, message in enumerate(log["/scene/sight"]):
        entities = {entity.id: entity for entity in message.entities}
        for i in range(4):
            lines = entities[f"sight of vehicle_{i + 1}"].lines
            targets = np.flatnonzero(made.visible[3 * n, i])
            ends = np.array([xyz(p) for p in lines[0].points]) if lines else np.empty((0, 3))
            assert len(ends) == 2 * len(targets)
            for target, start, end in zip(targets, ends[::2], ends[1::2], strict=True):
                way = made.truth.rotation[3 * n, i].T @ (end - start)
                assert way @ made.bearings[3 * n, i, target] == pytest.approx(np.linalg.norm(way), rel=2e-3)
                seen += 1
    assert seen > 50


def test_estimates_have_the_covariance_in_the_maps_axes(crossing: Any) -> None:
    from coopenv.sources.mcap_format import codec

    made, result, log, _ = crossing
    P = covariance_in_map(Coordinates.RICCATI, result.rotation_estimate, result.position_estimate, result.covariance)
    stated = 0
    for n, data in enumerate(log["/vehicle_3/estimate"]):
        message = codec().deserialize_cdr(data, "geometry_msgs/msg/PoseWithCovarianceStamped")
        found = message.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(
            xyz(message.pose.pose.position), result.position_estimate[3 * n, 2], rtol=1e-6, atol=1e-5
        )
        if np.isfinite(P[3 * n, 2]).all():
            np.testing.assert_allclose(found, P[3 * n, 2], rtol=1e-5, atol=1e-9)
            stated += 1
        else:
            assert not found.any()
    assert stated > 30
    ball = log.entities("/scene/uncertainty", 20)["3 sigma of vehicle_3"].spheres[0]
    sizes = sorted(xyz(ball.size))
    np.testing.assert_allclose(sizes, 6.0 * np.sqrt(np.linalg.eigvalsh(P[60, 2, :3, :3])), rtol=1e-4)
    assert log["/vehicle_3/error"][20]["position_error_m"] == pytest.approx(result.position_error[60, 2], rel=1e-4)
    assert made.ticks == 121


@pytest.mark.parametrize("coordinates", Coordinates)
def test_covariances_turn_to_the_map_as_errors_do(coordinates: Coordinates) -> None:
    """By derivatives of the definition of the error, taken numerically."""
    rng = np.random.default_rng(3)
    R_hat, p_hat = Rotation.random(random_state=4).as_matrix(), np.array([7.0, -3.0, 2.0])
    root = rng.standard_normal((6, 6))
    expected = root @ root.T  # of (position, rotation about the map's axes)
    step = 1e-6
    columns = []
    for axis in np.eye(6):
        ends = []
        for sign in (1.0, -1.0):
            d, phi = sign * step * axis[:3], sign * step * axis[3:]
            R = Rotation.from_rotvec(phi).as_matrix() @ R_hat
            ends.append(coordinates.error(R[None], (p_hat + d)[None], R_hat[None], p_hat[None])[0])
        columns.append((ends[0] - ends[1]) / (2 * step))
    J = np.array(columns).T
    found = covariance_in_map(coordinates, R_hat, p_hat, J @ expected @ J.T)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_projected_targets_are_where_the_camera_measured_them(crossing: Any) -> None:
    """Undistorted pixels of the annotations, by the calibration in the file, are the bearings again."""
    from coopenv.estimation.lens import undistort

    made, _, log, _ = crossing
    (calibration,) = log["/vehicle_1/camera/calibration"]
    assert (calibration.width, calibration.height) == (316, 208)
    assert calibration.distortion_model == "plumb_bob" and len(calibration.D) == 5
    K = np.array(calibration.K).reshape(3, 3)
    mounted = {t.child_frame_id: t.rotation for t in log["/tf"][0].transforms}["vehicle_1/camera"]
    R = Rotation.from_quat([mounted.x, mounted.y, mounted.z, mounted.w]).as_matrix()
    names, seen = list(made.setups[0].target_names), 0
    for n, message in enumerate(log["/vehicle_1/camera/annotations"]):
        for circle, label in zip(message.circles, message.texts, strict=True):
            pixel = np.array([circle.position.x, circle.position.y])
            assert (pixel > -2).all() and (pixel < [318, 210]).all()  # bearings have noise
            flat, there = undistort(((pixel - K[:2, 2]) / K[[0, 1], [0, 1]])[None], tuple(calibration.D))
            bearing = made.bearings[3 * n, 0, names.index(label.text)]
            assert there.all()
            ray = R @ np.append(flat[0], 1.0)
            np.testing.assert_allclose(ray / np.linalg.norm(ray), bearing, atol=1e-5)
            seen += 1
    assert seen > 20
    (image,) = log["/vehicle_1/camera/image"]
    assert image.format == "png" and image.data.startswith(b"\x89PNG")


def test_distortion_moves_the_targets() -> None:
    from coopenv.viz.perspective import pixels

    rays = np.array([[0.3, 0.2, 0.9], [0.0, 0.0, 1.0], [0.1, 0.1, -0.5]])
    straight = pixels(rays, Camera(model="pinhole"))
    bent = pixels(rays, Camera(model="pinhole", distortion=(-0.35, 0.14, 0.0, 0.0, 0.0)))
    assert np.isfinite(straight).all(axis=1).tolist() == [True, True, False]
    np.testing.assert_allclose(straight[1], Camera().principal_point)
    assert np.linalg.norm(bent[0] - straight[0]) > 4.0


def test_views_cost_little(crossing: Any) -> None:
    """At 20 Hz, in single precision: less than two thirds of what the recording itself takes."""
    sizes = crossing[2].sizes
    parts = ("/scene", "/tf", "/error", "/estimate", "/camera/")
    shown = sum(size for topic, size in sizes.items() if any(part in topic for part in parts))
    assert shown < 0.66 * (sum(sizes.values()) - shown)


def test_gain_matrices_are_no_covariances(tmp_path: Path) -> None:
    from coopenv.foxglove.log_views import views
    from coopenv.sources.mcap_format import codec

    made, path = simulated("crossing_path", horizon=22.0), tmp_path / "gain.mcap"
    shown = views(estimated(made, "riccati"))
    write_recording(made, path, views=shown)
    log = Log(path)
    assert "/scene/uncertainty" not in log.messages
    for data in log["/vehicle_1/estimate"]:
        assert not codec().deserialize_cdr(data, "geometry_msgs/msg/PoseWithCovarianceStamped").pose.covariance.any()
    assert log["/vehicle_1/error"][-1]["nees"] is None
    assert len(log["/scene/landmarks"]) == len(log["/tf"])  # the moving one
    assert {entity.id for entity in log["/scene/landmarks"][3].entities} == {"landmark ML"}


def test_the_command_writes_a_scene_and_a_layout_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record = ["record", FOUR_WAY, "--set", "horizon=0.5", "--out"]
    assert main([*record, "a.mcap", "--observer", "robust"]) == 0
    assert main([*record, "b.mcap", "--no-scene"]) == 0
    assert differences(read_recording("a.mcap"), read_recording("b.mcap")) == []
    capsys.readouterr()
    assert main(["export", "a.mcap", "--format", "foxglove-layout"]) == 0
    assert "foxglove_layout.json: import it in Foxglove" in capsys.readouterr().out
    layout = json.loads(Path("foxglove_layout.json").read_text())
    topics = set(Log(Path("a.mcap")).messages)
    panels = layout["configById"]
    assert panels["3D!scene"]["topics"].keys() <= topics
    assert {t for t, shown in panels["3D!scene"]["topics"].items() if shown["visible"]} == {
        *("/scene/world", "/scene/vehicles", "/scene/sight", "/scene/uncertainty")
    }
    mode = panels["Image!camera"]["imageMode"]
    assert {mode["imageTopic"], mode["calibrationTopic"], *mode["annotations"]} <= topics
    for name in ("Plot!position", "Plot!orientation"):
        for path in panels[name]["paths"]:
            topic, _, column = path["value"].partition(".")
            assert column in Log(Path("a.mcap"))[topic][0]

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    assert main(["export", "b.mcap", "--format", "foxglove-layout"]) == 2
    assert "b.mcap: has no scene, `coopenv record --scene` writes one" in capsys.readouterr().err
    assert main(["export", "nowhere.mcap", "--format", "foxglove-layout"]) == 2
    assert "no such run or log: nowhere.mcap" in capsys.readouterr().err
    assert main([*record, "c.mcap", "--no-scene", "--observer", "robust"]) == 2
    assert "--observer robust: is for a scene" in capsys.readouterr().err
    assert main([*record, "c.mcap", "--observer", "robst"]) == 2
    assert "unknown observer 'robst' (did you mean 'robust'?)" in capsys.readouterr().err
    assert not Path("c.mcap").exists()
