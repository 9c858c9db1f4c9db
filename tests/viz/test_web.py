"""Scenes in the browser: what pages hold, and what lies behind their drawings."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.runs.scenes import scene_of
from coopenv.viz.scene import Origin, SceneRecord
from coopenv.viz.stage import Stage
from coopenv.viz.web.ground import Look, linear, placed, spacing_of
from coopenv.viz.web.page import write_replay
from coopenv.viz.web.panel import GAIN, table_html
from coopenv.viz.web.picture import FIELD_OF_VIEW, first_camera, first_look, level_lines, levels

msgspec = pytest.importorskip("msgspec", reason="needs the extra view")
zstandard = pytest.importorskip("zstandard", reason="needs the extra view")


def scene(name: str, **overrides: Any) -> SceneRecord:
    scenario = coopenv.load_scenario(name, {"horizon": 4.0, **overrides})
    return scene_of(Engine(scenario), Origin.of(name, scenario, seed=1))


@pytest.fixture(scope="module")
def overtaking() -> SceneRecord:
    return scene("overtaking", horizon=0.5)


def messages(page: str) -> tuple[float, list[tuple[float, dict[str, Any]]]]:
    """Return the length of the recording in a page, s, and its messages with their times."""
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found
    packed = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompress(packed[8:], max_output_size=int.from_bytes(packed[:8], "little"))
    length = int.from_bytes(inner[:8], "little")
    content = msgspec.msgpack.decode(inner[8 : 8 + length])
    return content["durationSeconds"], content["messages"]


def test_names_of_vehicles_that_are_close_stand_above_each_other() -> None:
    points = np.array([[0.0, 0], [1, 0], [9, 0], [1.5, 0], [np.nan, 0], [9, -0.5]])
    assert levels(points, 2.0).tolist() == [0, 1, 1, 2, 0, 0]


def test_a_page_holds_the_episode(tmp_path: Path) -> None:
    record = scene("urban_crossing", **{"observer.name": "robust"})
    shares: list[float] = []
    path = write_replay(record, tmp_path / "replay.html", shares.append)
    page = path.read_text(encoding="utf-8")
    length, told = messages(page)
    assert length == pytest.approx(record.length)
    times = [time for time, _ in told]
    assert times == sorted(times) and len(set(times)) == len(record)
    moved = {message["name"] for time, message in told if time > 0 and message["type"] == "SceneNodeUpdateMessage"}
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


@pytest.mark.parametrize("name", coopenv.list_envs())
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


def test_circles_of_protection_levels(overtaking: SceneRecord) -> None:
    """Of the picked vehicle, or of all; neither unknown levels nor circles beyond the scene are drawn."""
    frame = overtaking.frame(len(overtaking) - 1)
    n = len(frame.estimate_position)
    level = np.full((n, 2), np.inf)
    level[0], level[1] = (2.0, 0.1), (1e3, 0.1)
    frame = replace(frame, protection_level=level, estimate_position=np.arange(3.0 * n).reshape(n, 3))
    colours = np.arange(3 * n, dtype=np.uint8).reshape(n, 3)
    for look in (Look(picked=0), Look(levels=True)):
        points, shades = level_lines(frame, colours, look, 50.0, 0.5)
        assert points.shape == (32, 2, 3) and (shades == colours[0]).all() and (points[..., 2] == 0.5).all()
        np.testing.assert_allclose(np.linalg.norm(points[..., :2] - [0.0, 1.0], axis=-1), 2.0)
    assert not len(level_lines(frame, colours, Look(picked=1), 50.0, 0.5)[0])
    assert not len(level_lines(frame, colours, Look(), 50.0, 0.5)[0])


def test_table_with_protection_levels(overtaking: SceneRecord) -> None:
    frame = overtaking.frame(0)
    level = np.full((len(frame.estimate_position), 2), np.inf)
    assert "level" not in table_html(
        Stage(overtaking.scenario), overtaking.source, replace(frame, protection_level=level)
    )
    level[0] = 1.25, 0.1
    text = table_html(Stage(overtaking.scenario), overtaking.source, replace(frame, protection_level=level))
    assert "level [m]" in text and ">1.25</td>" in text and text.count(">-</td>") >= len(level) - 1
