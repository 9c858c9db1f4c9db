"""Style of the figures: a palette safe for colour-blind readers, the paper's names, time axes, places of names."""

import re
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator

from coopenv.base.columns import picture_html
from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.base.files import replacing_file
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import FORMATS

# Okabe and Ito (2008), without the yellow that vanishes on white.
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
INK, GREY, RULE = "#222222", "#7F7F7F", "#D9D9D9"
SHADE = "#DCEAF6"  # a moving target is in view
ENDED = "#EBEBEB"  # a vehicle has ended and is parked
DARK_BLUE = "#00264D"  # landmarks, as in the paper
AXES_COLOURS = (VERMILION, GREEN, BLUE)  # x, y, z and roll, pitch, yaw
VEHICLE_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, INK, GREY)

DPI = 130
LINE, SMALL, NORMAL = 1.2, 7.5, 9.0  # pt
HALO = (withStroke(linewidth=2.0, foreground="white"),)  # of words that stand on lines
MAX_POINTS = 1500  # of a line: more than the pixels it crosses
MERGED_GAP = 0.2  # s, longest gap in a shade that is not drawn: a frame or two without a detection
PAGE = 10.5  # inches, the width of a figure of a comparison unless another one is asked for
NOTE = "#595959"  # of small print; its contrast on white is 7
TEXT: dict[str, Any] = {"fontsize": NORMAL, "color": INK}
BIN = 1 / 12  # inches: samples closer than this are drawn as their median and range
BAND = 0.22  # opacity of that range
RANGE = (10, 90)  # percentiles
LETTER = 0.062  # inches, a letter of small print
LINE_HEIGHT = 0.17  # inches, of a legend or a note
NARROW = 5.0  # inches: narrower figures are for one column of a journal
_LEGEND_MARK, _LEGEND_LETTER = 0.45, 0.06  # inches
_LEAST_DECADES, _LEAST_LABELS = 1.05, 2  # on a logarithmic axis
_LARGEST = 1e100  # of a value that is drawn
_ROUNDING = 1e-9  # below it errors, m or deg, are those of arithmetic


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure (inches) with its own Agg canvas, unknown to pyplot; notebooks show it all the same."""
    figure: Any = FigureCanvasAgg(Figure(figsize=(width, height), dpi=DPI)).figure
    figure._repr_html_ = partial(picture_html, figure)
    return figure  # type: ignore[no-any-return]


def save(figure: Figure, path: Path, file_format: str = "", about: Mapping[str, object] | None = None) -> Path:
    """Write a figure in one of `FORMATS` (by default as the path ends) and return the path.

    Args:
        figure: any.
        path: an older file is replaced.
        file_format: one of `FORMATS`.
        about: metadata of the file, for example environment, observer and seed.

    Raises:
        CoopenvError: no such format, or the file cannot be written; an older one is untouched.
    """
    form = file_format or path.suffix.removeprefix(".")
    check_one_of(f"{path}: unknown format of a figure", form, FORMATS)
    stamp = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}[form]  # the same figure is the same file
    words = "; ".join(f"{name}: {value}" for name, value in (about or {}).items())
    metadata = {"Title": path.stem, {"png": "Description", "pdf": "Subject", "svg": "Description"}[form]: words}
    with replacing_file(path) as new, rc_context({"svg.hashsalt": "coopenv", "pdf.fonttype": 42}):
        figure.savefig(new, dpi=DPI, format=form, metadata={stamp: None, **(metadata if words else {})})
    return path


def sign(figure: Figure, note: str) -> None:
    """Write a note in small print below a figure and earlier notes."""
    if note:
        above = figure.get_supxlabel()
        words = f"{above}\n{note}" if above else note
        _grow(figure, note.count("\n") + bool(above))
        figure.supxlabel(words, x=0.99, ha="right", fontsize=SMALL - 1.0, color=NOTE)


def _grow(figure: Figure, lines: int) -> None:
    """Make room for further lines of small print, so that panels keep their size."""
    figure.set_figheight(float(figure.get_figheight()) + LINE_HEIGHT * lines)


def explain(figure: Figure, text: str) -> None:
    """Write the legend in small print below a figure, on as many lines as needed."""
    sign(figure, fill(text, int(figure.get_figwidth() / LETTER)))


def rgb(colour: str) -> np.ndarray:
    """Return a colour of Matplotlib as three whole numbers up to 255."""
    return np.round(255.0 * np.array(to_rgb(colour))).astype(np.uint8)


def vehicle_colour(index: int) -> str:
    """Return the colour of a vehicle, the same in every figure."""
    return VEHICLE_COLOURS[index % len(VEHICLE_COLOURS)]


def vehicle_label(name: str) -> str:
    """Return the paper's f_1 for `vehicle_1`, any other name as it is."""
    match = re.fullmatch(r"vehicle_(\d+)", str(name))
    return f"$f_{{{match[1]}}}$" if match else str(name)


