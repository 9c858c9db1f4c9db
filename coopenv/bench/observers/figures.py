"""The figures of a comparison: errors and consistency over time, variants as a heat map, cost against accuracy.

plotly.js (MIT) stands beside the page's template as its authors publish it, from `npm pack plotly.js-basic-dist-min`:
the bundle that the Python package brings is four times as large.
"""

import json
from base64 import b64encode
from collections.abc import Callable, Sequence
from gzip import compress
from importlib.resources import files
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from coopenv.base.format import jsonable, number
from coopenv.bench.observers.convergence import ANGLE_BINS, RADIUS, Draw, by_angle
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.judge import LEVEL_BINS, JudgedRun
from coopenv.bench.observers.rows import BOUNDS, Leaderboard
from coopenv.bench.observers.tables import FAILED, level_figures, mean_of, short_name
from coopenv.estimation.metrics import mean_bounds, wilson_interval
from coopenv.estimation.poses import Array
from coopenv.viz import style
from coopenv.viz.style import (
    BLUE,
    GREY,
    INK,
    NORMAL,
    SHADE,
    SMALL,
    VEHICLE_COLOURS,
    VERMILION,
    contrast,
    place_names,
    vehicle_colour,
    vehicle_label,
)

MOST_VEHICLES = 6
NEES_RANGE = (1e-4, 1e4)
"""Range of NEES over its dimension that is drawn; beyond it an observer is as wrong as it can be."""
_WIDE_CELL = 1.0  # inches, of a cell that has room for a ratio too
_NAME = SMALL + 0.5  # pt
_FRAME = 1.15  # inches above and below the panels
_DASHED, _DOTTED = (0, (4, 1.5)), (0, (1, 1))


def _curves(samples: Sequence[JudgedRun]) -> dict[str, Array]:
    """Return (S, N) medians over the seeds of errors and claims, m, and the mean NEES over its dimension."""
    error, std, nees = (np.array(values) for values in zip(*(sample.series for sample in samples), strict=True))
    mean = np.mean(nees, axis=0) / samples[0].nees_dof
    return {"error": np.median(error, axis=0), "std": 3.0 * np.median(std, axis=0), "nees": mean}


def _bound(samples: Sequence[JudgedRun]) -> Array:
    """Return (S, N) the joint bound over the seeds, m."""
    return np.asarray(np.sqrt(np.mean([sample.scene.bound**2 for sample in samples], axis=0)))


