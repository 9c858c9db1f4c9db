"""The basin map: initial angle against initial distance, and the share that converges by angle."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coopenv.bench.observers.basin import ANGLE_BINS, RADIUS, Draw, basins_of, by_angle
from coopenv.estimation.consistency import wilson_interval
from coopenv.viz import style
from coopenv.viz.style import BLUE, INK, NORMAL, SMALL, VERMILION

_PANEL, _FRAME = 2.6, 0.6  # inches


def basin_figure(environment: str, draws: Sequence[Draw], width: float | None = None) -> Figure:
    """Draw, per observer, every vehicle of every draw at its initial errors, and the share by angle below."""
    basins = basins_of(environment, draws)
    columns = style.fitting(width or style.PAGE, 3.0, min(3, len(basins)))
    rows = -(-len(basins) // columns)
    figure, _ = style.canvas(width, _FRAME + _PANEL * rows, f"{environment}, {basins[0].draws} initial estimates")
    for n, ((cloud, bars), basin) in enumerate(zip(_pairs(figure, rows, columns, len(basins)), basins, strict=True)):
        own = [draw for draw in draws if draw.observer == basin.observer]
        _draw_cloud(cloud, own, first=n % columns == 0)
        _draw_shares(bars, own, first=n % columns == 0)
        low, high = (100 * end for end in basin.interval)
        share = f"all vehicles: {100 * basin.converged_fraction:.1f} %  [{low:.1f}, {high:.1f}]"
        cloud.set_title(f"{basin.observer}\n{share}", fontsize=SMALL + 0.5, color=INK, pad=3)
    handles = [
        Line2D([], [], ls="", marker="o", ms=4, color=BLUE, label="a vehicle that ends below 0.1 m and 1 deg"),
        Line2D([], [], ls="", marker="x", ms=4, color=VERMILION, label="one that does not"),
    ]
    style.legend_above(figure, handles)
    return figure


def _pairs(figure: Figure, rows: int, columns: int, count: int) -> list[tuple[Axes, Axes]]:
    """Return the two axes of every panel, one above the other."""
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[2, 1] * rows)
    places = [divmod(n, columns) for n in range(count)]
    clouds = [figure.add_subplot(grid[2 * y, x]) for y, x in places]
    bars = [figure.add_subplot(grid[2 * y + 1, x], sharex=clouds[n]) for n, (y, x) in enumerate(places)]
    return list(zip(clouds, bars, strict=True))


def _draw_cloud(ax: Axes, draws: Sequence[Draw], first: bool) -> None:
    style.tidy(ax, y_label="distance [m]" if first else "")
    angle = np.array([draw.initial_orientation_error_deg for draw in draws])
    distance = np.array([draw.initial_position_error_m for draw in draws])
    converged = np.array([draw.converged for draw in draws])
    ax.scatter(angle[converged], distance[converged], s=5, color=BLUE, linewidth=0, alpha=0.6)
    ax.scatter(angle[~converged], distance[~converged], s=8, color=VERMILION, marker="x", linewidth=0.6, alpha=0.7)
    ax.set(xlim=(0, 180), ylim=(0, RADIUS), xticks=ANGLE_BINS)
    ax.tick_params(labelbottom=False)


def _draw_shares(ax: Axes, draws: Sequence[Draw], first: bool) -> None:
    style.tidy(ax, x_label="initial orientation error [deg]", y_label="converged" if first else "")
    ax.xaxis.label.set_fontsize(NORMAL - 1)
    for (converged, count), start, end in zip(by_angle(draws), ANGLE_BINS, ANGLE_BINS[1:], strict=False):
        if count:
            share, (low, high) = converged / count, wilson_interval(converged, count)
            middle = (start + end) / 2
            ax.bar(middle, share, width=0.85 * (end - start), color=BLUE, alpha=0.35)
            ax.plot([middle, middle], [low, high], color=INK, linewidth=0.9)
    ax.set(ylim=(0, 1.02), yticks=(0, 0.5, 1))
