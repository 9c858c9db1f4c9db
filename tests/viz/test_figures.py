"""What the figures say: the artists are read back and compared with the run they were drawn from."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D
from scipy.stats import chi2

from coopenv.errors import OutputError
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.trajectory import Sight, Trajectory
from coopenv.viz import consistency, style
from coopenv.viz.errors import error_figure
from coopenv.viz.figures import save_figures
from coopenv.viz.observability import observability_figure
from coopenv.viz.topology import topology_figure
from coopenv.viz.trajectories import trajectory_figure_2d, trajectory_figure_3d
from tests.synthetic import make_trajectory

NAMES = [
    "errors.png",
    "trajectories_2d.png",
    "trajectories_3d.png",
    "topology.png",
    "consistency.png",
    "observability.png",
]


@pytest.fixture(scope="module")
def run() -> Trajectory:
    return make_trajectory(noise=0.02)


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def spans(ax: Axes, colour: str) -> list[tuple[float, float]]:
    """Return (start, end) of the horizontal bars of one face colour, in order."""
    found: list[tuple[float, float]] = []
    for collection in ax.collections:
        faces = collection.get_facecolor()
        if isinstance(collection, PolyCollection) and np.array_equal(faces, mpl.colors.to_rgba_array(colour)):
            x = [np.asarray(path.vertices)[:, 0] for path in collection.get_paths()]
            found += [(values.min(), values.max()) for values in x]
    return sorted(found)


def xdata(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_xdata(), float)


def ydata(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_ydata(), float)


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.findobj(mpl.text.Text) if text.get_text()}


def test_all_figures_are_written_quickly_under_their_stable_names(run: Trajectory, tmp_path: Path) -> None:
    begin = time.process_time()
    paths = save_figures(run, tmp_path / "new" / "folder")
    assert time.process_time() - begin < 10.0
    assert [path.name for path in paths] == NAMES
    for path in paths:
        picture = imread(path)
        assert picture.shape[1] > 800 and picture.shape[0] > 500
        assert picture[..., :3].std() > 0.05  # not blank


@pytest.mark.parametrize("ticks", [1, 2, 40])
def test_short_runs_are_drawn(ticks: int, tmp_path: Path) -> None:
    assert len(save_figures(make_trajectory(ticks=ticks), tmp_path)) == len(NAMES)


def test_lost_observer_without_covariance_is_drawn(tmp_path: Path) -> None:
    run = make_trajectory(ticks=90)
    lost = np.where(run.t[:, None] > 1, np.nan, 1.0) * np.ones(5)
    run = dataclasses.replace(
        run,
        position_estimate=run.position_estimate * lost[..., None],
        position_error=run.position_error * lost,
        covariance=np.full_like(run.covariance, np.nan),
        nees=np.full_like(run.nees, np.nan),
    )
    assert len(save_figures(run, tmp_path)) == len(NAMES)
    assert "no covariance declared" in texts(consistency.consistency_figure(run))


def test_a_place_that_cannot_be_written_is_one_clear_error(run: Trajectory, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write figures"):
        save_figures(run, tmp_path / "file" / "folder")


def test_global_state_of_matplotlib_is_left_alone() -> None:
    code = (
        "import tempfile, matplotlib as mpl, matplotlib._pylab_helpers\n"
        "before = dict(mpl.rcParams)\n"
        "from tests.synthetic import make_trajectory\n"
        "from coopenv.viz.figures import save_figures\n"
        "save_figures(make_trajectory(ticks=20), tempfile.mkdtemp())\n"
        "assert dict(mpl.rcParams) == before\n"
        "assert not mpl._pylab_helpers.Gcf.figs\n"
    )
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root, timeout=120)


def test_error_figure_shows_the_errors_and_marks_settling_and_moving_targets(run: Trajectory) -> None:
    figure = error_figure(run)
    assert len(figure.axes) == 20  # five vehicles, two columns, linear and logarithmic
    linear, log = figure.axes[0], figure.axes[1]
    assert log.get_yscale() == "log"
    lines = [line for line in linear.lines if line.get_color() in style.AXES_COLOURS]
    error = run.position[:, 0] - run.position_estimate[:, 0]
    for line, component in zip(lines, error.T, strict=True):
        np.testing.assert_allclose(ydata(line), np.interp(xdata(line), run.t, component), atol=1e-12)
        assert xdata(line)[0] == run.t[0] and xdata(line)[-1] == run.t[-1]
    yaw = next(line for line in figure.axes[2].lines if line.get_color() == style.AXES_COLOURS[2])
    assert ydata(yaw)[0] == pytest.approx(90, abs=0.1)  # the synthetic start is a quarter turn about z
    assert spans(linear, style.SHADE) == [pytest.approx((21, 25), abs=0.05)]  # f1 sees f2
    settled = [x[0] for x in (xdata(line) for line in log.lines) if x[0] == x[1]]  # upright
    assert settled == [pytest.approx(np.log(90) / 1.2, abs=0.5)]
    assert {"position error\n[m]", "orientation error\n[deg]", "time [s]", "$f_{5}$"} <= texts(figure)


def test_a_run_that_does_not_settle_says_so(run: Trajectory) -> None:
    figure = error_figure(dataclasses.replace(run, position_error=run.position_error + 1.0))
    assert "not settled" in texts(figure)
    assert not any(text.startswith("settled at") for text in texts(figure))


def test_topology_bars_are_the_stretches_of_each_sight(run: Trajectory) -> None:
    figure = topology_figure(run)
    first, _, third, _, fifth = figure.axes
    assert [label.get_text() for label in first.get_yticklabels()] == ["SL1", "SL2", "SL3", "$f_{2}$"]
    assert [label.get_text() for label in fifth.get_yticklabels()] == ["$f_{1}$", "$f_{2}$", "$f_{4}$"]
    assert spans(first, style.GREY) == [pytest.approx((38, 50), abs=0.05)]  # SL3 leaves the view
    hatches = {c.get_hatch(): len(c.get_paths()) for c in third.collections if c.get_hatch()}
    assert len(hatches) == 2  # a building and a body hide, and look different
    drawn = sum(end - start for start, end in spans(first, style.BLUE))
    assert drawn == pytest.approx(run.visible[:, 0].sum() / 60, rel=1e-6)


def test_topology_shades_occlusion_by_a_moving_body_that_is_itself_unseen(run: Trajectory) -> None:
    sight = np.full_like(run.sight, Sight.NOT_A_NEIGHBOUR)
    sight[:, :, 0] = Sight.VISIBLE
    sight[600:900, 0, 0] = Sight.OCCLUDED_BY_BODY
    figure = topology_figure(dataclasses.replace(run, sight=sight, visible=sight == Sight.VISIBLE))
    assert spans(figure.axes[0], style.SHADE) == [pytest.approx((10, 15), abs=1e-6)]
    assert spans(figure.axes[1], style.SHADE) == []


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
    solid = [line for line in ax.lines if len(xdata(line)) > 1 and line.get_linestyle() == "-"]
    assert len(dotted) == len(solid) == 5
    np.testing.assert_allclose(ydata(dotted[0])[[0, -1]], run.position[[0, -1], 0, 1])
    np.testing.assert_allclose(ydata(solid[4])[[0, -1]], run.position_estimate[[0, -1], 4, 1])
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


def test_nees_bounds_are_the_central_95_percent_of_six_dof() -> None:
    draws = chi2(6).rvs(200_000, random_state=np.random.default_rng(0))
    low, high = consistency.NEES_BOUNDS
    assert np.mean(draws < low) == pytest.approx(0.025, abs=0.002)
    assert np.mean(draws > high) == pytest.approx(0.025, abs=0.002)


def test_consistency_shows_the_share_of_ticks_inside_and_the_claimed_deviation(run: Trajectory) -> None:
    nees = np.full_like(run.nees, 6.0)
    nees[: len(nees) // 4] = 100.0
    figure = consistency.consistency_figure(dataclasses.replace(run, nees=nees))
    assert sum("75 % of ticks inside" in text for text in texts(figure)) == 1  # equal notes, one set member
    error, claimed = figure.axes[1].lines
    assert ydata(error)[0] == pytest.approx(run.position_error[0, 0])
    assert ydata(claimed)[0] == pytest.approx(np.sqrt(3) * (6 + 0.02 + 1e-3))
    degrees = ydata(figure.axes[2].lines[1])[0]
    assert degrees == pytest.approx(np.degrees(np.sqrt(3) * (1 + np.radians(0.02) + 1e-4)))


def test_observability_figure_shows_threshold_and_verdict(run: Trajectory) -> None:
    result = analyse_observability(run, threshold=2e-3)
    figure = observability_figure(result)
    local, _, verdict = figure.axes
    threshold = [line for line in local.lines if line.get_label() == "threshold"]
    assert ydata(threshold[0])[0] == 2e-3
    drawn = sum(end - start for start, end in spans(verdict, style.GREEN))
    expected = sum(i.end - i.start for v in range(5) for i in result.intervals(v) if i.observable)
    assert drawn == pytest.approx(expected)
    assert 0 < expected < 250


def test_runs_cover_each_tick_until_the_next() -> None:
    t = np.array([0.0, 1.0, 3.0, 4.0])
    assert style.runs(t, np.array([True, True, False, True])) == [(0.0, 3.0), (4.0, 1.0)]
    assert style.runs(t, np.zeros(4, bool)) == []


def test_thinning_keeps_both_ends_and_short_records_whole() -> None:
    assert style.thinned(10).tolist() == list(range(10))
    long = style.thinned(100_000)
    assert len(long) <= style.MAX_POINTS and long[0] == 0 and long[-1] == 99_999