def error_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw position errors against time, a row per observer, a column per vehicle; None where every observer failed.

    Median over the seeds of the error and of three standard deviations that the observer claims, beside the bound.
    """
    groups = board.samples_in(variant)
    if not groups:
        return None
    scene = board.samples[0].scene
    figure, inches = style.canvas(width, _FRAME + 1.05 * len(groups), f"{board.title}, {variant}")
    shown = _shown(figure, board, style.fitting(inches, 1.6, MOST_VEHICLES))
    axes = figure.subplots(len(groups), len(shown), squeeze=False)
    for (name, own), line in zip(groups.items(), axes, strict=True):
        curves, bound = _curves(own), _bound(own)
        looks = (curves["std"], VERMILION, _DASHED, 1.0), (bound, GREY, "-", 1.0), (curves["error"], BLUE, "-", 0.9)
        for ax, i in zip(line, shown, strict=True):
            style.tidy(ax)
            ax.set_yscale("log")
            for values, colour, dashes, width_pt in looks:
                drawn = style.drawable(values[:, i], positive=True)
                ax.plot(scene.t, drawn, color=colour, linestyle=dashes, lw=width_pt)
            if scene.steady_from > 0.0:
                ax.axvline(scene.steady_from, color=INK, linewidth=0.6, linestyle=_DOTTED)
        line[0].set_ylabel(short_name(name), rotation=0, ha="right", va="center", labelpad=4, **style.TEXT)
    _share_axes(axes.ravel(), len(shown), scene.t)
    for ax, i in zip(axes[0], shown, strict=True):
        ax.set_title(vehicle_label(scene.vehicles[i]), fontsize=NORMAL + 2, color=INK, pad=4)
    figure.supylabel("position error [m], log", **style.TEXT)
    median = ", median over seeds" if len(board.seeds) > 1 else ""
    marks = style.marks(
        (True, f"error{median}", {"color": BLUE, "lw": 1.2}),
        (True, f"3 standard deviations claimed{median}", {"color": VERMILION, "lw": 1.2, "ls": _DASHED}),
        (np.isfinite(scene.bound).any(), "Cramér-Rao bound (joint)", {"color": GREY, "lw": 1.2}),
        (scene.steady_from > 0.0, "steady state begins", {"color": INK, "lw": 0.8, "ls": _DOTTED}),
    )
    style.legend_above(figure, marks)
    return figure


def nees_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw NEES, averaged over the seeds at each instant, with the bounds that hold for it at each instant.

    None where no observer states a covariance.
    """
    groups = {name: own for name, own in board.samples_in(variant).items() if np.isfinite(own[0].series.nees[1:]).any()}
    if not groups:
        return None
    first = board.samples[0]
    scene, runs, dof = first.scene, board.runs, first.nees_dof
    columns = style.fitting(width or style.PAGE, 3.0, min(3, len(groups)))
    rows = -(-len(groups) // columns)
    figure, _ = style.canvas(width, _FRAME + 1.5 * rows, f"{board.title}, {variant}")
    axes = style.panels(figure, len(groups), columns)
    shown = _shown(figure, board, MOST_VEHICLES)
    for ax, (name, own) in zip(axes, groups.items(), strict=True):
        style.tidy(ax)
        ax.axhspan(*mean_bounds(dof, runs), color=SHADE, zorder=0)
        ax.axhline(1.0, color=GREY, linewidth=0.7)
        mean = _curves(own)["nees"]
        for i in shown:
            values = np.clip(style.drawable(mean[:, i], positive=True), *NEES_RANGE)
            ax.plot(scene.t, values, color=vehicle_colour(i), linewidth=0.8)
        ax.set_yscale("log")
        ax.set_title(name, fontsize=NORMAL, color=INK, pad=3)
    _share_axes(axes, columns, scene.t)
    figure.supylabel(f"NEES / {dof}, log" + (", mean over runs" if runs > 1 else ""), **style.TEXT)
    vehicles = [Line2D([], [], color=vehicle_colour(i), lw=1.4, label=vehicle_label(scene.vehicles[i])) for i in shown]
    runs_word = f"{runs} run{'s' if runs > 1 else ''}"
    band = Patch(facecolor=SHADE, label=f"95 % of a consistent observer ($\\chi^2$, {runs_word}, at one instant)")
    style.legend_above(figure, [*vehicles, band])
    return figure


def _shown(figure: Figure, board: Leaderboard, most: int) -> list[int]:
    """Return the indices of at most so many vehicles; the figure's note states how many of them are shown."""
    names = board.samples[0].scene.vehicles
    shown: list[int] = style.thinned(len(names), most).tolist()
    if len(shown) < len(names):
        style.sign(figure, f"{len(shown)} of {len(names)} vehicles")
    return shown


def _share_axes(axes: np.ndarray, columns: int, t: np.ndarray) -> None:
    """Give panels, row by row, the same time and the same whole decades, and label them at the figure's edge."""
    drawn = [np.asarray(line.get_ydata(), float) for ax in axes for line in ax.get_lines()]
    values = np.concatenate([line for line in drawn if line.size > 2])  # and not what marks a level
    values = values[np.isfinite(values) & (values > 0)]
    low, high = np.quantile(values, (0.001, 0.999)) if len(values) else (0.1, 10.0)
    bottom, top = np.floor(np.log10(low)), max(np.ceil(np.log10(high)), np.floor(np.log10(low)) + 1)
    step = max(1, int(np.ceil((top - bottom) / 4)))
    for n, ax in enumerate(axes):
        ax.set(ylim=(10**bottom, 10**top), yticks=10.0 ** np.arange(bottom, top + 1, step))
        ax.minorticks_off()
        lowest = n + columns >= len(axes)
        style.time_axis(ax, t, labelled=lowest)
        # Without the last label, which would touch that of the next panel.
        ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], prune="upper"))
        ax.tick_params(labelleft=n % columns == 0)


