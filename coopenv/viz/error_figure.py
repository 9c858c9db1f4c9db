"""The evolution of the error states, one row per vehicle, as the paper shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from coopenv.estimation.metrics import (
    CONVERGED,
    error_rotation,
    live_ticks,
    roll_pitch_yaw_deg,
    settling_times,
)
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz.style import (
    AXES_COLOURS,
    ENDED,
    GREY,
    INK,
    LINE,
    MERGED_GAP,
    NORMAL,
    SHADE,
    SMALL,
    drawable,
    moving_target_seen,
    new_figure,
    runs,
    shade,
    shade_ended,
    show_decades,
    thinned,
    tidy,
    time_axis,
    time_span,
    vehicle_label,
)

_ROW, _HEAD, _FOOT = 2.2, 0.7, 0.5  # inches
_LEFT, _RIGHT, _GAP = 0.105, 0.985, 0.2  # shares of the width; the gap as a share of a panel's
_LABEL_X = -0.1  # of a panel's width
_DASHED, _DOTTED = (0, (4, 2)), (0, (1, 1.5))
_UNSEEN_SHARE = 0.005  # of the record: a fall within it is no wider than the line at the axis
_LEAST_SHARE = 0.2  # of the height: curves lower than this are magnified, and the start is left outside
_PAD = 0.07  # of the height, above and below
_DOT = 4.0  # pt
_NOTE = (0.27, 0.22)  # width and height of a note, shares of a panel
_HALO = withStroke(linewidth=2.0, foreground="white")


class _Quantity(NamedTuple):
    """What one column shows of a vehicle."""

    components: np.ndarray  # (K, 3) m or deg
    magnitude: np.ndarray  # (K,) m or deg, NaN where it is zero
    unit: str
    label: str
    magnitude_label: str
    tolerance: float  # m or deg, of settling


def error_figure(trajectory: Trajectory, ends: Sequence[float] | None = None) -> Figure:
    """Draw position (map frame, m) and orientation errors (roll, pitch, yaw of Rtilde, deg) against time.

    Below each linear panel stands the magnitude on a logarithmic scale with the settling tolerance. Dots: the
    errors at t = 0, before the first correction; where they would flatten the curves, an arrow at the edge and
    their values in words. Blue shading: the vehicle detects a moving target. Dashed line: the settling time.
    Grey: the vehicle has ended (at `ends`, s) and is parked.
    """
    count = len(trajectory.vehicles)
    height = _HEAD + _FOOT + _ROW * count
    figure = new_figure(10.0, height)
    grid = figure.add_gridspec(
        count,
        2,
        left=_LEFT,
        right=_RIGHT,
        bottom=_FOOT / height,
        top=1 - _HEAD / height,
        wspace=_GAP,
        hspace=0.14,
    )
    converged = settling_times(trajectory, ends)
    live = live_ticks(trajectory.t, count, ends)
    shaded = [_moving_seen(trajectory, vehicle, ticks) for vehicle, ticks in enumerate(live)]
    for vehicle, ticks in enumerate(live):
        for column, quantity in enumerate(_quantities(trajectory, vehicle, ticks)):
            panels = grid[vehicle, column].subgridspec(2, 1, height_ratios=(1.8, 1), hspace=0.1)
            linear, log = figure.add_subplot(panels[0]), figure.add_subplot(panels[1])
            for ax, label in ((linear, quantity.label), (log, quantity.magnitude_label)):
                tidy(ax, y_label=label)
                time_axis(ax, trajectory.t, labelled=ax is log and vehicle == count - 1)
                shade(ax, shaded[vehicle])
                shade_ended(ax, trajectory.t, ticks)
                if np.isfinite(converged[vehicle]):
                    ax.axvline(float(converged[vehicle]), color=INK, linewidth=0.8, linestyle=_DASHED)
            _draw_components(linear, trajectory.t[:ticks], quantity, float(converged[vehicle]))
            _draw_magnitude(log, trajectory.t[:ticks], quantity, float(converged[vehicle]))
            for ax in (linear, log):
                ax.yaxis.set_label_coords(_LABEL_X, 0.5)
            if column == 0:
                name = vehicle_label(trajectory.vehicles[vehicle])
                linear.text(-0.245, 0.15, name, transform=linear.transAxes, fontsize=13, color=INK)
    _add_legends(
        figure, height, _marks(bool(np.isfinite(converged).any()), any(shaded), live.min() < len(trajectory.t))
    )
    return figure


def _moving_seen(trajectory: Trajectory, vehicle: int, ticks: int) -> list[tuple[float, float]]:
    seen = moving_target_seen(trajectory, vehicle) & (np.arange(len(trajectory.t)) < ticks)
    return runs(trajectory.t, seen, MERGED_GAP)


def _quantities(trajectory: Trajectory, vehicle: int, ticks: int) -> tuple[_Quantity, _Quantity]:
    part = slice(ticks), vehicle
    with np.errstate(invalid="ignore", over="ignore"):  # of an observer that has diverged
        tilde = error_rotation(trajectory.rotation[part], trajectory.rotation_estimate[part])
        position = np.asarray(trajectory.position[part], float) - trajectory.position_estimate[part]
    return (
        _Quantity(
            components=drawable(position),
            magnitude=drawable(trajectory.position_error[part], positive=True),
            unit="m",
            label="position error\n[m]",
            magnitude_label="norm\n[m]",
            tolerance=CONVERGED.position_m,
        ),
        _Quantity(
            components=drawable(roll_pitch_yaw_deg(tilde)),
            magnitude=drawable(trajectory.orientation_error[part], positive=True),
            unit="deg",
            label="orientation error\n[deg]",
            magnitude_label="angle\n[deg]",
            tolerance=CONVERGED.orientation_deg,
        ),
    )


def _draw_components(ax: Axes, t: np.ndarray, quantity: _Quantity, converged: float) -> None:
    keep = thinned(len(t))
    ax.axhline(0.0, color=GREY, linewidth=0.6, zorder=1)
    low, high = _limits(quantity.components)
    ax.set_ylim(low, high)
    for component, colour in zip(quantity.components.T, AXES_COLOURS, strict=True):
        ax.plot(t[keep], _without_wraps(component[keep]), color=colour, linewidth=LINE)
        start = component[0]
        marker = "^" if start > high else "v" if start < low else "o"
        look: dict[str, Any] = {"marker": marker, "markersize": _DOT, "color": colour, "zorder": 4}
        ax.plot([t[0]], [np.clip(start, low, high)], clip_on=False, **look)
    start = quantity.components[0]
    if np.any((start < low) | (start > high)):
        values = ", ".join(f"{value + 0.0:.3g}" for value in start.round(6))
        y, align = (0.04, "bottom") if np.nanmax(-start) > np.nanmax(start) else (0.96, "top")
        note = f"starts at {values} {quantity.unit}"
        begin, end = ax.get_xlim()
        line = (converged - begin) / (end - begin)
        x = line + 0.015 if 0.02 < line < 0.4 else 0.02  # beside the dashed line
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
        ax.text(x, y, note, transform=ax.transAxes, va=align, fontsize=SMALL, color=INK, bbox=box)


def _limits(components: np.ndarray) -> tuple[float, float]:
    """Return the ends of the axis of components (K, 3).

    They hold everything, unless what is left once the fall at the very beginning is over would then look flat.
    """
    unseen = int(np.ceil(_UNSEEN_SHARE * len(components)))
    whole, later = _range(components), _range(components[min(unseen, len(components) - 1) :])
    low, high = whole if later[1] - later[0] >= _LEAST_SHARE * (whole[1] - whole[0]) else later
    pad = _PAD * (high - low) or 1.0
    return low - pad, high + pad


def _range(values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest of values and zero."""
    values = np.append(values[np.isfinite(values)], 0.0)
    return float(values.min()), float(values.max())


