"""The evolution of the error states, one row per vehicle, as the paper shows them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopenv.estimation.metrics import (
    SETTLED_ORIENTATION_DEG,
    SETTLED_POSITION_M,
    error_rotation,
    roll_pitch_yaw_deg,
    settling_time,
)
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz.style import (
    AXES_COLOURS,
    GREY,
    INK,
    LINE,
    NORMAL,
    SHADE,
    SMALL,
    moving_target_seen,
    new_figure,
    runs,
    shade,
    thinned,
    tidy,
    time_axis,
    vehicle_label,
)

_ROW, _HEAD, _FOOT = 2.2, 0.7, 0.5  # inches
_LEFT, _RIGHT, _GAP = 0.105, 0.985, 0.2  # shares of the width; the gap as a share of a panel's
_LABEL_X = -0.1  # of a panel's width
_DASHED, _DOTTED = (0, (4, 2)), (0, (1, 1.5))


class _Quantity(NamedTuple):
    """What one column shows of a vehicle."""

    components: np.ndarray  # (K, 3) m or deg
    magnitude: np.ndarray  # (K,) m or deg
    label: str
    magnitude_label: str
    tolerance: float  # m or deg, of settling


def error_figure(trajectory: Trajectory) -> Figure:
    """Draw position (map frame, m) and orientation errors (roll, pitch, yaw of Rtilde, deg) against time.

    Below each linear panel stands the magnitude on a logarithmic scale with the settling tolerance. Blue
    shading: the vehicle detects a moving target. Dashed line: the settling time.
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
    settled = settling_time(trajectory.t, trajectory.position_error, trajectory.orientation_error)
    for vehicle in range(count):
        shaded = runs(trajectory.t, moving_target_seen(trajectory, vehicle))
        for column, quantity in enumerate(_quantities(trajectory, vehicle)):
            panels = grid[vehicle, column].subgridspec(2, 1, height_ratios=(1.8, 1), hspace=0.1)
            linear, log = figure.add_subplot(panels[0]), figure.add_subplot(panels[1])
            _draw_components(linear, trajectory.t, quantity)
            _draw_magnitude(log, trajectory.t, quantity, float(settled[vehicle]))
            for ax in (linear, log):
                shade(ax, shaded)
                ax.yaxis.set_label_coords(_LABEL_X, 0.5)
                time_axis(ax, trajectory.t, labelled=ax is log and vehicle == count - 1)
                if np.isfinite(settled[vehicle]):
                    ax.axvline(float(settled[vehicle]), color=INK, linewidth=0.8, linestyle=_DASHED)
            if column == 0:
                name = vehicle_label(trajectory.vehicles[vehicle])
                linear.text(-0.245, 0.15, name, transform=linear.transAxes, fontsize=13, color=INK)
    _add_legends(figure, height)
    return figure


def _quantities(trajectory: Trajectory, vehicle: int) -> tuple[_Quantity, _Quantity]:
    tilde = error_rotation(trajectory.rotation[:, vehicle], trajectory.rotation_estimate[:, vehicle])
    position = _Quantity(
        components=trajectory.position[:, vehicle] - trajectory.position_estimate[:, vehicle],
        magnitude=trajectory.position_error[:, vehicle],
        label="position error\n[m]",
        magnitude_label="norm\n[m]",
        tolerance=SETTLED_POSITION_M,
    )
    orientation = _Quantity(
        components=roll_pitch_yaw_deg(tilde),
        magnitude=trajectory.orientation_error[:, vehicle],
        label="orientation error\n[deg]",
        magnitude_label="angle\n[deg]",
        tolerance=SETTLED_ORIENTATION_DEG,
    )
    return position, orientation


def _draw_components(ax: Axes, t: np.ndarray, quantity: _Quantity) -> None:
    keep = thinned(len(t))
    tidy(ax, y_label=quantity.label)
    ax.axhline(0.0, color=GREY, linewidth=0.6, zorder=1)
    for component, colour in zip(quantity.components[keep].T, AXES_COLOURS, strict=True):
        ax.plot(t[keep], _without_wraps(component), color=colour, linewidth=LINE)


def _draw_magnitude(ax: Axes, t: np.ndarray, quantity: _Quantity, settled: float) -> None:
    keep = thinned(len(t))
    tidy(ax, y_label=quantity.magnitude_label)
    magnitude = quantity.magnitude[keep]
    ax.semilogy(t[keep], np.where(magnitude > 0, magnitude, np.nan), color=INK, linewidth=0.8)
    ax.axhline(quantity.tolerance, color=GREY, linewidth=0.9, linestyle=_DOTTED)
    text = f"settled at {settled:.1f} s" if np.isfinite(settled) else "not settled"
    low_end = magnitude[-1] < np.sqrt(np.prod(ax.get_ylim()))  # the text goes where the curve does not
    y, align = (0.94, "top") if low_end else (0.1, "bottom")
    ax.text(0.99, y, text, transform=ax.transAxes, ha="right", va=align, fontsize=SMALL, color=INK)


def _without_wraps(angle: np.ndarray) -> np.ndarray:
    """Break the line where an angle jumps from one end of its range to the other."""
    jump = np.abs(np.diff(angle, prepend=angle[:1])) > 180.0
    return np.where(jump, np.nan, angle)


def _add_legends(figure: Figure, height: float) -> None:
    marks: list[Line2D | Patch] = [
        Line2D([], [], color=INK, linestyle=_DASHED, linewidth=0.8, label="settling time"),
        Line2D([], [], color=GREY, linestyle=_DOTTED, linewidth=0.9, label="settling tolerance"),
        Patch(facecolor=SHADE, label="moving target detected"),
    ]
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
            ncols=3,
            fontsize=NORMAL,
            frameon=False,
            handlelength=1.8,
            columnspacing=1.4,
            borderpad=0.0,
            borderaxespad=0.0,
        )