def variant_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw a heat map of the mean position RMSE: a row per observer, a column per variant (all of them).

    None where there is one variant only, or every observer failed.
    """
    variants, names = list(board.variants), board.ranked
    table = np.array([[board.totals[variant, name].rmse.value for variant in variants] for name in names])
    finite = table[np.isfinite(table)]
    if len(variants) < 2 or not len(finite):
        return None
    figure, inches = style.canvas(width, 0.9 + 0.3 * len(names), board.title)
    ax = figure.add_subplot()
    norm = LogNorm(finite.min(), max(finite.max(), finite.min() * 1.01))
    image = ax.imshow(table, cmap="viridis_r", norm=norm, aspect="auto")
    relative = variants[0] == NOMINAL and inches > _WIDE_CELL * (len(variants) + 2)
    for (y, x), value in np.ndenumerate(table):
        worse = f"  ×{number(value / table[y, 0], 2)}" if x and relative else ""
        behind = image.cmap(norm(value))[:3] if np.isfinite(value) else (1.0, 1.0, 1.0)
        ink = max(("white", "black"), key=lambda colour: contrast(colour, behind))
        text = f"{number(float(value), 3)}{worse}" if np.isfinite(value) else FAILED
        ax.text(x, y, text, ha="center", va="center", fontsize=_NAME, color=ink)
    ax.set_xticks(range(len(variants)), variants, fontsize=_NAME)
    ax.set_yticks(range(len(names)), names, fontsize=_NAME)
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
    """Draw the mean position RMSE of a variant against the time of an update; the area shows the bytes sent.

    None where every observer failed.
    """
    names = list(board.samples_in(variant))
    if not names:
        return None
    figure, _ = style.canvas(width, 4.6, f"{board.title}, {variant}")
    ax = figure.add_subplot()
    style.tidy(ax, x_label="time per update [µs], log", y_label="mean position RMSE [m], log")
    ax.set(xscale="log", yscale="log")
    rows = [board.rows_in(variant, name) for name in names]
    micro, sent = ([mean_of(own, column) for own in rows] for column in ("us_per_update", "bytes_per_s"))
    points = np.stack([micro, [board.totals[variant, name].rmse.value for name in names]], axis=-1)
    ax.scatter(micro, points[:, 1], s=28.0 + 0.9 * np.sqrt(sent), color=BLUE, alpha=0.5, edgecolor="white", zorder=3)
    if joint := board.bounds_in(variant).get("bound_m"):
        bound = float(np.mean(joint))
        ax.axhline(bound, color=GREY, linewidth=1.0)
        place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        ax.annotate(BOUNDS["bound_m"], (0.005, bound), (0, 3), fontsize=SMALL, color=style.NOTE, **place)
    ax.margins(0.16, 0.12)
    _plain(ax.xaxis)
    _plain(ax.yaxis)
    figure.draw_without_rendering()  # which settles the scales
    places = ax.transData.transform(points)
    look = {**style.TEXT, "fontsize": _NAME, "textcoords": "offset points", "zorder": 30}
    for name, point, offset in zip(names, points, place_names(names, places, places, places[:0], _NAME), strict=True):
        ax.annotate(name, point, offset, **look)
    return figure


def stanford_figure(board: Leaderboard, variant: str, width: float | None = None) -> Figure | None:
    """Draw Stanford diagrams: vehicle ticks by horizontal error and protection level, a panel per observer.

    None where no observer states a level that is known.
    """
    figures = level_figures(board, variant)
    counts = {name: np.sum([s.stanford for s in board.groups[variant, name]], axis=0) for name in figures}
    counts = {name: of for name, of in counts.items() if of.any()}
    if not counts:
        return None
    columns = style.fitting(width or style.PAGE, _SQUARE, min(3, len(counts)))
    rows = -(-len(counts) // columns)
    figure, inches = style.canvas(width or min(style.PAGE, 1.6 + 4.0 * columns), 1.0, f"{board.title}, {variant}")
    figure.set_figheight(_FRAME + rows * (inches - 1.3) / columns)
    axes = style.panels(figure, len(counts), columns)
    used = np.flatnonzero(np.sum([of + of.T for of in counts.values()], axis=0).any(axis=0))
    low, high = (float(10.0**ends) for ends in (np.floor(_DECADE[used[0]]), np.ceil(_DECADE[used[-1] + 1])))
    norm = LogNorm(1.0, max(10.0, *(float(of.max()) for of in counts.values())))
    ends = np.array([low, high])
    for n, (ax, (name, of)) in enumerate(zip(axes, counts.items(), strict=True)):
        exceeded, _, unknown, _ = figures[name]
        below, left = n + columns >= len(counts), n % columns == 0
        style.tidy(ax, x_label="horizontal error [m], log" * below, y_label="protection level [m], log" * left)
        ax.fill_between(ends, low, ends, color=VERMILION, alpha=0.14, linewidth=0, zorder=0)
        image = ax.pcolormesh(LEVEL_BINS, LEVEL_BINS, np.where(of > 0, of, np.nan).T, norm=norm, cmap="viridis_r")
        ax.plot(ends, ends, color=INK, linewidth=1.0)
        ax.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal")
        words = f"{name}\nexceeded {_share(exceeded.value)} %, unknown {_share(unknown.value)} %"
        ax.set_title(words, fontsize=SMALL + 0.5, color=INK, pad=3)
    bar = figure.colorbar(image, ax=axes.tolist(), fraction=0.05, aspect=30, pad=0.01)
    bar.set_label("vehicle ticks", fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, colors=INK)
    marks = style.marks(
        (True, "error = protection level", {"color": INK, "lw": 1.0}),
        (True, "level exceeded", {"facecolor": VERMILION, "alpha": 0.14}),
    )
    style.legend_above(figure, marks)
    return figure


_SQUARE = 3.2  # inches, least side of a Stanford diagram with its labels
_DECADE = np.log10(LEVEL_BINS).round(6)


def _share(percent: float) -> str:
    """Return a share in % with two digits; a plain zero where there is none."""
    return number(percent, 2) if percent else "0"


def _plain(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


KINDS: dict[str, Callable[[Leaderboard, str, float | None], Figure | None]] = {
    "errors": error_figure,
    "consistency": nees_figure,
    "variants": variant_figure,
    "cost": cost_figure,
    "protection": stanford_figure,
}
"""Each of a board, one of its variants and a width in inches (None: a page's); None where nothing is to draw."""


PLOTLY = "plotly-basic-4.1.1.min.js.gz"
MOST_POINTS, FEWEST_POINTS = 400, 40  # of a curve
MOST_NUMBERS = 300_000  # of all curves together: about half a megabyte once packed
SHOWN = 4  # of the best observers, at first; the legend shows others
_DIGITS = 3
_LEAST_MARK, _GROWTH = 9.0, 0.08  # px, and px per root of bytes/s


def page_file(name: str) -> bytes:
    """Return a file of the page."""
    return (files("coopenv.bench.observers") / "page" / name).read_bytes()


def packed(data: bytes) -> str:
    """Return data as text that `charts.js` unpacks."""
    return b64encode(data).decode()


def chart_data(board: Leaderboard) -> str:
    """Return the data of all charts, packed."""
    text = json.dumps(jsonable(_document(board)), separators=(",", ":"))
    return packed(compress(text.encode(), 9, mtime=0))


def _document(board: Leaderboard) -> dict[str, Any]:
    first = next(iter(board.variants))
    scene, sample = board.samples[0].scene, board.samples[0]
    curves = len(board.variants) * len(board.observers) * len(scene.vehicles) * 3
    points = int(np.clip(MOST_NUMBERS / curves, FEWEST_POINTS, MOST_POINTS))
    return {
        "vehicles": list(scene.vehicles),
        "first": _worst(board, first),
        "observers": board.ranked,
        "colours": VEHICLE_COLOURS,
        "shown": SHOWN,
        "dof": sample.nees_dof,
        "band": [float(end) for end in mean_bounds(sample.nees_dof, board.runs)],
        "variants": [_variant(board, name, points) for name in board.variants],
        "cost": _cost(board, first),
    }


def _worst(board: Leaderboard, variant: str) -> int:
    """Return the vehicle with the largest error after the start, of the observers that are shown at first."""
    rows = [board.rows_in(variant, name) for name in board.ranked[:SHOWN]]
    largest = np.array([[row.worst_after_start_m for row in own] for own in rows])
    return int(np.nan_to_num(largest, nan=-1.0).max(axis=0).argmax())


def _variant(board: Leaderboard, name: str, points: int) -> dict[str, Any]:
    groups = board.samples_in(name)
    samples = [sample for sample in board.samples if sample.variant == name]
    t = samples[0].scene.t
    keep = style.thinned(len(t), points)
    bound = _bound(groups[next(iter(groups))] if groups else samples[:1])
    return {
        "name": name,
        "t": _short(t[keep]),
        "bound": [_short(column) for column in bound[keep].T],
        "curves": {
            observer: {kind: [_short(column) for column in values[keep].T] for kind, values in _curves(own).items()}
            for observer, own in groups.items()
        },
    }


def _cost(board: Leaderboard, variant: str) -> list[dict[str, Any]]:
    found = []
    for name in board.samples_in(variant):
        rows, total = board.rows_in(variant, name), board.totals[variant, name].rmse
        sent = mean_of(rows, "bytes_per_s")
        point = {"observer": name, "rmse": total.value, "se": total.error, "us": mean_of(rows, "us_per_update")}
        found.append({**point, "bytes": round(sent), "size": _LEAST_MARK + _GROWTH * float(np.sqrt(sent))})
    return found


def _short(values: Array) -> list[float]:
    """Return numbers with few digits; what a logarithmic axis cannot show is NaN."""
    return [
        float(f"{value:.{_DIGITS}g}") if value == 0 or 1e-9 < abs(value) < 1e9 else float("nan") for value in values
    ]


_PANEL, _BASIN_MARGIN = 2.6, 0.6  # inches


def basin_figure(board: Leaderboard) -> Figure:
    """Draw, per observer, every vehicle of every draw at its initial errors, and the share by angle below."""
    basins = board.basins
    columns = min(3, len(basins))
    rows = -(-len(basins) // columns)
    note = f"{board.environment}, {basins[0].draws} initial estimates"
    figure, _ = style.canvas(None, _BASIN_MARGIN + _PANEL * rows, note)
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[2, 1] * rows)
    for n, basin in enumerate(basins):
        y, x = divmod(n, columns)
        cloud = figure.add_subplot(grid[2 * y, x])
        bars = figure.add_subplot(grid[2 * y + 1, x], sharex=cloud)
        own = [draw for draw in board.draws if draw.observer == basin.observer]
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
