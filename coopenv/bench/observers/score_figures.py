"""The report's figures of whole runs: variants as a heat map, and cost against accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from coopenv.bench.observers.figures import WIDTH
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.tables import by_observer, mean_rmse
from coopenv.viz.style import BLUE, GREY, INK, SMALL, new_figure, tidy

Point = tuple[float, float, float, str]
"""Mean RMSE (m), time per update (us), bytes per second and name of an observer."""

_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
_AROUND = np.deg2rad([0.0, 180.0, 90.0, 270.0, 45.0, 315.0, 135.0, 225.0])
"""Where a number may stand beside its point."""
_ROOM = (12.0, 9.0)  # pt that a number takes


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
    height = 0.5 + 0.3 * len(groups)
    figure = new_figure(WIDTH, height)
    ax = figure.add_axes((0.19, 0.1 / height, 0.66, 1.0 - 0.45 / height))
    finite = table[np.isfinite(table)]
    if not len(finite):
        return None
    norm = LogNorm(finite.min(), max(finite.max(), finite.min() * 1.01))
    image = ax.imshow(table, cmap="viridis_r", norm=norm, aspect="auto")
    for (y, x), value in np.ndenumerate(table):
        worse = f"  ×{_short(value / table[y, 0])}" if x and variants[0] == "nominal" else ""
        dark = np.isfinite(value) and norm(value) > 0.55
        text = f"{_digits(value)}{worse}" if np.isfinite(value) else "failed"
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
    bar.ax.yaxis.set_major_formatter(_PLAIN)
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
        ax.scatter(micro, error, s=_area(sent), color=BLUE, alpha=0.5, linewidth=0.6, edgecolor="white", zorder=3 + n)
    bound = float(np.mean([row.bound_m for row in next(iter(groups.values()))]))
    if np.isfinite(bound):
        ax.axhline(bound, color=GREY, linewidth=1.0)
        ax.annotate(
            "bound (joint)", (0.005, bound), (0, 3), xycoords=("axes fraction", "data"), textcoords="offset points",
            ha="left", fontsize=SMALL, color=GREY,
        )  # fmt: skip
    ax.margins(0.12)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(_PLAIN)
        axis.set_minor_formatter(NullFormatter())
    _number_points(figure, ax, points)
    _key(figure, points)
    return figure


def _number_points(figure: Figure, ax: Axes, points: Sequence[Point]) -> None:
    """Number the points, each where there is room beside it."""
    figure.draw_without_rendering()  # which settles the scales
    taken: list[tuple[float, float]] = []
    for n, (error, micro, sent, _) in enumerate(points):
        x, y = ax.transData.transform((micro, error)) * 72.0 / figure.dpi
        reach = 0.6 * np.sqrt(_area(sent)) + 5.0
        around = [(x + r * np.cos(a), y + r * np.sin(a)) for r in (reach, 1.7 * reach, 2.4 * reach) for a in _AROUND]
        place = next((p for p in around if all(_apart(p, other) for other in taken)), around[0])
        taken.append(place)
        ax.annotate(
            str(n + 1), (micro, error), (place[0] - x, place[1] - y), textcoords="offset points", ha="center",
            va="center", fontsize=SMALL + 0.5, color=INK, zorder=30,
        )  # fmt: skip


def _apart(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return abs(one[0] - other[0]) > _ROOM[0] or abs(one[1] - other[1]) > _ROOM[1]


def _key(figure: Figure, points: Sequence[Point]) -> None:
    """List the numbered observers beside the plot."""
    ax = figure.add_axes((0.69, 0.05, 0.3, 0.9))
    ax.set(xlim=(0, 1), ylim=(max(len(points), 13), -1))
    ax.axis("off")
    style: dict[str, Any] = {"fontsize": SMALL + 0.5, "color": INK, "va": "center"}
    for x, heading in ((0.1, "by RMSE"), (1.0, "bytes/s sent")):
        ax.text(x, -0.6, heading, **style, ha="left" if x < 0.5 else "right", weight="bold")
    for n, (_, _, sent, name) in enumerate(points):
        ax.text(0.06, n + 0.3, str(n + 1), **style, ha="right")
        ax.text(0.1, n + 0.3, name, **style, ha="left")
        ax.text(1.0, n + 0.3, f"{sent:,.0f}", **style, ha="right")


def _short(value: float) -> str:
    return f"{value:#.2g}".rstrip(".") if value < 100 else f"{value:.0f}"


def _digits(value: float) -> str:
    return f"{value:#.3g}".rstrip(".") if value < 1000 else f"{value:.0f}"


def _bytes(rows: Sequence[Row]) -> float:
    return float(np.mean([row.bytes_per_s for row in rows]))


def _area(sent: float) -> float:
    """Return a marker's area (pt^2) for bytes per second."""
    return 28.0 + 0.9 * float(np.sqrt(sent))
