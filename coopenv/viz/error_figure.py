"""The evolution of the error states, one row per vehicle, as the paper shows them."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopenv.estimation.metrics import CONVERGED, error_rotation, live_ticks, roll_pitch_yaw_deg, settling_times
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style

_ROW, _HEAD, _FOOT = 2.2, 0.7, 0.5  # inches
_LEFT, _RIGHT, _GAP = 0.105, 0.985, 0.2  # shares of the width; the gap as a share of a panel's
_LABEL_X = -0.1  # of a panel's width
_DASHED, _DOTTED = (0, (4, 2)), (0, (1, 1.5))
_UNSEEN_SHARE = 0.005  # of the record: a fall within it is no wider than the line at the axis
_LEAST_SHARE = 0.2  # of the height: curves lower than this are magnified, and the start is left outside
_PAD = 0.07  # of the height, above and below
_DOT = 4.0  # pt
_NOTE = (0.27, 0.22)  # width and height of a note, shares of a panel


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
    figure = style.new_figure(10.0, height)
    edges = {"left": _LEFT, "right": _RIGHT, "bottom": _FOOT / height, "top": 1 - _HEAD / height}
    grid = figure.add_gridspec(count, 2, wspace=_GAP, hspace=0.14, **edges)
    converged = settling_times(trajectory, ends)
    live = live_ticks(trajectory.t, count, ends)
    seen = [style.moving_target_seen(trajectory, vehicle, ticks) for vehicle, ticks in enumerate(live)]
    shaded = [style.runs(trajectory.t, mask, style.MERGED_GAP) for mask in seen]
    for vehicle, ticks in enumerate(live):
        settled = float(converged[vehicle])
        for column, quantity in enumerate(_quantities(trajectory, vehicle, ticks)):
            panels = grid[vehicle, column].subgridspec(2, 1, height_ratios=(1.8, 1), hspace=0.1)
            linear, log = figure.add_subplot(panels[0]), figure.add_subplot(panels[1])
            for ax, label in ((linear, quantity.label), (log, quantity.magnitude_label)):
                style.tidy(ax, y_label=label)
                ax.yaxis.set_label_coords(_LABEL_X, 0.5)
                style.time_axis(ax, trajectory.t, labelled=ax is log and vehicle == count - 1)
                style.shade(ax, shaded[vehicle])
                style.shade_ended(ax, trajectory.t, ticks)
                if np.isfinite(settled):
                    ax.axvline(settled, color=style.INK, linewidth=0.8, linestyle=_DASHED)
            _draw_components(linear, trajectory.t[:ticks], quantity, settled)
            _draw_magnitude(log, trajectory.t[:ticks], quantity, settled)
            if column == 0:
                name = style.vehicle_label(trajectory.vehicles[vehicle])
                linear.text(-0.245, 0.15, name, transform=linear.transAxes, fontsize=13, color=style.INK)
    marks = _marks(bool(np.isfinite(converged).any()), any(shaded), live.min() < len(trajectory.t))
    _add_legends(figure, height, marks)
    return figure


def _quantities(trajectory: Trajectory, vehicle: int, ticks: int) -> tuple[_Quantity, _Quantity]:
    part = slice(ticks), vehicle
    with np.errstate(invalid="ignore", over="ignore"):  # of an observer that has diverged
        tilde = error_rotation(trajectory.rotation[part], trajectory.rotation_estimate[part])
        position = style.drawable(np.asarray(trajectory.position[part], float) - trajectory.position_estimate[part])
    distance = style.drawable(trajectory.position_error[part], positive=True)
    angle = style.drawable(trajectory.orientation_error[part], positive=True)
    angles, names = style.drawable(roll_pitch_yaw_deg(tilde)), ("orientation error\n[deg]", "angle\n[deg]")
    return (
        _Quantity(position, distance, "m", "position error\n[m]", "norm\n[m]", CONVERGED.position_m),
        _Quantity(angles, angle, "deg", *names, CONVERGED.orientation_deg),
    )


def _draw_components(ax: Axes, t: np.ndarray, quantity: _Quantity, converged: float) -> None:
    keep = style.thinned(len(t))
    ax.axhline(0.0, color=style.GREY, linewidth=0.6, zorder=1)
    low, high = _limits(quantity.components)
    ax.set_ylim(low, high)
    for component, colour in zip(quantity.components.T, style.AXES_COLOURS, strict=True):
        ax.plot(t[keep], _without_wraps(component[keep]), color=colour, linewidth=style.LINE)
        start = np.clip(component[0], low, high)
        marker = "^" if component[0] > high else "v" if component[0] < low else "o"
        ax.plot([t[0]], [start], marker, color=colour, markersize=_DOT, clip_on=False, zorder=4)
    start = quantity.components[0]
    if np.any((start < low) | (start > high)):
        values = ", ".join(f"{value + 0.0:.3g}" for value in start.round(6))
        y, align = (0.04, "bottom") if np.nanmax(-start) > np.nanmax(start) else (0.96, "top")
        begin, end = ax.get_xlim()
        line = (converged - begin) / (end - begin)
        x = line + 0.015 if 0.02 < line < 0.4 else 0.02  # beside the dashed line
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
        style.note(ax, x, y, f"starts at {values} {quantity.unit}", va=align, bbox=box)


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
    keep = style.thinned(len(t))
    ax.set_yscale("log")
    ax.plot(t[keep], quantity.magnitude[keep], color=style.INK, linewidth=0.8)
    ax.axhline(quantity.tolerance, color=style.GREY, linewidth=0.9, linestyle=_DOTTED)
    ax.plot([t[0]], [quantity.magnitude[0]], "o", markersize=_DOT, color=style.INK, clip_on=False, zorder=4)
    style.show_decades(ax)
    right, top = _quiet_corner(ax, t, quantity, converged)
    x, ha = (0.99, "right") if right else (0.02, "left")
    y, va = (0.95, "top") if top else (0.07, "bottom")
    text = f"converged at {converged:.1f} s" if np.isfinite(converged) else "not converged"
    style.note(ax, x, y, text, ha=ha, va=va, path_effects=style.HALO)


def _quiet_corner(ax: Axes, t: np.ndarray, quantity: _Quantity, converged: float) -> tuple[int, int]:
    """Return the corner (1: right, 1: top) of a logarithmic panel where a note covers the least."""
    curve = np.stack([t, quantity.magnitude], axis=-1)
    places = (ax.transScale + ax.transLimits).transform([*curve, (converged, quantity.tolerance)])  # shares
    costs = {}
    for corner in product((1, 0), (1, 0)):
        near = np.abs(places - corner) < _NOTE
        covered, (crossed, on_tolerance) = near[:-1].all(axis=-1).mean(), near[-1]
        costs[corner] = 4.0 * crossed + 10.0 * covered / _NOTE[0] + 0.5 * on_tolerance
    return min(costs, key=lambda corner: costs[corner])


def _without_wraps(angle: np.ndarray) -> np.ndarray:
    """Break the line where an angle jumps from one end of its range to the other."""
    jump = np.abs(np.diff(angle, prepend=angle[:1])) > 180.0  # False beside NaN
    return np.where(jump, np.nan, angle)


def _marks(converged: bool, shaded: bool, ended: bool) -> list[Line2D | Patch]:
    """Return what the legend explains of all that is in the figure."""
    ink, tolerance = style.INK, f"{CONVERGED.position_m:g} m, {CONVERGED.orientation_deg:g} deg"
    marks: list[tuple[bool, Line2D | Patch]] = [
        (True, Line2D([], [], color=ink, linestyle="none", marker="o", markersize=_DOT, label="at t = 0")),
        (True, Line2D([], [], color=style.GREY, linestyle=_DOTTED, linewidth=0.9, label=tolerance)),
        (converged, Line2D([], [], color=ink, linestyle=_DASHED, linewidth=0.8, label="below both from here on")),
        (shaded, Patch(facecolor=style.SHADE, label="moving target detected")),
        (ended, Patch(facecolor=style.ENDED, label="ended, parked")),
    ]
    return [mark for occurs, mark in marks if occurs]


def _add_legends(figure: Figure, height: float, marks: list[Line2D | Patch]) -> None:
    look = {"fontsize": style.NORMAL, "handlelength": 1.8, "columnspacing": 1.4, "borderpad": 0.0, "borderaxespad": 0.0}
    style.legend(figure, marks, "center left", (_LEFT, 1 - 0.2 / height), ncols=len(marks), **look)
    second = _LEFT + (_RIGHT - _LEFT) * (1 + _GAP) / (2 + _GAP)
    for x, names in ((_LEFT, ("x", "y", "z")), (second, ("roll", "pitch", "yaw"))):
        pairs = zip(names, style.AXES_COLOURS, strict=True)
        handles = [Line2D([], [], color=colour, linewidth=style.LINE, label=name) for name, colour in pairs]
        style.legend(figure, handles, "center left", (x, 1 - 0.48 / height), ncols=3, **look)
