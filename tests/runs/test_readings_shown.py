"""Pictures, films, logs and the first screen of a run show sensors beside the camera."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from coopenv.episode import Episode
from coopenv.runs.recorder import record_episode
from coopenv.runs.summary import facts
from coopenv.scenario import Scenario
from coopenv.viz.stage import Stage
from coopenv.viz.topview import TopView
from coopenv.viz.view3d import View3d
from tests.helpers.builders import circling, scenario

OTHERS = [["L1", "L2", "vehicle_2"], ["L1", "vehicle_1", "vehicle_3"], ["L3", "vehicle_1"]]
PLACE = (0.2, 0.0, 0.4)


@cache
def described(with_sensors: bool = True) -> Scenario:
    ranges = {"kind": "range", "towards": ["L1", "vehicles"], "vehicles": ["vehicle_1", "vehicle_2"], "rate": 20.0}
    sensors = [{**ranges, "position": PLACE, "range": 40.0}, {"kind": "position", "noise": [1.0, 1.0, 2.0]}]
    given = {"sensors": sensors if with_sensors else [], "topology": {"acyclic": False}}
    return scenario(circling(OTHERS), horizon=0.5, **given)


@cache
def episode(with_sensors: bool = True) -> Episode:
    return record_episode(described(with_sensors), seed=3)


def test_lines_go_from_the_sensor_to_measured_targets_until_the_next_measurement() -> None:
    stage, made = Stage(described()), episode()
    frame = made.frame(4)  # measurements of 20 Hz are those of tick 3
    vehicles, lines = stage.reading_lines(frame)
    measured = np.isfinite(made.measured.readings["range"][3]).all(axis=-1)
    expected, targets = np.nonzero(measured)
    vehicles, lines = vehicles[: len(expected)], lines[: len(expected)]  # crosses of the second sensor follow
    assert_array_equal(vehicles, expected)
    assert_allclose(lines[:, 0], [frame.position[i] + frame.rotation[i] @ PLACE for i in expected])
    assert_allclose(lines[:, 1], stage.targets(frame)[targets])
    view = TopView(described())
    drawn = view.paint(frame)
    assert (drawn != view.paint(replace(frame, reading_tick=None))).any()


def test_a_measured_position_is_a_cross_on_its_sensor() -> None:
    """Four arms of one size, in plan, from the antenna to the corners of a square, while there is a measurement."""
    frame = episode().frame(4)
    ticks = frame.reading_tick
    assert ticks is not None
    ticks[:, 0], ticks[1, 1] = -1, 1  # no ranges; the second vehicle has lost its satellites
    vehicles, lines = Stage(described()).reading_lines(replace(frame, reading_tick=ticks))
    assert_array_equal(vehicles, [0, 2] * 4)
    assert_allclose(lines[:, 1], frame.position[vehicles])
    arms = (lines[:, 0] - lines[:, 1]).reshape(4, 2, 3)
    assert_allclose(np.abs(arms), np.broadcast_to(np.abs(arms[0, 0]), arms.shape))
    assert_allclose(arms.sum(axis=0), 0.0, atol=1e-12)
    assert_allclose(np.abs(arms[0, 0, :2]), arms.max())
    assert (arms[..., 2] == 0.0).all() and arms.max() > 0.1


def test_a_position_that_is_less_accurate_than_the_scene_is_large_has_no_cross() -> None:
    """As the height of a road, which says nothing of the place in plan."""
    height = {"kind": "position", "noise": [1e3, 1e3, 0.1]}
    blurred = scenario(circling(OTHERS), horizon=0.5, sensors=[height], topology={"acyclic": False})
    frame = record_episode(blurred, seed=3).frame(4)
    assert frame.reading_tick is not None and (frame.reading_tick[:, 0, 0] == 4).all()
    assert len(Stage(blurred).reading_lines(frame)[0]) == 0


def test_films_in_3d_show_measurements() -> None:
    pytest.importorskip("pyvista", reason="needs the extra film3d")
    view, frame = View3d(described(), (320, 240)), episode().frame(4)
    with_lines = view.paint(frame).copy()
    assert (with_lines != view.paint(replace(frame, reading_tick=None))).any()


def test_scenes_keep_which_targets_were_measured(tmp_path: Path) -> None:
    episode().save(tmp_path / "scene.npz")
    again = Episode.load(tmp_path / "scene.npz")
    assert_array_equal(again["reading_tick"], episode()["reading_tick"])
    stage = Stage(described())
    assert_allclose(stage.reading_lines(again.frame(4))[1], stage.reading_lines(episode().frame(4))[1], atol=1e-5)


def test_scenes_without_sensors_hold_nothing_about_them(tmp_path: Path) -> None:
    episode(False).save(tmp_path / "scene.npz")
    with np.load(tmp_path / "scene.npz") as arrays:
        assert "reading_tick" not in arrays.files
    again = Episode.load(tmp_path / "scene.npz").frame(4)
    assert again.reading_tick is None
    assert len(Stage(described(False)).reading_lines(again)[0]) == 0


def test_a_log_for_foxglove_has_a_line_for_every_measured_range() -> None:
    pytest.importorskip("foxglove", reason="needs the extra log")
    from coopenv.foxglove.log_views import views

    topics = {view.topic: view for view in views(episode())}
    size = {k: len(data) for k, data in topics["/scene/readings"].messages}
    nothing = replace(episode(), recording=replace(episode().measured, readings={
        name: np.full_like(values, np.nan) for name, values in episode().measured.readings.items()
    }))  # fmt: skip
    silent = {view.topic: view for view in views(nothing)}
    assert all(len(data) < size[k] for k, data in silent["/scene/readings"].messages)
    assert "/scene/readings" not in {view.topic for view in views(episode(False))}


def test_the_first_screen_names_sensors() -> None:
    words = facts(described())["Sensors"]
    first, second = words.split("; ")
    assert (first, second) == ("range to L1 and vehicles", "position")
    assert "Sensors" not in facts(described(False))
