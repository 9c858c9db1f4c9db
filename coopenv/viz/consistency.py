"""Does the observer know how wrong it is? NEES with chi-square bounds, and errors beside uncertainties."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.stats import chi2

from coopenv.estimation.metrics import STEADY_SHARE, live_ticks, steady_mean
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style

DEGREES_OF_FREEDOM = 6
NEES_BOUNDS = (float(chi2.ppf(0.025, DEGREES_OF_FREEDOM)), float(chi2.ppf(0.975, DEGREES_OF_FREEDOM)))
"""95 % of the NEES of a consistent observer lie between these, at one instant over many runs."""

_ROW, _NARROW_ROW, _FRAME = 1.3, 0.95, 1.2  # inches
_EXPECTED: dict[str, Any] = {"color": style.GREY, "linewidth": 0.8, "linestyle": (0, (4, 2))}
_STEADY: dict[str, Any] = {"color": style.INK, "linewidth": 0.7, "linestyle": (0, (1, 1.5))}
_SPREAD_LOOKS: tuple[dict[str, Any], dict[str, Any]] = (
    {"color": style.VERMILION, "linestyle": (0, (4, 1.5)), "linewidth": 1.4},
    {"color": style.INK, "linestyle": "-", "linewidth": 0.8},
)
"""Of what is claimed, and of what is."""
_SHORT = 9.0  # inches: in narrower figures panels have no room for sentences
_TITLES, _NARROW_TITLES = ("NEES (6 dof)", "position [m]", "orientation [deg]"), ("NEES", "[m]", "[deg]")
_ROOM = 0.3  # of the height, for words above the curves
HONEST = (
    "An honest observer's NEES lies in the band 95 % of the time; "
    "above it, the observer believes itself better than it is."
)
GAIN = "The P of this observer is the gain matrix of its Riccati equation, not a covariance: its NEES says nothing."


def consistency_figure(
    trajectory: Trajectory,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    width: float | None = None,
    *,
    gain: bool = False,
) -> Figure:
    """Draw, per vehicle, NEES, and both errors beside the standard deviations that the observer claims.

    The bounds hold at each instant over many runs; the ticks of one run are correlated, so the share of ticks
    inside is a hint, not a test. Ordinates are the same for all vehicles.

    Args:
        trajectory: the record of a run.
        ends: s, when each vehicle was parked, after which nothing counts.
        steady_from: s; the mean NEES and the share inside are over the ticks after it (None: `STEADY_SHARE` of
            the record).
        width: inches (None: a page's).
        gain: whether P is the gain matrix of an observer that states no covariance, which the figure then says.
    """
    if steady_from is None:
        steady_from = STEADY_SHARE * float(trajectory.t[-1])
    count = len(trajectory.vehicles)
    narrow, short = (width is not None and width < limit for limit in (style.NARROW, _SHORT))
    figure, _ = style.canvas(width, _FRAME + (_NARROW_ROW if narrow else _ROW) * count, "")
    axes = figure.subplots(count, 3, squeeze=False)
    variance = np.diagonal(np.asarray(trajectory.covariance, float), axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):  # of an observer that has diverged
        spread = np.sqrt(variance.reshape(-1, count, 2, 3).sum(axis=-1))
    live = live_ticks(trajectory.t, count, ends)
    for vehicle, (left, middle, right) in enumerate(axes):
        ticks = live[vehicle]
        t, part = trajectory.t[:ticks], (slice(ticks), vehicle)
        _draw_nees(left, t, trajectory.nees[part], steady_from, short)
        _draw_spread(middle, t, trajectory.position_error[part], spread[part][:, 1])
        _draw_spread(right, t, trajectory.orientation_error[part], np.degrees(spread[part][:, 0]))
        name = style.vehicle_label(trajectory.vehicles[vehicle])
        left.set_ylabel(name, fontsize=style.NORMAL + 2, rotation=0, ha="right", va="center")
        for ax in (left, middle, right):
            style.shade_ended(ax, trajectory.t, ticks)
            style.time_axis(ax, trajectory.t, labelled=vehicle == count - 1)
    for column, room in zip(axes.T, (_ROOM, 0.0, 0.0), strict=True):
        _share_decades(column, room)
    for ax, title in zip(axes[0], _NARROW_TITLES if narrow else _TITLES, strict=True):
        ax.set_title(title, fontsize=style.NORMAL, color=style.INK)
    style.explain(figure, GAIN if gain else HONEST)
    ended = [Patch(facecolor=style.ENDED, label="ended, parked")] if live.min() < len(trajectory.t) else []
    style.legend_above(figure, [*_marks(trajectory.t, steady_from), *ended])
    return figure


def _marks(t: np.ndarray, steady_from: float) -> list[Patch | Line2D]:
    claimed, error = _SPREAD_LOOKS
    steady = [Line2D([], [], label="steady state", **_STEADY)] if t[0] < steady_from < t[-1] else []
    return [
        Patch(facecolor=style.SHADE, label="95 % of $\\chi^2_6$"),
        Line2D([], [], label="expected", **_EXPECTED),
        *steady,
        Line2D([], [], label="error", **error),
        Line2D([], [], label="claimed std. deviation", **claimed),
    ]


def _share_decades(column: Sequence[Axes], room: float) -> None:
    """Give panels the same logarithmic ordinate, which holds what all of them show, and room above it."""
    for ax in column:
        style.show_decades(ax)
    limits = [ax.get_ylim() for ax in column]
    bottom, top = min(low for low, _ in limits), max(high for _, high in limits)
    for ax in column:
        ax.set_ylim(bottom, top * (top / bottom) ** room)


def _draw_nees(ax: Axes, t: np.ndarray, nees: np.ndarray, steady_from: float, short: bool) -> None:
    style.tidy(ax)
    ax.axhspan(*NEES_BOUNDS, color=style.SHADE, zorder=0)
    ax.axhline(DEGREES_OF_FREEDOM, **_EXPECTED)
    ax.set_yscale("log")
    shown = style.drawable(nees, positive=True)
    if np.isnan(shown).all():
        reason = "no covariance declared" if np.isnan(nees).all() else "none to draw"
        style.note(ax, 0.5, 0.5, reason, ha="center", color=style.NOTE)
        return
    keep = style.thinned(len(t))
    ax.plot(t[keep], shown[keep], color=style.INK, linewidth=0.7)
    words = _verdict(t, nees, steady_from, short)
    style.note(ax, 0.985, 0.95, words, ha="right", va="top", path_effects=style.HALO)
    if t[0] < steady_from < t[-1]:
        ax.axvline(steady_from, **_STEADY)


def _verdict(t: np.ndarray, nees: np.ndarray, steady_from: float, short: bool) -> str:
    """Return the mean NEES that the table of the run has, too."""
    steady = nees[t > steady_from]
    if not len(steady):
        return "ended before" if short else f"ended before the steady state ({steady_from:.4g} s)"
    inside = np.mean((steady >= NEES_BOUNDS[0]) & (steady <= NEES_BOUNDS[1]))
    mean = float(steady_mean(t, nees, steady_from))
    if short:
        return f"mean {mean:.3g}"
    return f"after {steady_from:.4g} s: mean {mean:.3g}, {100 * inside:.0f} % of ticks inside"


def _draw_spread(ax: Axes, t: np.ndarray, error: np.ndarray, spread: np.ndarray) -> None:
    style.tidy(ax)
    ax.set_yscale("log")
    keep = style.thinned(len(t))
    for values, look in zip((spread, error), _SPREAD_LOOKS, strict=True):
        shown = style.drawable(values, positive=True)
        if not np.isnan(shown).all():
            ax.plot(t[keep], shown[keep], **look)