def _draw_magnitude(ax: Axes, t: np.ndarray, quantity: _Quantity, converged: float) -> None:
    keep = thinned(len(t))
    ax.set_yscale("log")
    ax.plot(t[keep], quantity.magnitude[keep], color=INK, linewidth=0.8)
    ax.axhline(quantity.tolerance, color=GREY, linewidth=0.9, linestyle=_DOTTED)
    ax.plot([t[0]], [quantity.magnitude[0]], "o", markersize=_DOT, color=INK, clip_on=False, zorder=4)
    show_decades(ax)
    text = f"converged at {converged:.1f} s" if np.isfinite(converged) else "not converged"
    right, top = _quiet_corner(ax, t, quantity, converged)
    ax.text(
        0.99 if right else 0.02,
        0.95 if top else 0.07,
        text,
        transform=ax.transAxes,
        ha="right" if right else "left",
        va="top" if top else "bottom",
        fontsize=SMALL,
        color=INK,
        path_effects=[_HALO],
    )


def _quiet_corner(ax: Axes, t: np.ndarray, quantity: _Quantity, converged: float) -> tuple[bool, bool]:
    """Return the corner (right, top) of a logarithmic panel where a note covers the least."""
    bottom, top = np.log(ax.get_ylim())
    begin, end = time_span(np.array(ax.get_xlim()))
    x, line = (t - begin) / (end - begin), (converged - begin) / (end - begin)
    y, tolerance = ((np.log(v) - bottom) / (top - bottom) for v in (quantity.magnitude, quantity.tolerance))
    width, height = _NOTE
    costs = {}
    for at_right in (True, False):
        beside = x > 1 - width if at_right else x < width
        crossed = line > 1 - width if at_right else line < width
        for at_top in (True, False):
            covered = beside & (y > 1 - height if at_top else y < height)
            on_tolerance = tolerance > 1 - height if at_top else tolerance < height
            costs[at_right, at_top] = 4.0 * crossed + 10.0 * covered.mean() / width + 0.5 * on_tolerance
    return min(costs, key=lambda corner: costs[corner])


