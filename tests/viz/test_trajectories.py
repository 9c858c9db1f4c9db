"""The paths in plan and in space: the artists are read back and compared with the run they were drawn from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import proj3d

import coopenv
from coopenv.estimation.observability import Trajectory
from coopenv.viz import style
from coopenv.viz.trajectories import clipped, trajectory_figure_2d, trajectory_figure_3d
from tests.helpers.drawn import texts, xdata, ydata
from tests.helpers.four_way import FOUR_WAY


def test_starts_of_truth_and_estimate_are_told_apart(run: Trajectory) -> None:
    figure = trajectory_figure_2d(run)
    handles = {str(line.get_label()): line for line in figure.legends[0].get_lines()}
    true, first = handles["true start"], handles["first estimate"]
    assert (true.get_markeredgecolor(), first.get_markeredgecolor()) == (style.INK, style.GREY)
    drawn = {line.get_markeredgecolor() for line in figure.axes[0].lines if line.get_marker() == "^"}
    assert style.INK in drawn and style.vehicle_colour(0) in drawn


@pytest.mark.parametrize("draw", [trajectory_figure_2d, trajectory_figure_3d])
def test_a_far_initial_estimate_does_not_change_the_frame(
    draw: Callable[[Trajectory], Figure], run: Trajectory
) -> None:
    estimate = run.position_estimate.copy()
    estimate[:60, 0] += [500.0, -300.0, 80.0]
    far = dataclasses.replace(run, position_estimate=estimate)
    near_figure, far_figure = draw(run), draw(far)
    for limits in ("get_xlim", "get_ylim"):
        assert getattr(near_figure.axes[0], limits)() == getattr(far_figure.axes[0], limits)()
    in_legend = ["starts outside" in texts(f) for f in (near_figure, far_figure)]
    assert in_legend == [False, True]


def test_plan_is_to_scale_and_shows_truth_dotted_and_estimate_solid(run: Trajectory) -> None:
    figure = trajectory_figure_2d(run)
    figure.canvas.draw()
    ax = figure.axes[0]
    box = ax.get_window_extent()
    metres = np.diff(ax.get_xlim())[0], np.diff(ax.get_ylim())[0]
    assert box.width / metres[0] == pytest.approx(box.height / metres[1], rel=1e-6)
    dotted = [line for line in ax.lines if line.get_color() == style.INK and line.get_linestyle() == "--"]
    solid = [line for line in ax.lines if len(xdata(line)) > 1 and line.get_linewidth() == 1.6]
    assert len(dotted) == len(solid) == 5
    np.testing.assert_allclose(ydata(dotted[0])[[0, -1]], run.position[[0, -1], 0, 1])
    np.testing.assert_allclose(ydata(solid[4])[-1], run.position_estimate[-1, 4, 1])
    thin = [line for line in ax.lines if len(xdata(line)) > 1 and line.get_linewidth() == 0.7]
    np.testing.assert_allclose(ydata(thin[4])[0], run.position_estimate[0, 4, 1])
    np.testing.assert_allclose(ydata(thin[4])[-1], ydata(solid[4])[0])  # one goes on where the other ends
    assert {"SL1", "SL2", "SL3", "x [m]", "y [m]"} <= texts(figure)


def test_moving_landmark_has_a_path_and_its_own_label(run: Trajectory) -> None:
    target_position, moving = run.target_position.copy(), run.target_moving.copy()
    target_position[:, 2, 0] += 0.2 * run.t
    moving[2] = True
    figure = trajectory_figure_2d(dataclasses.replace(run, target_position=target_position, target_moving=moving))
    assert "ML3" in texts(figure) and "SL3" not in texts(figure)
    paths = [x for x in figure.axes[0].lines if x.get_color() == style.DARK_BLUE and len(xdata(x)) > 1]
    assert len(paths) == 1
    assert xdata(paths[0])[-1] - xdata(paths[0])[0] == pytest.approx(10.0)


def test_space_has_one_scale_on_all_axes(run: Trajectory) -> None:
    ax = trajectory_figure_3d(run).axes[0]
    extent = [np.diff(limits())[0] for limits in (ax.get_xlim, ax.get_ylim, ax.get_zlim)]  # type: ignore[attr-defined]
    np.testing.assert_allclose(np.ptp(extent / ax._box_aspect), 0, atol=1e-9)  # type: ignore[attr-defined]


def test_space_shows_estimates_below_the_ground(run: Trajectory) -> None:
    height = np.array([0.0, 0.0, 2.0])
    ground = dataclasses.replace(
        run,
        position=run.position * [1, 1, 0],
        target_position=run.target_position * [1, 1, 0] + height,
        position_estimate=run.position * [1, 1, 0] + [0, 0, -0.4],
    )
    ax: Any = trajectory_figure_3d(ground).axes[0]
    assert -1.5 < ax.get_zlim()[0] < -0.4
    solid = [x.get_data_3d() for x in ax.lines if x.get_linewidth() == 1.6]
    assert len(solid) == 5
    assert all(np.isfinite(path).all() and path[2].min() == pytest.approx(-0.4) for path in map(np.array, solid))
    above = dataclasses.replace(ground, position_estimate=ground.position + height / 5)
    assert trajectory_figure_3d(above).axes[0].get_zlim()[0] == 0.0  # type: ignore[attr-defined]


def test_lines_are_cut_at_the_sides_of_a_box() -> None:
    path = np.array([(0.5, 0.5), (0.5, 2.5), (0.8, 2.5), (0.8, 0.5), (0.2, 0.5), (np.nan, 0.5), (0.1, 0.1), (0.1, 0.2)])
    x = [0.5, 0.5, np.nan, 0.8, 0.8, 0.2, np.nan, 0.1, 0.1]
    y = [0.5, 1.0, np.nan, 1.0, 0.5, 0.5, np.nan, 0.1, 0.2]
    np.testing.assert_allclose(clipped(path, np.zeros(2), np.ones(2)), np.column_stack([x, y]))
    through = clipped(np.array([(-1.0, 0.5), (1e30, 0.5)]), np.zeros(2), np.ones(2))
    np.testing.assert_allclose(through[:, 0], [0, 1], atol=1e-9)
    assert len(clipped(np.array([(5.0, 5.0), (6.0, 6.0)]), np.zeros(2), np.ones(2))) == 0
    assert len(clipped(np.array([(0.5, 0.5)]), np.zeros(2), np.ones(2))) == 1


def test_names_keep_off_marks_and_each_other() -> None:
    point = style.DPI / 72.0
    anchors = np.array([(100.0, 100.0), (104.0, 100.0)])
    marks = np.vstack([anchors, [(115.0, 110.0)]])
    offsets = style.place_names(["SL1", "$f_{2}$"], anchors, marks, np.empty((0, 2)), 10.0)
    low = anchors / point + offsets
    extent = np.array([(0.62 * 3, 0.95), (0.62 * 2, 0.95)]) * 10.0
    for corner, size in zip(low, extent, strict=True):
        assert not np.any(np.all((marks / point > corner) & (marks / point < corner + size), axis=-1))
    assert np.any((low[0] >= low[1] + extent[1]) | (low[1] >= low[0] + extent[0]))
    assert style.place_names(["A"], anchors[:1], anchors[:1], np.empty((0, 2)), 10.0).tolist() == [[5.0, 5.0]]


@pytest.mark.parametrize("draw", [trajectory_figure_2d, trajectory_figure_3d])
def test_no_name_covers_the_end_of_a_vehicle(draw: Callable[[Trajectory], Figure], run: Trajectory) -> None:
    figure = draw(run)  # SL1 at (-4, 5), the end of f2 at (-2, 6)
    figure.canvas.draw()
    ax = figure.axes[0]
    ends = [x for x in ax.lines if x.get_marker() in ("x", "X")]
    assert len(ends) == 10
    names = [text for text in ax.texts if text.get_text() in ("SL1", "SL2", "SL3", *(f"$f_{{{i}}}$" for i in range(6)))]
    assert len(names) == 13  # a vehicle at both ends of its path
    for end in ends:
        if draw is trajectory_figure_3d:
            x, y, _ = proj3d.proj_transform(*(v[0] for v in end.get_data_3d()), ax.get_proj())  # type: ignore[attr-defined]
        else:
            x, y = xdata(end)[0], ydata(end)[0]
        place = ax.transData.transform((x, y))
        assert not any(name.get_window_extent().contains(*place) for name in names)


def test_plan_shows_roads_and_buildings_of_a_scenario(run: Trajectory) -> None:
    scenario = coopenv.load_scenario(FOUR_WAY)
    figure = trajectory_figure_2d(run, scenario=scenario)
    assert len(figure.axes[0].patches) == len(scenario.roads) + len(scenario.obstacles)
    assert {"road", "building"} <= texts(figure)
    assert not {"road", "building"} & texts(trajectory_figure_2d(run))
