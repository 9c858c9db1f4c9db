"""The report's figures of whole runs: variants as a heat map, and cost against accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from coopenv.bench.leaderboard.figures import WIDTH
from coopenv.bench.leaderboard.rows import Row
from coopenv.bench.leaderboard.tables import by_observer, mean_rmse
from coopenv.viz.style import GREY, INK, SMALL, new_figure, tidy, vehicle_colour


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


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _bytes(rows: Sequence[Row]) -> float:
    return float(np.mean([row.bytes_per_s for row in rows]))


def _area(sent: float) -> float:
    """Return a marker's area (pt^2) for bytes per second."""
    return 28.0 + 0.9 * float(np.sqrt(sent))