def _without_wraps(angle: np.ndarray) -> np.ndarray:
    """Break the line where an angle jumps from one end of its range to the other."""
    jump = np.abs(np.diff(angle, prepend=angle[:1])) > 180.0  # False beside NaN
    return np.where(jump, np.nan, angle)


def _marks(converged: bool, shaded: bool, ended: bool) -> list[Line2D | Patch]:
    """Return what the legend explains of all that is in the figure."""
    tolerance = f"{CONVERGED.position_m:g} m, {CONVERGED.orientation_deg:g} deg"
    marks: list[Line2D | Patch] = [
        Line2D([], [], color=INK, linestyle="none", marker="o", markersize=_DOT, label="at t = 0"),
        Line2D([], [], color=GREY, linestyle=_DOTTED, linewidth=0.9, label=tolerance),
    ]
    if converged:
        marks.append(Line2D([], [], color=INK, linestyle=_DASHED, linewidth=0.8, label="below both from here on"))
    if shaded:
        marks.append(Patch(facecolor=SHADE, label="moving target detected"))
    if ended:
        marks.append(Patch(facecolor=ENDED, label="ended, parked"))
    return marks


def _add_legends(figure: Figure, height: float, marks: list[Line2D | Patch]) -> None:
    second = _LEFT + (_RIGHT - _LEFT) * (1 + _GAP) / (2 + _GAP)
    rows = [(_LEFT, 0.2, marks)]
    for x, names in ((_LEFT, ("x", "y", "z")), (second, ("roll", "pitch", "yaw"))):
        pairs = zip(names, AXES_COLOURS, strict=True)
        rows.append((x, 0.48, [Line2D([], [], color=c, linewidth=LINE, label=n) for n, c in pairs]))
    for x, drop, handles in rows:
        figure.legend(
            handles=handles,
            loc="center left",
            bbox_to_anchor=(x, 1 - drop / height),
            ncols=len(handles),
            fontsize=NORMAL,
            frameon=False,
            handlelength=1.8,
            columnspacing=1.4,
            borderpad=0.0,
            borderaxespad=0.0,
        )