def target_labels(trajectory: Trajectory) -> list[str]:
    """Return the paper's SL1 (static) or ML1 (moving) for `landmark_1`, and f_1 for `vehicle_1`."""
    labels = []
    for name, moving in zip(trajectory.targets, trajectory.target_moving, strict=True):
        match = re.fullmatch(r"landmark_(\d+)", str(name))
        labels.append(f"{'ML' if moving else 'SL'}{match[1]}" if match else vehicle_label(name))
    return labels


def thinned(count: int, most: int = MAX_POINTS) -> np.ndarray:
    """Return the indices of at most so many of `count` samples, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def summed_up(t: np.ndarray, values: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times, and median, 10th and 90th percentile of values (K,), over stretches of equally many samples.

    Where there are fewer than twice as many samples as bins, each sample is one. NaN where no sample is finite.
    """
    size = len(t) // max(bins, 1)
    if size < 2:
        return t, values, values, values
    pad = -len(t) % size
    stretches = [np.append(np.asarray(one, float), np.full(pad, np.nan)).reshape(-1, size) for one in (t, values)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of stretches without any
        middle = np.nanmean(stretches[0], axis=1)
        whole, share = np.isfinite(stretches[1]).all(axis=1), (RANGE[0], 50, RANGE[1])
        found = np.percentile(stretches[1], share, axis=1)
        found[:, ~whole] = np.nanpercentile(stretches[1][~whole], share, axis=1)  # which is slow
    return middle, found[1], found[0], found[2]


def draw_band(ax: Axes, t: np.ndarray, values: np.ndarray, bins: int, **look: Any) -> None:
    """Draw a line through medians over the range of the values (K,), so that dense noise leaves other lines visible."""
    middle, median, least, largest = summed_up(t, values, bins)
    if median is not values:
        ax.fill_between(middle, least, largest, color=look.get("color"), alpha=BAND, linewidth=0)
    ax.plot(middle, median, **look)


def bins_of(inches: float) -> int:
    """Return the number of intervals of a panel of a width."""
    return max(20, int(inches / BIN))


def drawable(values: np.ndarray, *, positive: bool = False) -> np.ndarray:
    """Return values with NaN in place of what an axis cannot show: infinite, huge, on a logarithmic one rounding."""
    values = np.asarray(values, float)
    with np.errstate(invalid="ignore"):
        return np.where((np.abs(values) < _LARGEST) & ((values > _ROUNDING) | (not positive)), values, np.nan)


def runs(t: np.ndarray, mask: np.ndarray, gap: float = 0.0) -> list[tuple[float, float]]:
    """Return (start, duration) in s of the stretches where `mask` (K,) holds, a tick lasting to the next.

    Stretches not more than `gap` (s) apart are one.
    """
    edges = np.append(t, t[-1] + (np.median(np.diff(t)) if len(t) > 1 else 0.0))
    change = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    starts, ends = edges[change[::2]], edges[change[1::2]]
    apart = starts[1:] - ends[:-1] > gap
    starts, ends = starts[np.append(True, apart)[: len(starts)]], ends[np.append(apart, True)[: len(ends)]]
    return list(zip(starts.tolist(), (ends - starts).tolist(), strict=True))


def moving_target_seen(trajectory: Trajectory, vehicle: int, ticks: int) -> np.ndarray:
    """Return (K,) whether a vehicle's camera detects a vehicle or a moving landmark, in the first ticks."""
    seen = np.any(trajectory.visible[:, vehicle] & trajectory.target_moving, axis=-1)
    return np.asarray(seen & (np.arange(len(seen)) < ticks))


def shade(ax: Axes, stretches: Sequence[tuple[float, float]], colour: str = SHADE) -> None:
    """Shade stretches of time over the whole height of `ax`."""
    ax.broken_barh(stretches, (0, 1), transform=ax.get_xaxis_transform(), facecolor=colour, edgecolor="none", zorder=0)


def shade_ended(ax: Axes, t: np.ndarray, ticks: int) -> None:
    """Shade the time after a vehicle's last tick that counts."""
    if ticks < len(t):
        shade(ax, [(float(t[ticks - 1]), float(t[-1] - t[ticks - 1]))], ENDED)


def tidy(ax: Axes, *, x_label: str = "", y_label: str = "") -> None:
    """Give axes the house look: small ticks, a light grid behind the data, no box."""
    ax.set_axisbelow(True)
    ax.grid(True, color=RULE, linewidth=0.5)
    ax.tick_params(labelsize=SMALL, length=2.5, width=0.6, colors=INK)
    ax.tick_params(which="minor", length=0)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_linewidth(0.6)
    ax.set_xlabel(x_label, fontsize=NORMAL, color=INK)
    ax.set_ylabel(y_label, fontsize=NORMAL, color=INK)


def note(ax: Axes, x: float, y: float, text: str, **look: Any) -> None:
    """Write words at a place given in shares of the axes."""
    ax.text(x, y, text, transform=ax.transAxes, **{"fontsize": SMALL, "color": INK, **look})


def legend(
    owner: Axes | Figure, handles: Sequence[Artist], loc: str, place: tuple[float, float] | None = None, **look: Any
) -> None:
    """Explain marks without a frame, the corner or edge `loc` of the legend at a place in shares of its owner."""
    look = {"loc": loc, "bbox_to_anchor": place, "fontsize": SMALL, "frameon": False, **look}
    owner.legend(handles=handles, **look)


def canvas(width: float | None, height: float, note: str = "") -> tuple[Figure, float]:
    """Return an empty figure that arranges itself, with a note in small print below, and its width, inches.

    Raises:
        CoopenvError: a width that nothing can be drawn in.
    """
    inches = PAGE if width is None else float(width)
    if not 2.0 <= inches <= 50.0:
        raise CoopenvError(f"width {inches:g}: expected 2 to 50 inches")
    figure = new_figure(inches, height)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03, wspace=0.02, hspace=0.02)
    sign(figure, note)
    return figure, inches


