"""The report's figures over time: errors beside bounds and claims, and consistency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from coopenv.bench.observers.judge import Sample
from coopenv.estimation.consistency import mean_bounds
from coopenv.viz.style import (
    BLUE,
    GREY,
    INK,
    NORMAL,
    SHADE,
    SMALL,
    VERMILION,
    drawable,
    new_figure,
    tidy,
    time_span,
    vehicle_colour,
    vehicle_label,
)

MOST_VEHICLES = 6
NEES_RANGE = (1e-4, 1e4)
"""Of NEES over its dimension what is drawn; beyond it an observer is as wrong as it can be."""
WIDTH = 10.5  # inches
_HEAD, _FOOT = 0.75, 0.5  # inches above and below the panels
_DASHED, _DOTTED = (0, (4, 1.5)), (0, (1, 1))
_TEXT: dict[str, Any] = {"fontsize": NORMAL, "color": INK}
_NAMED = 16  # characters of a name on one line


def observers_of(samples: Sequence[Sample]) -> dict[str, list[Sample]]:
    """Return the samples of every observer that did not fail."""
    found: dict[str, list[Sample]] = {}
    for sample in samples:
        found.setdefault(sample.observer, []).append(sample)
    return {name: own for name, own in found.items() if not any(sample.failure for sample in own)}


def error_figure(samples: Sequence[Sample]) -> Figure | None:
    """Draw position errors against time of one variant: a row per observer, a column per vehicle.

    Median over the seeds of the error and of three standard deviations that the observer claims, beside the bound.
    """
    groups = observers_of(samples)
    if not groups:
        return None
    scene = samples[0].scene
    shown = _chosen(len(scene.vehicles))
    height = _HEAD + _FOOT + 1.05 * len(groups)
    figure, axes = _grid(len(groups), len(shown), height, left=0.17)
    for (name, own), line in zip(groups.items(), axes, strict=True):
        error = np.median([sample.series.position_error for sample in own], axis=0)
        spread = np.median([sample.series.position_std for sample in own], axis=0)
        bound = np.sqrt(np.mean([sample.scene.bound**2 for sample in own], axis=0))
        for ax, i in zip(line, shown, strict=True):
            tidy(ax)
            ax.set_yscale("log")
            for values, factor, colour, style, width in (
                (spread, 3.0, VERMILION, _DASHED, 1.0),
                (bound, 1.0, GREY, "-", 1.0),
                (error, 1.0, BLUE, "-", 0.9),
            ):
                ax.plot(
                    scene.t, drawable(factor * values[:, i], positive=True), color=colour, linestyle=style, lw=width
                )
            if scene.steady_from > 0.0:
                ax.axvline(scene.steady_from, color=INK, linewidth=0.6, linestyle=_DOTTED)
            _time(ax, scene.t)
        _row_title(line[0], name)
    _share_decades(axes)
    _outer_labels(axes, [vehicle_label(scene.vehicles[i]) for i in shown])
    figure.supylabel("position error [m]", x=0.004, **_TEXT)
    median = ", median over seeds" if len(next(iter(groups.values()))) > 1 else ""
    handles = [
        Line2D([], [], color=BLUE, lw=1.2, label=f"error{median}"),
        Line2D([], [], color=VERMILION, lw=1.2, ls=_DASHED, label=f"3 standard deviations claimed{median}"),
    ]
    if np.isfinite(scene.bound).any():
        handles.append(Line2D([], [], color=GREY, lw=1.2, label="Cramér-Rao bound (joint)"))
    if scene.steady_from > 0.0:
        handles.append(Line2D([], [], color=INK, lw=0.8, ls=_DOTTED, label="steady state begins"))
    _legend(figure, handles)
    return figure


def nees_figure(samples: Sequence[Sample]) -> Figure | None:
    """Draw NEES, averaged over the seeds at each instant, with the bounds that hold for it at each instant.

    Returns:
        None where no observer states a covariance.
    """
    groups = {name: own for name, own in observers_of(samples).items() if np.isfinite(own[0].series.nees[1:]).any()}
    if not groups:
        return None
    scene, columns = samples[0].scene, min(3, len(groups))
    rows = -(-len(groups) // columns)
    height = _HEAD + _FOOT + 1.5 * rows
    figure, axes = _grid(rows, columns, height, left=0.07, between=0.38)
    runs, dof = len(next(iter(groups.values()))), samples[0].nees_dof
    low, high = mean_bounds(dof, runs)
    for ax, (name, own) in zip(axes.flat, groups.items(), strict=False):
        tidy(ax)
        ax.axhspan(low, high, color=SHADE, zorder=0)
        ax.axhline(1.0, color=GREY, linewidth=0.7)
        mean = np.mean([sample.series.nees for sample in own], axis=0) / dof
        for i in _chosen(len(scene.vehicles)):
            shown = np.clip(drawable(mean[:, i], positive=True), *NEES_RANGE)
            ax.plot(scene.t, shown, color=vehicle_colour(i), linewidth=0.8)
        ax.set_yscale("log")
        _time(ax, scene.t)
        ax.set_title(name, fontsize=NORMAL, color=INK, pad=3)
    _share_decades(axes)
    for ax in axes.flat[len(groups) :]:
        ax.set_visible(False)
    for n, ax in enumerate(axes.flat[: len(groups)]):
        lowest = n + columns >= len(groups)
        ax.tick_params(labelbottom=lowest, labelleft=n % columns == 0)
        ax.set_xlabel("time [s]" if lowest else "", fontsize=NORMAL, color=INK)
    figure.supylabel(f"NEES / {dof}" + (", mean over runs" if runs > 1 else ""), x=0.004, **_TEXT)
    vehicles = [
        Line2D([], [], color=vehicle_colour(i), lw=1.4, label=vehicle_label(scene.vehicles[i]))
        for i in _chosen(len(scene.vehicles))
    ]
    runs_word = f"{runs} run{'s' if runs > 1 else ''}"
    band = Patch(facecolor=SHADE, label=f"95 % of an honest one ($\\chi^2$, {runs_word}, at one instant)")
    _legend(figure, [*vehicles, band])
    return figure


def _time(ax: Axes, t: np.ndarray) -> None:
    """Span the run, without the last label, which would touch that of the next panel."""
    ax.set_xlim(*time_span(t))
    ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], prune="upper"))


def _chosen(vehicles: int) -> list[int]:
    """Return which vehicles are drawn: all, or some from first to last."""
    result: list[int] = np.unique(
        np.linspace(0, vehicles - 1, min(vehicles, MOST_VEHICLES)).round().astype(int)
    ).tolist()
    return result


def _grid(rows: int, columns: int, height: float, left: float, between: float = 0.14) -> tuple[Figure, np.ndarray]:
    figure = new_figure(WIDTH, height)
    axes = figure.subplots(
        rows,
        columns,
        squeeze=False,
        gridspec_kw={
            "left": left,
            "right": 0.99,
            "bottom": _FOOT / height,
            "top": 1 - _HEAD / height,
            "wspace": 0.07,
            "hspace": between,
        },
    )
    return figure, axes


def _row_title(ax: Axes, name: str) -> None:
    """Write an observer's name, on two lines if it is long, left of its row."""
    if len(name) > _NAMED and "_" in name:
        name = name.replace("_", "_\n", 1)
    ax.set_ylabel(name, fontsize=NORMAL, rotation=0, ha="right", va="center", labelpad=4, color=INK)


