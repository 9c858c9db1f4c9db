"""Who sees whom: bars, shades and words are read back and compared with the run they were drawn from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from coopenv.estimation.outcomes import Sight
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style
from coopenv.viz.error_figures import error_figure
from coopenv.viz.figures import topology_figure
from tests.helpers.drawn import spans, texts


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


def test_a_fixed_topology_is_told_in_words(run: Trajectory) -> None:
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
