"""The report's figures: errors against time, consistency, faults, cost against accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from coopenv.bench.leaderboard.judge import Sample
from coopenv.bench.leaderboard.rows import Row
from coopenv.bench.leaderboard.tables import by_observer, mean_rmse
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
    figure, axes = _grid(len(groups), len(shown), height, left=0.15)
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
            ax.axvline(scene.steady_from, color=INK, linewidth=0.6, linestyle=_DOTTED)
            _time(ax, scene.t)
        _row_title(line[0], name)
    _share_decades(axes)
    _outer_labels(axes, [vehicle_label(scene.vehicles[i]) for i in shown])
    axes[0, 0].text(0.0, 1.06, "position error [m]", transform=axes[0, 0].transAxes, ha="right", **_TEXT)
    _legend(
        figure,
        [
            Line2D([], [], color=BLUE, lw=1.2, label="error, median over seeds"),
            Line2D([], [], color=VERMILION, lw=1.2, ls=_DASHED, label="3 standard deviations claimed, median"),
            Line2D([], [], color=GREY, lw=1.2, label="Cramér-Rao bound (joint)"),
            Line2D([], [], color=INK, lw=0.8, ls=_DOTTED, label="steady state begins"),
        ],
    )
    return figure


def nees_figure(samples: Sequence[Sample]) -> Figure | None:
    """Draw NEES, averaged over the seeds at each instant, with the bounds that hold for it at each instant.

    Returns:
        None where no observer states a covariance.
    """
    groups = {name: own for name, own in observers_of(samples).items() if np.isfinite(own[0].series.nees[1:]).any()}
    if not groups:
        return None
    scene, columns = samples[0].scene, 3
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
            ax.plot(scene.t, drawable(mean[:, i], positive=True), color=vehicle_colour(i), linewidth=0.8)
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
    figure.supylabel(f"NEES / {dof}, mean over runs", fontsize=NORMAL, color=INK, x=0.006)
    vehicles = [
        Line2D([], [], color=vehicle_colour(i), lw=1.4, label=vehicle_label(scene.vehicles[i]))
        for i in _chosen(len(scene.vehicles))
    ]
    runs_word = f"{runs} run{'s' if runs > 1 else ''}"
    band = Patch(facecolor=SHADE, label=f"95 % of an honest one ($\\chi^2$, {runs_word}, at one instant)")
    _legend(figure, [*vehicles, band])
    return figure


def variant_figure(rows: Sequence[Row]) -> Figure | None:
    """Draw a heat map of the mean position RMSE: a row per observer, a column per variant.

    Returns:
        None where there is one variant only.
    """
    variants = list(dict.fromkeys(row.variant for row in rows))
    if len(variants) < 2:
        return None
    groups = by_observer(rows)
    table = np.full((len(groups), len(variants)), np.nan)
    for y, own in enumerate(groups.values()):
        for x, variant in enumerate(variants):
            table[y, x] = mean_rmse([row for row in own if row.variant == variant])
    height = 0.9 + 0.32 * len(groups)
    figure = new_figure(WIDTH, height + 0.35)
    ax = figure.add_axes((0.19, 0.35 / (height + 0.35), 0.66, (height - 0.6) / (height + 0.35)))
    finite = table[np.isfinite(table)]
    if not len(finite):
        return None
    norm = LogNorm(finite.min(), max(finite.max(), finite.min() * 1.01))
    image = ax.imshow(table, cmap="viridis_r", norm=norm, aspect="auto")
    for (y, x), value in np.ndenumerate(table):
        worse = f"  ×{_short(value / table[y, 0])}" if x and variants[0] == "nominal" else ""
        dark = np.isfinite(value) and norm(value) > 0.55
        text = f"{value:.3g}{worse}" if np.isfinite(value) else "failed"
        ax.text(x, y, text, ha="center", va="center", fontsize=SMALL + 0.5, color="white" if dark else INK)
    ax.set_xticks(range(len(variants)), variants, fontsize=SMALL + 0.5)
    ax.set_yticks(range(len(groups)), list(groups), fontsize=SMALL + 0.5)
    ax.xaxis.tick_top()
    ax.tick_params(length=0, colors=INK)
    for side in ax.spines.values():
        side.set_visible(False)
    bar = figure.colorbar(image, cax=figure.add_axes((0.87, ax.get_position().y0, 0.015, ax.get_position().height)))
    bar.set_label("mean RMSE [m]" + (", × nominal" if variants[0] == "nominal" else ""), fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, colors=INK)
    return figure


def cost_figure(rows: Sequence[Row]) -> Figure | None:
    """Draw the mean position RMSE of one variant against the time of an update; the area tells the bytes sent."""
    groups = {name: own for name, own in by_observer(rows).items() if not any(row.failure for row in own)}
    if not groups:
        return None
    figure = new_figure(WIDTH, 4.6)
    ax = figure.add_axes((0.07, 0.12, 0.6, 0.82))
    tidy(ax, x_label="time per update [µs]", y_label="mean position RMSE [m]")
    ax.set_xscale("log")
    ax.set_yscale("log")
    points = sorted(
        (mean_rmse(own), float(np.mean([row.us_per_update for row in own])), _bytes(own), name)
        for name, own in groups.items()
    )
    for n, (error, micro, sent, _) in enumerate(points):
        colour = vehicle_colour(n)
        ax.scatter(
            micro, error, s=_area(sent), color=colour, alpha=0.75, linewidth=0.6, edgecolor="white", zorder=3 + n
        )
        ax.annotate(
            str(n + 1), (micro, error), (0.72 * np.sqrt(_area(sent)) + 1.5, 0), textcoords="offset points",
            fontsize=SMALL + 0.5, color=INK, va="center", zorder=30,
        )  # fmt: skip
    bound = float(np.mean([row.bound_m for row in next(iter(groups.values()))]))
    if np.isfinite(bound):
        ax.axhline(bound, color=GREY, linewidth=1.0)
        ax.annotate(
            "bound (joint)", (0.995, bound), (0, 3), xycoords=("axes fraction", "data"), textcoords="offset points",
            ha="right", fontsize=SMALL, color=GREY,
        )  # fmt: skip
    ax.margins(0.12)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    _key(figure, points)
    return figure


def _key(figure: Figure, points: Sequence[tuple[float, float, float, str]]) -> None:
    """List the numbered observers beside the plot."""
    ax = figure.add_axes((0.69, 0.05, 0.3, 0.9))
    ax.set(xlim=(0, 1), ylim=(max(len(points), 13), -1))
    ax.axis("off")
    style: dict[str, Any] = {"fontsize": SMALL + 0.5, "color": INK, "va": "center"}
    for x, heading in ((0.12, "by RMSE"), (1.0, "bytes/s sent")):
        ax.text(x, -0.6, heading, **style, ha="left" if x < 0.5 else "right", weight="bold")
    for n, (_, _, sent, name) in enumerate(points):
        ax.plot(0.07, n + 0.3, "o", color=vehicle_colour(n), markersize=5, alpha=0.75)
        ax.text(0.04, n + 0.3, str(n + 1), **style, ha="right")
        ax.text(0.12, n + 0.3, name, **style, ha="left")
        ax.text(1.0, n + 0.3, f"{sent:,.0f}", **style, ha="right")


def _time(ax: Axes, t: np.ndarray) -> None:
    """Span the run, without the last label, which would touch that of the next panel."""
    ax.set_xlim(*time_span(t))
    ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], prune="upper"))


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _bytes(rows: Sequence[Row]) -> float:
    return float(np.mean([row.bytes_per_s for row in rows]))


def _area(sent: float) -> float:
    """Return a marker's area (pt^2) for bytes per second."""
    return 28.0 + 0.9 * float(np.sqrt(sent))


def _chosen(vehicles: int) -> list[int]:
    """Return which vehicles are drawn: all, or some from first to last."""
    return np.unique(np.linspace(0, vehicles - 1, min(vehicles, MOST_VEHICLES)).round().astype(int)).tolist()


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


def _legend(figure: Figure, handles: list) -> None:
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
