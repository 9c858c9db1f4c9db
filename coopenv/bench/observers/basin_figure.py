"""The basin map: initial angle against initial distance, and the share that converges by angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coopenv.bench.observers.basin import ANGLE_BINS, RADIUS, Draw, basins_of, by_angle
from coopenv.bench.observers.figures import WIDTH
from coopenv.estimation.consistency import wilson_interval
from coopenv.viz.style import BLUE, INK, NORMAL, SMALL, VERMILION, new_figure, tidy

_MOST_COLUMNS = 3
_PANEL, _HEAD = 2.9, 0.35  # inches


def basin_figure(draws: Sequence[Draw]) -> Figure:
    """Draw, per observer, every vehicle of every draw at its initial errors, and the share by angle below."""
    basins = basins_of("", draws)
    columns = min(_MOST_COLUMNS, len(basins))
    rows, step = -(-len(basins) // columns), 0.96 / columns
    height = _HEAD + _PANEL * rows
    figure = new_figure(WIDTH, height)
    for n, basin in enumerate(basins):
        own = [draw for draw in draws if draw.observer == basin.observer]
        left = 0.06 + (n % columns) * step
        bottom = 1 - (_HEAD + _PANEL * (n // columns + 1)) / height
        cloud = figure.add_axes((left, bottom + 1.3 / height, step - 0.05, 1.2 / height))
        bars = figure.add_axes((left, bottom + 0.5 / height, step - 0.05, 0.65 / height), sharex=cloud)
        _draw_cloud(cloud, own, first=n % columns == 0)
        _draw_shares(bars, own, first=n % columns == 0)
        low, high = (100 * end for end in basin.interval)
        share = f"all vehicles: {100 * basin.converged_fraction:.1f} %  [{low:.1f}, {high:.1f}]"
        cloud.set_title(f"{basin.observer}\n{share}", fontsize=SMALL + 0.5, color=INK, pad=3)
    figure.legend(
        handles=[
            Line2D([], [], ls="", marker="o", ms=4, color=BLUE, label="a vehicle that ends below 0.1 m and 1 deg"),
            Line2D([], [], ls="", marker="x", ms=4, color=VERMILION, label="one that does not"),
        ],
        loc="upper center",
        ncols=2,
        fontsize=SMALL + 0.5,
        frameon=False,
    )
    return figure


def _draw_cloud(ax: Axes, draws: Sequence[Draw], first: bool) -> None:
    tidy(ax, y_label="distance [m]" if first else "")
    angle = np.concatenate([draw.initial_angle for draw in draws])
    distance = np.concatenate([draw.initial_distance for draw in draws])
    converged = np.concatenate([draw.converged for draw in draws])
    ax.scatter(angle[converged], distance[converged], s=5, color=BLUE, linewidth=0, alpha=0.6)
    ax.scatter(angle[~converged], distance[~converged], s=8, color=VERMILION, marker="x", linewidth=0.6, alpha=0.7)
    ax.set(xlim=(0, 180), ylim=(0, RADIUS), xticks=ANGLE_BINS)
    ax.tick_params(labelbottom=False)


def _draw_shares(ax: Axes, draws: Sequence[Draw], first: bool) -> None:
    tidy(ax, x_label="initial orientation error [deg]", y_label="converged" if first else "")
    ax.xaxis.label.set_fontsize(NORMAL - 1)
    for (converged, count), start, end in zip(by_angle(draws), ANGLE_BINS, ANGLE_BINS[1:], strict=False):
        if count:
            share, (low, high) = converged / count, wilson_interval(converged, count)
            middle = (start + end) / 2
            ax.bar(middle, share, width=0.85 * (end - start), color=BLUE, alpha=0.35)
            ax.plot([middle, middle], [low, high], color=INK, linewidth=0.9)
    ax.set(ylim=(0, 1.02), yticks=(0, 0.5, 1))