def fitting(width: float, each: float, most: int) -> int:
    """Return the number of panels of a width side by side."""
    return int(min(most, width / each)) if width >= each else 1


def marks(*entries: tuple[object, str, Mapping[str, Any]]) -> list[Line2D | Patch]:
    """Return handles of a legend for entries (whether it occurs, label, look): a patch where the look has a face."""
    return [
        Patch(label=label, **look) if "facecolor" in look else Line2D([], [], label=label, **look)
        for occurs, label, look in entries
        if occurs
    ]


def mark_look(marker: str, edge: str, face: str, size: float = 6.0, rim: float = 1.0) -> dict[str, Any]:
    """Return the style of a point's mark, as a line without a stroke; sizes in pt."""
    look = {"marker": marker, "markeredgecolor": edge, "markerfacecolor": face}
    return {"linestyle": "none", "markersize": size, "markeredgewidth": rim, **look}


def legend_above(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above the panels, in as many columns as fit."""
    labels = [re.sub(r"[${}_^\\]", "", str(handle.get_label())) for handle in handles]  # formulas by their letters
    lengths, columns = np.array([_LEGEND_MARK + _LEGEND_LETTER * len(label) for label in labels]), len(handles)
    while columns > 1 and sum(max(part) for part in np.array_split(lengths, columns)) > figure.get_figwidth():
        columns -= 1
    _grow(figure, -(-len(handles) // columns) - 1)
    spacing: dict[str, Any] = {"handlelength": 2.2, "columnspacing": 1.6}
    place = "upper center" if figure.get_layout_engine() is None else "outside upper center"
    legend(figure, handles, place, ncols=columns, fontsize=SMALL + 0.5, **spacing)


def show_decades(ax: Axes) -> None:
    """Label a logarithmic ordinate, on which everything has been drawn, at decades only, two at least in sight."""
    ax.yaxis.set_minor_locator(NullLocator())
    low, high = ax.dataLim.intervaly
    if 0 < low <= high < np.inf:
        ax.set_autoscaley_on(False)  # it would complain about a single value
        low, high = np.log10((low, high))
        room = max(0.05 * (high - low), (_LEAST_DECADES - (high - low)) / 2)
        bottom, top = low - room, high + room
        while np.floor(top) - np.ceil(bottom) + 1 < _LEAST_LABELS:
            below, above = np.ceil(bottom) - 1, np.floor(top) + 1
            bottom, top = (below, top) if bottom - below < above - top else (bottom, above)
        ax.set_ylim(10**bottom, 10**top)


def share_decades(axes: Sequence[Axes], room: float = 0.0) -> None:
    """Give panels the same logarithmic ordinate, wide enough for all of them, with room above the curves."""
    for ax in axes:
        show_decades(ax)
    limits = [ax.get_ylim() for ax in axes]
    bottom, top = min(low for low, _ in limits), max(high for _, high in limits)
    for ax in axes:
        ax.set_ylim(bottom, top * (top / bottom) ** room)


def panels(figure: Figure, count: int, columns: int) -> np.ndarray:
    """Return axes of a figure, row by row in so many columns."""
    axes = figure.subplots(-(-count // columns), columns, squeeze=False).ravel()
    for unused in axes[count:]:
        unused.set_visible(False)
    return np.asarray(axes[:count])


def time_axis(ax: Axes, t: np.ndarray, *, labelled: bool) -> None:
    """Span the record in time, with labels only where asked for."""
    ax.set_xlim(float(t[0]), float(t[-1]) if t[-1] > t[0] else float(t[0]) + 1.0)
    ax.tick_params(labelbottom=labelled)
    if labelled:
        ax.set_xlabel("time [s]", fontsize=NORMAL, color=INK)


_GAP = 5.0  # pt between a point and its name
_MARK = 4.5  # pt, half the side of a mark
_WIDTH, _HEIGHT = 0.62, 0.95  # of a character, in font sizes
_DIRECTIONS = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
_COST_OF_NAME, _COST_OF_MARK, _COST_OF_LINE = 200.0, 100.0, 1.0


def place_names(
    names: Sequence[str], anchors: np.ndarray, marks: np.ndarray, lines: np.ndarray, size: float
) -> np.ndarray:
    """Return the offsets (M, 2), in pt, of names' lower left corners from their points.

    Each name in turn takes the side of its point that covers the least: first other names, then marks, then lines.
    Points of names (M, 2), of all marks (P, 2) and along lines (Q, 2) are in pixels; the font's size is in pt.
    """
    point, sides = DPI / 72.0, np.array(_DIRECTIONS)
    gaps = np.where(sides.all(axis=1, keepdims=True), _GAP, 1.4 * _GAP) * sides
    anchors, marks, lines = (np.asarray(a, float).reshape(-1, 2) / point for a in (anchors, marks, lines))
    taken: list[np.ndarray] = []
    offsets = []
    for name, anchor in zip(names, anchors, strict=True):
        extent = np.array([_WIDTH * len(re.sub(r"[${}_\\]", "", name)), _HEIGHT]) * size
        corners = gaps + np.where(sides > 0, 0.0, np.where(sides < 0, -extent, -extent / 2))
        low, high = (anchor + corners)[:, None], (anchor + corners + extent)[:, None]
        other = np.array(taken).reshape(-1, 2, 2)
        costs = _COST_OF_NAME * np.all((low < other[:, 1]) & (high > other[:, 0]), axis=-1).sum(axis=1)
        costs += _COST_OF_MARK * np.all((marks > low - _MARK) & (marks < high + _MARK), axis=-1).sum(axis=1)
        costs += _COST_OF_LINE * np.all((lines > low) & (lines < high), axis=-1).any(axis=1)
        best = corners[int(np.argmin(costs))]
        taken.append(np.stack([anchor + best, anchor + best + extent]))
        offsets.append(best)
    return np.array(offsets).reshape(-1, 2)


Colour = str | tuple[float, float, float]
LEAST = 4.5
"""Least contrast of text, as WCAG 2 requires at level AA."""


def linear_light(part: np.ndarray) -> np.ndarray:
    """Return the linear intensities of sRGB components, both 0 to 1."""
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def contrast(colour: Colour, background: Colour = "white") -> float:
    """Return the contrast of two colours, 1 (none) to 21 (black on white)."""
    luminance = linear_light(np.array([to_rgb(colour), to_rgb(background)])) @ (0.2126, 0.7152, 0.0722)
    low, high = np.sort(luminance).tolist()
    return float((high + 0.05) / (low + 0.05))
