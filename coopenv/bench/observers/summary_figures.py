"""Figures of whole runs: variants as a heat map, and cost against accuracy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from coopenv.bench.observers.canvas import NOTE, TEXT, canvas
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.tables import BOUNDS, FAILED, bounded
from coopenv.format import number
from coopenv.viz.style import BLUE, GREY, INK, SMALL, tidy

_WIDE_CELL = 1.0  # inches, of a cell that has room for a ratio too
_LETTER = 0.55 * (SMALL + 0.5)  # pt, mean width
_LINE = 1.3 * (SMALL + 0.5)  # pt


class Point(NamedTuple):
    """An observer's cost and accuracy."""

    rmse: float  # m, mean over the vehicles
    microseconds: float  # per update
    sent: float  # bytes per second
    observer: str


def variant_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw a heat map of the mean position RMSE: a row per observer, a column per variant (all of them).

    Returns:
        None where there is one variant only, or everybody failed.
    """
    variants, names = list(board.variants), board.ranked
    table = np.array([[board.totals[variant, name].rmse.value for variant in variants] for name in names])
    finite = table[np.isfinite(table)]
    if len(variants) < 2 or not len(finite):
        return None
    figure, inches = canvas(width, 0.9 + 0.3 * len(names), board.title)
    ax = figure.add_subplot()
    norm = LogNorm(finite.min(), max(finite.max(), finite.min() * 1.01))
    image = ax.imshow(table, cmap="viridis_r", norm=norm, aspect="auto")
    relative = variants[0] == NOMINAL and inches > _WIDE_CELL * (len(variants) + 2)
    for (y, x), value in np.ndenumerate(table):
        worse = f"  ×{number(value / table[y, 0], 2)}" if x and relative else ""
        dark = np.isfinite(value) and norm(value) > 0.55
        text = f"{number(float(value), 3)}{worse}" if np.isfinite(value) else FAILED
        ax.text(x, y, text, ha="center", va="center", fontsize=SMALL + 0.5, color="white" if dark else INK)
    ax.set_xticks(range(len(variants)), variants, fontsize=SMALL + 0.5)
    ax.set_yticks(range(len(names)), names, fontsize=SMALL + 0.5)
    ax.xaxis.tick_top()
    ax.tick_params(length=0, colors=INK)
    ax.spines[:].set_visible(False)
    bar = figure.colorbar(image, ax=ax, fraction=0.05, aspect=40, pad=0.01)
    bar.ax.set_title("worse", fontsize=SMALL, color=INK)
    bar.ax.set_xlabel("better", fontsize=SMALL, color=INK)
    bar.set_label("mean RMSE [m]" + (", × nominal" if relative else ""), fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, colors=INK)
    _plain(bar.ax.yaxis)
    return figure


def cost_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw the mean position RMSE of a variant against the time of an update; the area tells the bytes sent.

    Returns:
        None where every observer failed.
    """
    points = [_point(board, variant, name) for name in board.samples_in(variant)]
    if not points:
        return None
    figure, _ = canvas(width, 4.6, f"{board.title}, {variant}")
    ax = figure.add_subplot()
    tidy(ax, x_label="time per update [µs]", y_label="mean position RMSE [m]")
    ax.set_xscale("log")
    ax.set_yscale("log")
    for n, point in enumerate(points):
        size = _area(point.sent)
        ax.scatter(point.microseconds, point.rmse, s=size, color=BLUE, alpha=0.5, edgecolor="white", zorder=3 + n)
    if joint := bounded(board, variant).get("bound_m"):
        bound = float(np.mean(joint))
        ax.axhline(bound, color=GREY, linewidth=1.0)
        corner = ("axes fraction", "data")
        ax.annotate(
            BOUNDS["bound_m"], (0.005, bound), (0, 3), xycoords=corner, textcoords="offset points", fontsize=SMALL,
            color=NOTE,
        )  # fmt: skip
    ax.margins(0.16, 0.12)
    _plain(ax.xaxis)
    _plain(ax.yaxis)
    figure.draw_without_rendering()  # which settles the scales
    _name_points(ax, points)
    return figure


def _plain(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _point(board: Leaderboard, variant: str, name: str) -> Point:
    rows = board.rows_in(variant, name)
    micro, sent = (
        float(np.mean([getattr(row, column) for row in rows])) for column in ("us_per_update", "bytes_per_s")
    )
    return Point(board.totals[variant, name].rmse.value, micro, sent, name)


def _area(sent: float) -> float:
    """Return a marker's area (pt^2) for bytes per second."""
    return 28.0 + 0.9 * float(np.sqrt(sent))


def _name_points(ax: Axes, points: list[Point]) -> None:
    """Write each observer's name beside its point, where no other name or point is in the way if there is room."""
    places = [ax.transData.transform((p.microseconds, p.rmse)) * 72.0 / ax.figure.dpi for p in points]
    taken = [(x - 4.0, y - 4.0, x + 4.0, y + 4.0) for x, y in places]
    for (x, y), point in zip(places, points, strict=True):
        reach, length = 0.6 * np.sqrt(_area(point.sent)) + 2.0, _LETTER * len(point.observer)
        boxes = []
        for down in (0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0):
            top = y + _LINE * (0.5 - down)
            for left in (x + reach, x - reach - length):
                boxes.append((left, top - _LINE, left + length, top))
        box = next((b for b in boxes if not any(_overlap(b, other) for other in taken)), boxes[0])
        taken.append(box)
        offset = (box[0] - x, (box[1] + box[3]) / 2 - y)
        ax.annotate(
            point.observer, (point.microseconds, point.rmse), offset, textcoords="offset points", va="center",
            zorder=30, **{**TEXT, "fontsize": SMALL + 0.5},
        )  # fmt: skip


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
