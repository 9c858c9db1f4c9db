"""Figures: their artists are read back and compared with the run that they show."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib._pylab_helpers import Gcf
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d import proj3d
from scipy.stats import chi2

import coopenv
from coopenv.estimation import Sight
from coopenv.estimation.metrics import summarise
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import FIGURE_NAMES, error_figures, style
from coopenv.viz.error_figures import error_figure, observability_figure, unwrapped
from coopenv.viz.figures import draw_figure, save_figures, topology_figure
from coopenv.viz.trajectories import clipped, trajectory_figure_2d, trajectory_figure_3d
from tests.helpers.drawn import spans, texts, xdata, ydata
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.synthetic import make_trajectory

NAMES = [f"{name}.png" for name in FIGURE_NAMES]
ENDS = [50.0, 20.0, 50.0, 50.0, 50.0]


def test_the_shortest_run_is_drawn_with_a_note(unwritten: list[Figure], tmp_path: Path) -> None:
    """Under stable names; files as a user gets them are read in tests/test_cli.py."""
    paths = save_figures(make_trajectory(ticks=1), tmp_path / "new" / "folder", note="overtaking, robust, seed 3")
    assert [path.name for path in paths] == NAMES
    assert all(figure.get_supxlabel().endswith("overtaking, robust, seed 3") for figure in unwritten)
    assert len(unwritten) == len(NAMES)


@pytest.mark.usefixtures("unwritten")
def test_lost_observers_are_drawn(tmp_path: Path) -> None:
    """One that states no covariance is lost after 1 s, and five are lost from the start."""
    run = make_trajectory(ticks=90)
    lost = np.where(run.t[:, None] > 1, np.nan, 1.0) * np.ones(5)
    late = dataclasses.replace(
        run,
        position_estimate=run.position_estimate * lost[..., None],
        position_error=run.position_error * lost,
        covariance=np.full_like(run.covariance, np.nan),
        nees=np.full_like(run.nees, np.nan),
    )
    assert len(save_figures(late, tmp_path)) == len(NAMES)
    assert "no covariance declared" in texts(error_figures.consistency_figure(late))
    fields = ("position_estimate", "rotation_estimate", "position_error", "orientation_error", "covariance", "nees")
    arrays = {name: np.empty_like(getattr(run, name)) for name in fields}
    for array in arrays.values():
        np.moveaxis(array, 1, -1)[:] = np.nan, np.inf, 1e300, np.nan, 1e300
    run = dataclasses.replace(run, **arrays)
    assert len(save_figures(run, tmp_path, ends=[0.0, 0.5, np.nan, 1.0, 1.5])) == len(NAMES)
    assert all("no rate to fit" in row["rate_remark"] for row in summarise(run, 0.5))


def test_global_state_of_matplotlib_is_left_alone(tmp_path: Path) -> None:
    """Also at the import, which tests/viz/test_topview.py does in a process of its own."""
    before, shown = dict(mpl.rcParams), {*Gcf.figs}
    style.save(draw_figure("trajectories_3d", make_trajectory(ticks=20)), tmp_path / "f.png")
    assert dict(mpl.rcParams) == before and {*Gcf.figs} == shown


def test_error_figure_shows_the_errors_and_marks_settling_and_moving_targets(run: Trajectory) -> None:
    figure = error_figure(run)
    assert len(figure.axes) == 10  # five vehicles, position and orientation
    position, orientation = figure.axes[0], figure.axes[1]
    assert {ax.get_yscale() for ax in figure.axes} == {"symlog"}
    lines = [x for x in position.lines if x.get_color() in style.AXES_COLOURS and len(xdata(x)) > 1]
    error = run.position[:, 0] - run.position_estimate[:, 0]
    for line, component in zip(lines, error.T, strict=True):
        near = np.abs(run.t - xdata(line)[:, None]).argmin(axis=1)
        assert np.abs(ydata(line) - component[near]).max() < 0.3  # the steepest fall within a stretch
        assert ydata(line)[-1] == pytest.approx(np.median(component[-60:]), abs=0.02)
    dots = [x for x in position.lines if x.get_color() in style.AXES_COLOURS and len(xdata(x)) == 1]
    assert [ydata(dot)[0] for dot in dots] == pytest.approx(error[0].tolist())
    yaw = [x for x in orientation.lines if x.get_color() == style.AXES_COLOURS[2] and len(xdata(x)) == 1]
    assert ydata(yaw[0])[0] == pytest.approx(90, abs=0.1)  # the synthetic start is a quarter turn about z
    assert spans(position, style.SHADE) == [pytest.approx((21, 25), abs=0.05)]  # f1 sees f2
    settled = [x[0] for x in map(xdata, position.lines) if len(x) == 2 and x[0] == x[1]]  # upright
    assert settled == [pytest.approx(np.log(90) / 1.2, abs=0.5)]
    assert {"position error [m]", "orientation error [deg]", "time [s]", "$f_{5}$"} <= texts(figure)


def test_vehicles_share_an_ordinate_that_is_linear_where_errors_end(run: Trajectory) -> None:
    for column in (error_figure(run).axes[::2], error_figure(run).axes[1::2]):
        assert len({ax.get_ylim() for ax in column}) == 1
        (linear,) = {ax.yaxis.get_transform().linthresh for ax in column}  # type: ignore[attr-defined]
        assert linear == pytest.approx(0.1, rel=0.01)  # of noise of 0.02


def test_dense_noise_is_a_line_of_medians_in_a_band() -> None:
    t, noise = np.linspace(0, 40, 2401), np.random.default_rng(1).standard_normal(2401)
    middle, median, low, high = style.summed_up(t, noise, 60)
    assert len(middle) == pytest.approx(60, abs=2)
    assert np.abs(median).max() < 1.0 < np.abs(noise).max()
    assert np.mean(high - low) == pytest.approx(2.56, abs=0.3)  # from the 10th to the 90th percentile
    assert style.summed_up(t[:50], noise[:50], 60)[1].tolist() == noise[:50].tolist()
    gone = style.summed_up(t, np.full(2401, np.nan), 60)[1]
    assert np.isnan(gone).all()


def test_angles_do_not_jump_by_whole_turns_and_end_near_zero() -> None:
    angle = np.linspace(0.0, 540.0, 400)[:, None] * [1.0, -1.0, 0.0] + [0.0, 0.0, 179.0]
    angle[:, 2] += np.where(np.arange(400) % 2, 2.0, 0.0)
    wrapped = (angle + 180.0) % 360.0 - 180.0
    wrapped[100:110] = np.nan
    smooth = unwrapped(wrapped)
    assert np.isnan(smooth[100:110]).all()
    steps = np.abs(np.diff(smooth, axis=0))
    assert np.nanmax(steps) < 3.0 < 300.0 < np.nanmax(np.abs(np.diff(wrapped, axis=0)))
    np.testing.assert_allclose(np.nanmax(np.abs((smooth - wrapped + 180.0) % 360.0 - 180.0)), 0.0, atol=1e-9)
    assert np.all(np.abs(np.nanmedian(smooth[280:], axis=0)) <= 181.0)


def test_what_is_so_all_the_time_is_not_shaded_and_a_run_that_does_not_settle_says_so(run: Trajectory) -> None:
    visible = run.visible.copy()
    visible[:, 0, 4] = True
    figure = error_figure(dataclasses.replace(run, visible=visible, position_error=run.position_error + 1.0))
    assert spans(figure.axes[0], style.SHADE) == []
    assert "above to the end" in texts(figure)
    assert not any(text.startswith("last above 0.1 m") for text in texts(figure))


@pytest.mark.parametrize("dof", [3, 6])
def test_nees_bounds_are_the_central_95_percent(dof: int) -> None:
    draws = chi2(dof).rvs(200_000, random_state=np.random.default_rng(0))
    low, high = error_figures.nees_bounds(dof)
    assert np.mean(draws < low) == pytest.approx(0.025, abs=0.002)
    assert np.mean(draws > high) == pytest.approx(0.025, abs=0.002)


def test_consistency_shows_the_share_of_ticks_inside_and_the_claimed_deviation(run: Trajectory) -> None:
    nees = np.full_like(run.nees, 6.0)
    nees[: len(nees) // 4] = 100.0
    figure = error_figures.consistency_figure(dataclasses.replace(run, nees=nees), steady_from=0.0)
    assert sum("75 % of ticks inside" in text for text in texts(figure)) == 1  # equal notes, one set member
    claimed, error = figure.axes[1].lines
    assert ydata(error)[0] == pytest.approx(run.position_error[0, 0])
    deviation, turn = 6 + 0.02 + 1e-3, 1 + np.radians(0.02) + 1e-4  # per axis
    lever = np.linalg.norm(run.position_estimate[0, 0])  # from the map's origin: P is about R^T p
    assert ydata(claimed)[0] == pytest.approx(np.sqrt(3 * deviation**2 + 2 * (lever * turn) ** 2))
    degrees = ydata(figure.axes[2].lines[0])[0]
    assert degrees == pytest.approx(np.degrees(np.sqrt(3) * turn))


def test_mean_nees_is_the_one_of_the_table(run: Trajectory) -> None:
    shown = texts(error_figures.consistency_figure(run, steady_from=30.0))
    for row in summarise(run, 30.0):
        assert any(text.startswith(f"after 30 s: mean {row['mean_nees']:.3g}, ") for text in shown)
    assert any(text.startswith("after 35 s: mean ") for text in texts(error_figures.consistency_figure(run)))
    late = error_figures.consistency_figure(run, ends=ENDS, steady_from=30.0)
    assert "ended before the steady state (30 s)" in texts(late)


def test_lines_stop_where_a_vehicle_ends(run: Trajectory) -> None:
    errors = error_figure(run, ENDS)
    for panel in errors.axes[2:4]:
        assert max(xdata(x)[-1] for x in panel.lines if len(xdata(x)) > 2) == pytest.approx(20.0, abs=0.5)
        assert spans(panel, style.ENDED) == [pytest.approx((20.0, 50.0))]
    assert all(spans(panel, style.ENDED) == [] for panel in errors.axes[:2])
    topology = topology_figure(run, ENDS)
    bars = [x for c in topology.axes[1].collections[2:] for p in c.get_paths() for x in np.asarray(p.vertices)[:, 0]]
    assert max(bars) == pytest.approx(20.0, abs=0.02)
    assert spans(topology.axes[1], style.ENDED) == [pytest.approx((20.0, 50.0))]
    seen = run.visible[run.t <= 20.0, 1].sum() / 1201
    assert any(f"{seen:.2f} targets in view on average" in text for text in texts(topology))
    nees = error_figures.consistency_figure(run, ENDS).axes[3]
    assert max(xdata(x)[-1] for x in nees.lines if len(xdata(x)) > 2) == pytest.approx(20.0)
    local, verdict = observability_figure(analyse_observability(run), ENDS).axes
    assert xdata(local.lines[1])[-1] == pytest.approx(19.0)
    assert max(p.vertices[:, 0].max() for c in verdict.collections for p in c.get_paths()) == pytest.approx(50.0)
    plan = trajectory_figure_2d(run, ENDS).axes[0]
    dotted = [x for x in plan.lines if x.get_color() == style.INK and len(xdata(x)) > 1]
    assert ydata(dotted[1])[-1] == pytest.approx(run.position[1200, 1, 1])
    for figure in (errors, topology, error_figures.consistency_figure(run, ENDS)):
        assert "ended, parked" in texts(figure)
    for draw in (error_figure, topology_figure, error_figures.consistency_figure):
        assert "ended, parked" not in texts(draw(run))


def test_legends_list_only_what_occurs(run: Trajectory) -> None:
    assert {"a frame missed", "occluded by a building", "out of view", "moving target involved"} <= texts(
        topology_figure(run)
    )
    sight = np.where(run.sight == Sight.NOT_A_NEIGHBOUR, Sight.NOT_A_NEIGHBOUR, Sight.OUT_OF_VIEW)
    blind = dataclasses.replace(run, sight=sight, visible=np.zeros_like(run.visible))
    shown = texts(topology_figure(blind))
    assert any("never in view" in text for text in shown)
    assert not {"visible", "a frame missed", "occluded by a building", "moving target involved"} & shown
    assert "moving target detected" not in texts(error_figure(blind))
    assert "not observable" not in texts(observability_figure(analyse_observability(run, threshold=0.0)))
    without = trajectory_figure_2d(dataclasses.replace(run, target_moving=np.ones(8, bool)))
    assert "landmark" not in texts(without) and "moving landmark" in texts(without)


@pytest.mark.parametrize("values", [(120.0, 180.0), (0.02, 0.1), (3.0, 3.0), (1e-3, 2e5)])
def test_axes_show_two_decades_and_no_labels_between(values: tuple[float, float]) -> None:
    figure = style.new_figure(3, 2)
    ax = figure.add_subplot()
    ax.set_yscale("log")
    ax.plot([0, 1], values)
    style.show_decades(ax)
    figure.canvas.draw()
    low, high = ax.get_ylim()
    assert sum(low <= 10.0**k <= high for k in range(-5, 7)) >= 2
    assert low <= values[0] and values[1] <= high
    assert all(not text.get_text() for text in ax.get_yticklabels(minor=True))


def test_observability_figure_shows_threshold_and_verdict(run: Trajectory) -> None:
    result = analyse_observability(run, threshold=2e-3)
    figure = observability_figure(result)
    local, verdict = figure.axes
    assert ydata(local.lines[-1]).tolist() == [2e-3, 2e-3]
    assert "threshold" in texts(figure)
    assert local.get_ylim()[0] < 2e-3 < local.get_ylim()[1]
    low = observability_figure(analyse_observability(run, threshold=1e-7)).axes[0].get_ylim()[0]
    assert low < 1e-7
    drawn = sum(end - start for start, end in spans(verdict, style.GREEN))
    expected = sum(i.end - i.start for v in range(5) for i in result.intervals(v) if i.observable)
    assert drawn == pytest.approx(expected)
    assert 0 < expected < 250


@pytest.mark.parametrize(
    "names", [["short"], ["a_rather_long_name"] * 10, ["a", "much_longer_than_the_others", "b", "c"]]
)
def test_a_legend_stays_within_its_figure(names: list[str]) -> None:
    figure, width = style.canvas(5.2, 3.9, "")
    figure.subplots()
    style.legend_above(figure, [Line2D([], [], marker="o", label=name) for name in names])
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert 0.0 <= box.x0 < box.x1 <= width * figure.dpi


def test_topology_bars_are_the_stretches_of_each_sight(run: Trajectory) -> None:
    figure = topology_figure(run)
    first, _, third, _, _ = figure.axes
    changing = [label.get_text() for label in first.get_yticklabels()]
    assert changing == ["SL2", "SL3", "$f_{2}$"]
    assert any("always visible: SL1" in text.replace("\n", " ") for text in texts(figure))
    assert spans(first, style.GREY) == [pytest.approx((38, 50), abs=0.05)]  # SL3 leaves the view
    hatches = {c.get_hatch(): len(c.get_paths()) for c in third.collections if c.get_hatch()}
    assert len(hatches) == 2  # a building and a body hide, and look different
    drawn = sum(end - start for start, end in spans(first, style.BLUE))
    assert drawn == pytest.approx(run.visible[:, 0][:, [1, 2, 4]].sum() / 60, rel=0.02)


def test_a_fixed_topology_is_described_in_words(run: Trajectory) -> None:
    neighbours = np.any(run.sight != Sight.NOT_A_NEIGHBOUR, axis=0)
    sight = np.where(neighbours, Sight.VISIBLE, np.zeros_like(run.sight))
    fixed = topology_figure(dataclasses.replace(run, sight=sight, visible=sight == Sight.VISIBLE))
    assert not any(ax.collections or ax.lines for ax in fixed.axes)
    assert not any(ax.axison for ax in fixed.axes)
    assert float(fixed.get_figheight()) < 0.7 * float(topology_figure(run).get_figheight())


def test_topology_shades_occlusion_by_a_moving_body_that_is_itself_unseen(run: Trajectory) -> None:
    sight = np.full_like(run.sight, Sight.NOT_A_NEIGHBOUR)
    sight[:, :, 0] = Sight.VISIBLE
    sight[600:900, 0, 0] = Sight.OCCLUDED_BY_BODY
    sight[600:900, 1, 0] = Sight.OUT_OF_VIEW
    figure = topology_figure(dataclasses.replace(run, sight=sight, visible=sight == Sight.VISIBLE))
    assert spans(figure.axes[0], style.SHADE) == [pytest.approx((10, 15), abs=1e-6)]
    assert spans(figure.axes[1], style.SHADE) == []


def test_a_missed_frame_leaves_no_line_in_the_shade(run: Trajectory) -> None:
    visible = run.visible.copy()
    visible[:, 0] = False
    visible[600:900, 0, 4] = True
    visible[700:703, 0, 4] = visible[800:803, 0, 4] = False
    sight = np.where(visible, Sight.VISIBLE, np.where(run.sight == Sight.VISIBLE, Sight.MISSED, run.sight))
    sight[:, 0][sight[:, 0] == Sight.OCCLUDED_BY_BODY] = Sight.MISSED
    missing = dataclasses.replace(run, visible=visible, sight=sight)
    for figure in (error_figure(missing), topology_figure(missing)):
        assert spans(figure.axes[0], style.SHADE) == [pytest.approx((10, 15), abs=1e-6)]
    bars = spans(topology_figure(missing).axes[0], style.BLUE)
    assert pytest.approx((10, 15), abs=1e-6) in bars  # a frame missed does not cut a bar


def test_runs_cover_each_tick_until_the_next() -> None:
    t = np.array([0.0, 1.0, 3.0, 4.0])
    assert style.runs(t, np.array([True, True, False, True])) == [(0.0, 3.0), (4.0, 1.0)]
    assert style.runs(t, np.zeros(4, bool)) == []
    assert style.runs(t, np.zeros(4, bool), 1.0) == []
    assert style.runs(t, np.array([True, False, True, False]), 2.0) == [(0.0, 4.0)]
    assert style.runs(t, np.array([True, False, True, False]), 1.9) == [(0.0, 1.0), (3.0, 1.0)]


def test_starts_of_truth_and_estimate_are_distinguished(run: Trajectory) -> None:
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
