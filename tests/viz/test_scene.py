"""Scenes as plain data and in the browser."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, DataError
from coopenv.episode import FIELDS, Episode, Frame, Origin
from coopenv.estimation import Sight
from coopenv.policies import decide, load_policy
from coopenv.runs.scenes import scene_of
from coopenv.viz.meshes import Look, linear, placed, spacing_of
from coopenv.viz.perspective import Lens
from coopenv.viz.stage import Stage, entries
from coopenv.viz.topview import TopView
from coopenv.viz.web import write_replay
from coopenv.viz.web_panel import GAIN, table_html
from coopenv.viz.web_picture import FIELD_OF_VIEW, first_camera, first_look, level_lines, levels, stopped
from tests.helpers.env_suite import ALIKE, each_slow
from tests.helpers.pages import messages

ALONG = np.array([40.0, 0.0, 0.0])


def played(name: str, overrides: dict[str, Any], decisions: int, seed: int = 1) -> Engine:
    engine = Engine(coopenv.load_scenario(name, overrides), dtype="float64")
    engine.reset([seed])
    for _ in range(decisions):
        engine.step()
    return engine


@pytest.fixture(scope="module")
def urban() -> Episode:
    scenario = coopenv.load_scenario("urban_crossing", {"horizon": 3.0})
    return scene_of(Engine(scenario), Origin.of("urban_crossing", scenario, seed=1, policy="zero"))


def test_a_frame_is_what_the_engine_says() -> None:
    engine = played("urban_crossing", {}, 12)
    frame = Frame.of(engine)
    there = engine.view("present")[0] == 1
    np.testing.assert_array_equal(frame.target_position[there], engine.view("position")[0][there])
    assert np.isnan(frame.target_position[~there]).all()
    expected = (engine.view("estimate_rotation")[0] @ engine.view("estimate_position")[0][..., None])[..., 0]
    own = there[frame.landmarks :]
    np.testing.assert_array_equal(frame.position_estimate[own], expected[own])
    error = np.linalg.norm(frame.position - frame.position_estimate, axis=-1)
    np.testing.assert_allclose(error[own], frame.position_error[own], rtol=1e-9)
    before = frame.target_position.copy()
    engine.step()
    np.testing.assert_array_equal(frame.target_position, before)  # a copy
    variance = np.trace(frame.position_covariance[own], axis1=1, axis2=2)
    assert (frame.three_sigma[own] <= 3.0 * np.sqrt(variance) * (1 + 1e-9)).all()


def test_a_scene_comes_back_from_its_file(urban: Episode, tmp_path: Path) -> None:
    urban.save(tmp_path / "scene.npz")
    again = Episode.load(tmp_path / "scene.npz")
    assert (again.source, len(again), again.scenario.title) == (urban.source, len(urban), urban.scenario.title)
    assert again.source.words == "urban_crossing, observer riccati, driven by zero, seed 1" or again.source.honest
    assert not again["reading_tick"].size and urban.frame(0).reading_tick is None  # no sensors beside the camera
    for name in [name for name in FIELDS if name != "reading_tick"]:
        values = np.stack([getattr(urban.frame(k), name) for k in range(len(urban))])
        np.testing.assert_allclose(again[name], values, rtol=1e-6, atol=1e-30, err_msg=name)
    np.testing.assert_array_equal(again.time, urban.time)
    with np.load(tmp_path / "scene.npz") as kept:
        assert len(kept["goal"]) == 1 and len(kept["rotation"]) == len(urban)  # what stands still is kept once
    first, second = (TopView(record.scenario).paint(record.frame(3)) for record in (urban, again))
    assert np.mean(np.any(first != second, axis=-1)) < 0.01


def edited(path: Path, to: Path, **changes: Any) -> Path:
    with np.load(path) as kept:
        arrays = {name: kept[name] for name in kept.files}
    header = json.loads(arrays["header"].tobytes())
    for name, value in changes.items():
        if name in header:
            arrays["header"] = np.frombuffer(json.dumps({**header, name: value}).encode(), np.uint8)
        elif value is None:
            del arrays[name]
        else:
            arrays[name] = value
    np.savez(to, **arrays)
    return to


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sight": None}, "not a scene, missing: sight"),
        ({"rotation": np.zeros((31, 2, 3, 3), np.float32)}, "rotation: float32 (31, 2, 3, 3) is not of"),
        ({"frames": 10**9}, "tick: int32 (31,) is not of"),
        ({"ended": np.zeros((1, 4), np.float32)}, "ended: float32"),
        ({"nees": np.zeros((7, 4), np.float32)}, "nees: float32 (7, 4) is not of"),
        ({"frames": "many"}, "frames"),
        ({"frames": 0}, "frames"),
        ({"source": {"name": "x"}}, "observer"),
        ({"scenario": {"title": 3}}, "edited.npz"),
        ({"pan": np.array([["a"]])}, "pan: <U1"),
        ({"tick": np.arange(31, dtype=np.int32)[::-1]}, "tick: expected camera ticks from 0 to"),
        ({"tick": np.arange(31, dtype=np.int32) * 10**7}, "tick: expected camera ticks from 0 to"),
    ],
)
def test_a_file_that_is_no_scene_is_refused(
    urban: Episode, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    urban.save(tmp_path / "scene.npz")
    with pytest.raises(CoopenvError) as error:
        Episode.load(edited(tmp_path / "scene.npz", tmp_path / "edited.npz", **changes))
    assert message in str(error.value) and "\n" not in str(error.value)
    assert "edited.npz" in str(error.value)


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"PK no archive", b"x" * 1000):
        (tmp_path / "scene.npz").write_bytes(content)
        with pytest.raises(DataError, match="not a readable scene"):
            Episode.load(tmp_path / "scene.npz")
    with pytest.raises(DataError, match="No such file"):
        Episode.load(tmp_path / "none.npz")


@pytest.mark.parametrize("name", ["behind_truck", "large_crossing", "urban_crossing"])
def test_who_is_hidden_is_hidden_by_somebody(name: str) -> None:
    """The kernels decide what is hidden; the scene finds what stands between, by another computation."""
    wall = {"obstacles": [{"name": "wall", "center": [0.0, 0.0, 1.0], "size": [3.0, 0.4, 2.0], "yaw": 0.7}]}
    changes = {"noise.enabled": False, "horizon": 12.0, **(wall if name == "urban_crossing" else {})}
    scenario = coopenv.load_scenario(name, changes)
    engine, policy = Engine(scenario, dtype="float64"), load_policy("route_follower", scenario, 0)
    record = scene_of(engine, Origin.of(name, scenario, seed=3), policy)
    stage, hidden = Stage(scenario), 0
    for k in range(0, len(record), 3):
        frame = record.frame(k)
        eye, target = stage.eyes(frame), stage.targets(frame)
        for i, j in np.argwhere(np.isin(frame.sight, (Sight.OCCLUDED_BY_BUILDING, Sight.OCCLUDED_BY_BODY))):
            hidden += 1
            assert stage.hider(frame, i, j), f"{stage.short_name(j)} from f{i + 1}"
        for i, j in np.argwhere(frame.sight == Sight.VISIBLE):
            assert stage.hider(frame, i, j) is None
            boxes = [*stage.buildings, *stage.solid(frame, (int(j), stage.landmarks + int(i)))]
            assert not (entries(eye[[i]], target[[j]] - eye[[i]], boxes) < 1.0).any()
    assert hidden


def test_lines_end_where_something_stands() -> None:
    stage = Stage(coopenv.load_scenario("urban_crossing"))
    (box, *_) = stage.buildings
    start = box.center + np.array([[-20.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-20.0, 0.0, 30.0]])
    ends = stopped(start, start + ALONG, [box])
    np.testing.assert_allclose(ends[0], box.center - [box.size[0] / 2, 0.0, 0.0])
    np.testing.assert_allclose(ends[1:], start[1:] + ALONG)  # from inside, and over it


def test_targets_are_projected_to_where_cameras_measure_them() -> None:
    """The bearings of the kernels, turned into pixels by the pinhole formula."""
    engine = played("open_square", {"noise.enabled": False, "sensing": "sensed"}, 0, seed=2)
    scenario, seen = engine.backend.scenario, 0
    policy = load_policy("peek", scenario, 0)
    for _ in range(15):
        engine.step(decide(policy, engine.view("observation")[0].copy(), engine.view("actions").shape[-1])[None])
    stage, frame = Stage(scenario), Frame.of(engine)
    for i, j in np.argwhere(frame.sight == Sight.VISIBLE):
        lens = Lens(stage, frame, int(i))
        (pixel,) = lens.pixels(lens.in_camera(stage.targets(frame)[[j]]))
        assert (pixel >= 0).all() and (pixel <= lens.size).all()
        right, down, ahead = engine.view("bearing")[0, i, j]
        camera = scenario.cameras[i]
        (fx, fy), (cx, cy) = camera.focal_length, camera.principal_point
        if not any(camera.distortion):
            np.testing.assert_allclose(pixel, [cx + fx * right / ahead, cy + fy * down / ahead], atol=0.05)
        seen += 1
    assert seen


def scene(name: str, **overrides: Any) -> Episode:
    scenario = coopenv.load_scenario(name, {"horizon": 4.0, **overrides})
    return scene_of(Engine(scenario), Origin.of(name, scenario, seed=1))


@pytest.fixture(scope="module")
def overtaking() -> Episode:
    return scene("overtaking", horizon=0.5)


def test_names_of_vehicles_that_are_close_stand_above_each_other() -> None:
    points = np.array([[0.0, 0], [1, 0], [9, 0], [1.5, 0], [np.nan, 0], [9, -0.5]])
    assert levels(points, 2.0).tolist() == [0, 1, 1, 2, 0, 0]


def test_a_page_holds_the_episode(tmp_path: Path) -> None:
    record = scene("urban_crossing", **{"observer.name": "robust"})
    shares: list[float] = []
    path = write_replay(record, tmp_path / "replay.html", shares.append)
    page = path.read_text(encoding="utf-8")
    length, sent = messages(page)
    assert length == pytest.approx(record.length)
    times = [time for time, _ in sent]
    assert times == sorted(times) and len(set(times)) == len(record)
    moved = {message["name"] for time, message in sent if time > 0 and message["type"] == "SceneNodeUpdateMessage"}
    assert {"/world/cars/true", "/world/estimates/body", "/world/ellipsoids", "/world/errors"} <= moved
    assert "urban_crossing, observer robust, seed 1" in page and "Urban crossing - coopenv</title>" in page
    assert GAIN not in page
    assert all(a <= b for a, b in pairwise(shares)) and shares[-1] > 0.9
    assert path.stat().st_size < 1.3e6


def test_a_gain_is_not_called_a_covariance_and_titles_bring_no_code_along(tmp_path: Path) -> None:
    record = scene("overtaking", title="<script>alert(1)</script> & more")
    page = write_replay(record, tmp_path / "replay.html").read_text(encoding="utf-8")
    assert GAIN in page and "3σ" not in page.rpartition("__VISER_EMBED_DATA__")[2].partition(";")[2]
    assert "<script>alert" not in page and "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in page


@pytest.mark.parametrize("name", each_slow(coopenv.list_envs(), *ALIKE))
def test_every_environment_can_be_drawn(name: str, tmp_path: Path) -> None:
    path = write_replay(scene(name, horizon=1.0), tmp_path / "replay.html")
    length, _ = messages(path.read_text(encoding="utf-8"))
    assert length == pytest.approx(1.0, abs=0.21)


def test_what_is_not_there_has_no_size() -> None:
    where = placed(None, np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]]), np.ones((2, 3)))
    np.testing.assert_array_equal(where.scales, [[1, 1, 1], [0, 0, 0]])
    np.testing.assert_array_equal(where.positions, [[1, 2, 3], [0, 0, 0]])


def test_colours_are_made_linear_and_the_grid_has_even_spacing() -> None:
    np.testing.assert_array_equal(linear(np.array([0, 188, 255])), [0, 128, 255])
    sides = (30.0, 100.0, 99.0, 4.0, 1.0)
    assert [spacing_of(side) for side in sides] == pytest.approx([2.0, 10.0, 5.0, 0.2, 0.1])


@pytest.mark.parametrize("aspect", [1.6, 0.5])
def test_the_first_camera_has_the_whole_map_in_sight(aspect: float) -> None:
    stage = Stage(coopenv.load_scenario("urban_crossing"))
    eye, middle = first_camera(stage, aspect)
    ahead = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    half = 0.4 * stage.side  # what happens is within the middle of the square
    for x, y in [(-half, -half), (half, -half), (-half, half), (half, half)]:
        line = middle + np.array([x, y, 0.0]) - eye
        depth = line @ ahead
        assert abs(line @ up) / depth < np.tan(FIELD_OF_VIEW / 2)
        assert abs(line @ right) / depth < aspect * np.tan(FIELD_OF_VIEW / 2)


def test_small_ellipsoids_are_magnified() -> None:
    stage = Stage(coopenv.load_scenario("urban_crossing"))
    source = Origin(name="", observer="robust")
    for share, factor in ((0.02, 1.0), (0.002, 10.0), (0.0002, 100.0), (np.nan, 1.0)):
        assert first_look(np.array([share * stage.side, np.nan]), stage, source).magnification == factor
    assert first_look(np.array([2e-4]), stage, source.model_copy(update={"honest": False})).magnification == 1.0


def test_circles_of_protection_levels(overtaking: Episode) -> None:
    """Of the picked vehicle, or of all; neither unknown levels nor circles beyond the scene are drawn."""
    frame = overtaking.frame(len(overtaking) - 1)
    n = len(frame.position_estimate)
    level = np.full((n, 2), np.inf)
    level[0], level[1] = (2.0, 0.1), (1e3, 0.1)
    frame = replace(frame, protection_level=level, position_estimate=np.arange(3.0 * n).reshape(n, 3))
    colours = np.arange(3 * n, dtype=np.uint8).reshape(n, 3)
    for look in (Look(picked=0), Look(levels=True)):
        points, shades = level_lines(frame, colours, look, 50.0, 0.5)
        assert points.shape == (32, 2, 3) and (shades == colours[0]).all() and (points[..., 2] == 0.5).all()
        np.testing.assert_allclose(np.linalg.norm(points[..., :2] - [0.0, 1.0], axis=-1), 2.0)
    assert not len(level_lines(frame, colours, Look(picked=1), 50.0, 0.5)[0])
    assert not len(level_lines(frame, colours, Look(), 50.0, 0.5)[0])


def test_table_with_protection_levels(overtaking: Episode) -> None:
    frame = overtaking.frame(0)
    level = np.full((len(frame.position_estimate), 2), np.inf)
    assert "level" not in table_html(overtaking.source, replace(frame, protection_level=level))
    level[0] = 1.25, 0.1
    text = table_html(overtaking.source, replace(frame, protection_level=level))
    assert "level [m]" in text and ">1.25</td>" in text and text.count(">-</td>") >= len(level) - 1


def test_no_vehicle_has_no_field_of_view() -> None:
    """A view of one vehicle, which shows some vehicles at a time, has ticks in whose turn none is."""
    engine = played("facade", {}, 0)
    views = Stage(engine.backend.scenario).fields_of_view(Frame.of(engine), of=slice(1, 1))
    assert views is not None and views.shape[0] == 0 and views.shape[2] == 3
