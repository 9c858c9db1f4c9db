"""Does the observer know how wrong it is? NEES with chi-square bounds, and errors beside uncertainties."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from coopenv.estimation.trajectory import Trajectory
from coopenv.viz.style import (
    GREY,
    INK,
    NORMAL,
    SHADE,
    SMALL,
    VERMILION,
    new_figure,
    thinned,
    tidy,
    time_axis,
    vehicle_colour,
    vehicle_label,
)

DEGREES_OF_FREEDOM = 6
NEES_BOUNDS = (float(chi2.ppf(0.025, DEGREES_OF_FREEDOM)), float(chi2.ppf(0.975, DEGREES_OF_FREEDOM)))
"""95 % of the NEES of a consistent observer lie between these, at one instant over many runs."""

_ROW, _HEAD, _FOOT = 1.45, 0.6, 0.5  # inches


def consistency_figure(trajectory: Trajectory) -> Figure:
    """Draw, per vehicle, NEES, and both errors beside the standard deviations that the observer claims.

    The bounds hold at each instant over many runs; the ticks of one run are correlated, so the share of ticks
    inside is a hint, not a test.
    """
    count = len(trajectory.vehicles)
    height = _HEAD + _FOOT + _ROW * count
    figure = new_figure(10.5, height)
    axes = figure.subplots(
        count,
        3,
        squeeze=False,
        gridspec_kw={
            "left": 0.085,
            "right": 0.985,
            "bottom": _FOOT / height,
            "top": 1 - _HEAD / height,
            "wspace": 0.2,
            "hspace": 0.16,
        },
    )
    spread = np.sqrt(np.diagonal(trajectory.covariance, axis1=-2, axis2=-1).reshape(-1, count, 2, 3).sum(axis=-1))
    for vehicle, (left, middle, right) in enumerate(axes):
        _draw_nees(left, trajectory, vehicle)
        _draw_spread(middle, trajectory.t, trajectory.position_error[:, vehicle], spread[:, vehicle, 1])
        degrees = np.degrees(spread[:, vehicle, 0])
        _draw_spread(right, trajectory.t, trajectory.orientation_error[:, vehicle], degrees)
        name = vehicle_label(trajectory.vehicles[vehicle])
        left.set_ylabel(name, fontsize=13, rotation=0, labelpad=14, va="center")
        for ax in (left, middle, right):
            time_axis(ax, trajectory.t, labelled=vehicle == count - 1)
    for ax, title in zip(axes[0], ("NEES (6 dof)", "position [m]", "orientation [deg]"), strict=True):
        ax.set_title(title, fontsize=NORMAL + 1, color=INK, pad=20)
    axes[0, 1].legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 0.98),
        ncols=2,
        fontsize=SMALL,
        frameon=False,
        handlelength=2.2,
    )
    axes[0, 0].legend(loc="lower center", bbox_to_anchor=(0.5, 0.98), ncols=3, fontsize=SMALL, frameon=False)
    return figure


def _draw_nees(ax: Axes, trajectory: Trajectory, vehicle: int) -> None:
    tidy(ax)
    ax.axhspan(*NEES_BOUNDS, color=SHADE, zorder=0, label="95 % of $\\chi^2_6$")
    ax.axhline(DEGREES_OF_FREEDOM, color=GREY, linewidth=0.8, linestyle=(0, (4, 2)), label="expected")
    nees = trajectory.nees[:, vehicle]
    ax.set_yscale("log")
    if not np.any(nees > 0):
        ax.set_ylim(0.1, 100.0)
        ax.text(
            0.5,
            0.5,
            "no covariance declared",
            transform=ax.transAxes,
            ha="center",
            fontsize=SMALL,
            color=GREY,
        )
        return
    keep = thinned(len(nees))
    positive = np.where(nees[keep] > 0, nees[keep], np.nan)
    ax.plot(trajectory.t[keep], positive, color=vehicle_colour(vehicle), linewidth=0.7)
    bottom, top = ax.get_ylim()
    ax.set_ylim(bottom, top * (top / bottom) ** 0.25)  # room for the note
    inside = np.mean((nees >= NEES_BOUNDS[0]) & (nees <= NEES_BOUNDS[1]))
    note = f"mean {np.nanmean(nees):.3g}, {100 * inside:.0f} % of ticks inside"
    ax.text(0.985, 0.95, note, transform=ax.transAxes, ha="right", va="top", fontsize=SMALL, color=INK)


def _draw_spread(ax: Axes, t: np.ndarray, error: np.ndarray, spread: np.ndarray) -> None:
    tidy(ax)
    keep = thinned(len(t))
    ax.set_yscale("log")
    for values, colour, style, width, name in (
        (error, INK, "-", 0.8, "error"),
        (spread, VERMILION, (0, (4, 1.5)), 1.4, "claimed standard deviation"),
    ):
        if np.any(values > 0):
            positive = np.where(values[keep] > 0, values[keep], np.nan)
            ax.plot(t[keep], positive, color=colour, linestyle=style, linewidth=width, label=name)
