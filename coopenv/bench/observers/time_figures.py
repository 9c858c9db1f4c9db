"""Figures over time: errors beside bounds and claims, and consistency."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from coopenv.bench.observers.canvas import PAGE, TEXT, canvas, fitting, legend, panels
from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.tables import short_name
from coopenv.estimation.consistency import mean_bounds
from coopenv.viz.style import (
    BLUE,
    GREY,
    INK,
    NORMAL,
    SHADE,
    VERMILION,
    drawable,
    tidy,
    time_span,
    vehicle_colour,
    vehicle_label,
)

MOST_VEHICLES = 6
NEES_RANGE = (1e-4, 1e4)
"""Range of NEES over its dimension that is drawn; beyond it an observer is as wrong as it can be."""
_FRAME = 1.15  # inches above and below the panels
_DASHED, _DOTTED = (0, (4, 1.5)), (0, (1, 1))


def error_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw position errors against time: a row per observer, a column per vehicle.

    Median over the seeds of the error and of three standard deviations that the observer claims, beside the bound.

    Returns:
        None where every observer failed.
    """
    groups = board.samples_in(variant)
    if not groups:
        return None
    scene = board.samples[0].scene
    figure, inches = canvas(width, _FRAME + 1.05 * len(groups), f"{board.title}, {variant}")
    shown = _chosen(len(scene.vehicles), fitting(inches, 1.6, MOST_VEHICLES))
    axes = panels(figure, len(groups), len(shown))
    for (name, own), line in zip(groups.items(), axes, strict=True):
        error = np.median([sample.series.position_error for sample in own], axis=0)
        spread = np.median([sample.series.position_std for sample in own], axis=0)
        bound = np.sqrt(np.mean([sample.scene.bound**2 for sample in own], axis=0))
        for ax, i in zip(line, shown, strict=True):
            tidy(ax)
            ax.set_yscale("log")
            for values, factor, colour, style, thick in (
                (spread, 3.0, VERMILION, _DASHED, 1.0),
                (bound, 1.0, GREY, "-", 1.0),
                (error, 1.0, BLUE, "-", 0.9),
            ):
                drawn = drawable(factor * values[:, i], positive=True)
                ax.plot(scene.t, drawn, color=colour, linestyle=style, linewidth=thick)
            if scene.steady_from > 0.0:
                ax.axvline(scene.steady_from, color=INK, linewidth=0.6, linestyle=_DOTTED)
            _time(ax, scene.t)
        line[0].set_ylabel(short_name(name), rotation=0, ha="right", va="center", labelpad=4, **TEXT)
    _share_decades(ax for line in axes for ax in line)
    for y, line in enumerate(axes):
        for x, ax in enumerate(line):
            _outer(ax, lowest=y == len(axes) - 1, leftmost=x == 0)
    for ax, i in zip(axes[0], shown, strict=True):
        ax.set_title(vehicle_label(scene.vehicles[i]), fontsize=NORMAL + 2, color=INK, pad=4)
    figure.supylabel("position error [m]", **TEXT)
    median = ", median over seeds" if len(board.seeds) > 1 else ""
    handles = [
        Line2D([], [], color=BLUE, lw=1.2, label=f"error{median}"),
        Line2D([], [], color=VERMILION, lw=1.2, ls=_DASHED, label=f"3 standard deviations claimed{median}"),
    ]
    if np.isfinite(scene.bound).any():
        handles.append(Line2D([], [], color=GREY, lw=1.2, label="Cramér-Rao bound (joint)"))
    if scene.steady_from > 0.0:
        handles.append(Line2D([], [], color=INK, lw=0.8, ls=_DOTTED, label="steady state begins"))
    legend(figure, handles)
    return figure


def nees_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw NEES, averaged over the seeds at each instant, with the bounds that hold for it at each instant.

    Returns:
        None where no observer states a covariance.
    """
    groups = {name: own for name, own in board.samples_in(variant).items() if np.isfinite(own[0].series.nees[1:]).any()}
    if not groups:
        return None
    first = board.samples[0]
    scene, runs, dof = first.scene, len(board.seeds), first.nees_dof
    columns = fitting(width or PAGE, 3.0, min(3, len(groups)))
    rows = -(-len(groups) // columns)
    figure, _ = canvas(width, _FRAME + 1.5 * rows, f"{board.title}, {variant}")
    axes = [ax for line in panels(figure, rows, columns) for ax in line]
    low, high = mean_bounds(dof, runs)
    shown = _chosen(len(scene.vehicles), MOST_VEHICLES)
    for ax, (name, own) in zip(axes, groups.items(), strict=False):
        tidy(ax)
        ax.axhspan(low, high, color=SHADE, zorder=0)
        ax.axhline(1.0, color=GREY, linewidth=0.7)
        mean = np.mean([sample.series.nees for sample in own], axis=0) / dof
        for i in shown:
            values = np.clip(drawable(mean[:, i], positive=True), *NEES_RANGE)
            ax.plot(scene.t, values, color=vehicle_colour(i), linewidth=0.8)
        ax.set_yscale("log")
        _time(ax, scene.t)
        ax.set_title(name, fontsize=NORMAL, color=INK, pad=3)
    _share_decades(axes[: len(groups)])
    for n, ax in enumerate(axes):
        ax.set_visible(n < len(groups))
        _outer(ax, lowest=n + columns >= len(groups), leftmost=n % columns == 0)
    figure.supylabel(f"NEES / {dof}" + (", mean over runs" if runs > 1 else ""), **TEXT)
    vehicles = [Line2D([], [], color=vehicle_colour(i), lw=1.4, label=vehicle_label(scene.vehicles[i])) for i in shown]
    runs_word = f"{runs} run{'s' if runs > 1 else ''}"
    band = Patch(facecolor=SHADE, label=f"95 % of an honest one ($\\chi^2$, {runs_word}, at one instant)")
    legend(figure, [*vehicles, band])
    return figure


def _time(ax: Axes, t: np.ndarray) -> None:
    """Span the run, without the last label, which would touch that of the next panel."""
    ax.set_xlim(*time_span(t))
    ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], prune="upper"))


def _chosen(vehicles: int, most: int) -> list[int]:
    """Return which vehicles are drawn: all, or some from first to last."""
    return [int(i) for i in np.unique(np.linspace(0, vehicles - 1, min(vehicles, most)).round())]


def _share_decades(axes: Iterable[Axes]) -> None:
    """Give logarithmic axes the same range, whole decades, so that they can be compared."""
    shared = list(axes)
    drawn = [np.asarray(line.get_ydata(), float) for ax in shared for line in ax.get_lines()]
    values = np.concatenate([line for line in drawn if line.size > 2])  # and not what marks a level
    values = values[np.isfinite(values) & (values > 0)]
    low, high = np.quantile(values, (0.001, 0.999)) if len(values) else (0.1, 10.0)
    bottom, top = np.floor(np.log10(low)), max(np.ceil(np.log10(high)), np.floor(np.log10(low)) + 1)
    step = max(1, int(np.ceil((top - bottom) / 4)))
    for ax in shared:
        ax.set_ylim(10**bottom, 10**top)
        ax.set_yticks(10.0 ** np.arange(bottom, top + 1, step))
        ax.minorticks_off()


def _outer(ax: Axes, lowest: bool, leftmost: bool) -> None:
    """Label an axis only at the edge of the figure."""
    ax.tick_params(labelbottom=lowest, labelleft=leftmost)
    ax.set_xlabel("time [s]" if lowest else "", **TEXT)