def _share_decades(axes: np.ndarray) -> None:
    """Give logarithmic axes the same range, whole decades, so that they can be compared."""
    drawn = [np.asarray(line.get_ydata(), float) for ax in axes.flat for line in ax.get_lines()]
    values = np.concatenate([line for line in drawn if line.size > 2])  # and not what marks a level
    values = values[np.isfinite(values) & (values > 0)]
    low, high = np.quantile(values, (0.001, 0.999)) if len(values) else (0.1, 10.0)
    bottom, top = np.floor(np.log10(low)), max(np.ceil(np.log10(high)), np.floor(np.log10(low)) + 1)
    step = max(1, int(np.ceil((top - bottom) / 4)))
    ticks = 10.0 ** np.arange(bottom, top + 1, step)
    for ax in axes.flat:
        ax.set_ylim(10**bottom, 10**top)
        ax.set_yticks(ticks)
        ax.minorticks_off()


def _outer_labels(axes: np.ndarray, titles: Sequence[str]) -> None:
    for y, line in enumerate(axes):
        for x, ax in enumerate(line):
            last = y == len(axes) - 1
            ax.tick_params(labelbottom=last, labelleft=x == 0)
            ax.set_xlabel("time [s]" if last else "", fontsize=NORMAL, color=INK)
            if y == 0:
                ax.set_title(titles[x], fontsize=NORMAL + 2, color=INK, pad=4)


def _legend(figure: Figure, handles: list[Any]) -> None:
    height = figure.get_size_inches()[1]
    figure.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.55, 1 - 0.04 / height),
        ncols=len(handles),
        fontsize=SMALL + 0.5,
        frameon=False,
        handlelength=2.2,
        columnspacing=1.6,
    )
