"""Does the observer know how wrong it is? NEES with chi-square bounds, and errors beside uncertainties."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.stats import chi2

from coopenv.estimation.metrics import STEADY_SHARE, live_ticks, steady_mean
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style

DEGREES_OF_FREEDOM = 6
NEES_BOUNDS = (float(chi2.ppf(0.025, DEGREES_OF_FREEDOM)), float(chi2.ppf(0.975, DEGREES_OF_FREEDOM)))
"""95 % of the NEES of a consistent observer lie between these, at one instant over many runs."""

_ROW, _HEAD, _FOOT = 1.45, 0.6, 0.5  # inches


def consistency_figure(
    trajectory: Trajectory, ends: Sequence[float] | None = None, steady_from: float | None = None
) -> Figure:
    """Draw, per vehicle, NEES, and both errors beside the standard deviations that the observer claims.

    The bounds hold at each instant over many runs; the ticks of one run are correlated, so the share of ticks
    inside is a hint, not a test.

    Args:
        trajectory: the record of a run.
        ends: s, when each vehicle was parked, after which nothing counts.
        steady_from: s; the mean NEES and the share inside are over the ticks after it (None: `STEADY_SHARE` of
            the record).
    """
    if steady_from is None:
        steady_from = STEADY_SHARE * float(trajectory.t[-1])
    count = len(trajectory.vehicles)
    height = _HEAD + _FOOT + _ROW * count
    figure = style.new_figure(10.5, height)
    edges = {"left": 0.085, "right": 0.985, "bottom": _FOOT / height, "top": 1 - _HEAD / height}
    axes = figure.add_gridspec(count, 3, wspace=0.2, hspace=0.16, **edges).subplots(squeeze=False)
    variance = np.diagonal(np.asarray(trajectory.covariance, float), axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):  # of an observer that has diverged
        spread = np.sqrt(variance.reshape(-1, count, 2, 3).sum(axis=-1))
    live = live_ticks(trajectory.t, count, ends)
    for vehicle, (left, middle, right) in enumerate(axes):
        ticks = live[vehicle]
        t, part = trajectory.t[:ticks], (slice(ticks), vehicle)
        _draw_nees(left, t, trajectory.nees[part], vehicle, steady_from)
        _draw_spread(middle, t, trajectory.position_error[part], spread[part][:, 1])
        _draw_spread(right, t, trajectory.orientation_error[part], np.degrees(spread[part][:, 0]))
        name = style.vehicle_label(trajectory.vehicles[vehicle])
        left.set_ylabel(name, fontsize=13, rotation=0, labelpad=14, va="center")
        for ax in (left, middle, right):
            style.shade_ended(ax, trajectory.t, ticks)
            style.time_axis(ax, trajectory.t, labelled=vehicle == count - 1)
    for ax, title in zip(axes[0], ("NEES (6 dof)", "position [m]", "orientation [deg]"), strict=True):
        ax.set_title(title, fontsize=style.NORMAL + 1, color=style.INK, pad=20)
    for column in (0, 1):
        handles = axes[0, column].get_legend_handles_labels()[0]
        if column == 1 and live.min() < len(trajectory.t):
            handles.append(Patch(facecolor=style.ENDED, label="ended, parked"))
        spacing = {"ncols": 3, "handlelength": 2.0, "columnspacing": 1.2}
        style.legend(axes[0, column], handles, "lower center", (0.5, 0.98), **spacing)
    return figure


def _draw_nees(ax: Axes, t: np.ndarray, nees: np.ndarray, vehicle: int, steady_from: float) -> None:
    style.tidy(ax)
    ax.axhspan(*NEES_BOUNDS, color=style.SHADE, zorder=0, label="95 % of $\\chi^2_6$")
    ax.axhline(DEGREES_OF_FREEDOM, color=style.GREY, linewidth=0.8, linestyle=(0, (4, 2)), label="expected")
    ax.set_yscale("log")
    shown = style.drawable(nees, positive=True)
    if np.isnan(shown).all():
        ax.set_ylim(0.1, 100.0)
        reason = "no covariance declared" if np.isnan(nees).all() else "none to draw"
        style.note(ax, 0.5, 0.5, reason, ha="center", color=style.GREY)
        return
    keep = style.thinned(len(t))
    ax.plot(t[keep], shown[keep], color=style.vehicle_colour(vehicle), linewidth=0.7)
    style.show_decades(ax)
    bottom, top = ax.get_ylim()
    ax.set_ylim(bottom, top * (top / bottom) ** 0.25)  # room for the note
    style.note(ax, 0.985, 0.95, _verdict(t, nees, steady_from), ha="right", va="top", path_effects=style.HALO)
    if t[0] < steady_from < t[-1]:
        ax.axvline(
            steady_from, ymax=0.83, color=style.INK, linewidth=0.7, linestyle=(0, (1, 1.5)), label="steady state"
        )


def _verdict(t: np.ndarray, nees: np.ndarray, steady_from: float) -> str:
    """Return the mean NEES that the table of the run has, too."""
    steady = nees[t > steady_from]
    if not len(steady):
        return f"ended before the steady state ({steady_from:.4g} s)"
    inside = np.mean((steady >= NEES_BOUNDS[0]) & (steady <= NEES_BOUNDS[1]))
    mean = float(steady_mean(t, nees, steady_from))
    return f"after {steady_from:.4g} s: mean {mean:.3g}, {100 * inside:.0f} % of ticks inside"


def _draw_spread(ax: Axes, t: np.ndarray, error: np.ndarray, spread: np.ndarray) -> None:
    style.tidy(ax)
    ax.set_yscale("log")
    keep, claimed = style.thinned(len(t)), "claimed std. deviation"
    looks = (style.INK, "-", 0.8, "error"), (style.VERMILION, (0, (4, 1.5)), 1.4, claimed)
    for values, (colour, dash, width, name) in zip((error, spread), looks, strict=True):
        shown = style.drawable(values, positive=True)
        if not np.isnan(shown).all():
            ax.plot(t[keep], shown[keep], color=colour, linestyle=dash, linewidth=width, label=name)
    style.show_decades(ax)
