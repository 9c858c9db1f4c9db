"""The smallest eigenvalue of the observability Gramian along a run, and the verdict that follows."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopenv.estimation.metrics import observability_of
from coopenv.estimation.observability import Observability
from coopenv.viz import style

_VERDICTS: dict[bool, dict[str, Any]] = {
    True: {"facecolor": style.GREEN, "edgecolor": "none", "label": "observable"},
    False: {"facecolor": "white", "edgecolor": style.VERMILION, "hatch": "//////", "label": "not observable"},
}
_FLOOR = 1e-8  # smaller eigenvalues are drawn here: they are zero but for rounding
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (6, 1.5, 1, 1.5)), (0, (1, 0.8)))
_FRAME, _NARROW_FRAME, _LANE = 3.6, 2.6, 0.24  # inches
MEANING = (
    "Observable: the bearings of a window, together with odometry, determine the pose near the truth. "
    "It does not promise that an observer gets there from any start."
)


def observability_figure(
    observability: Observability, ends: Sequence[float] | None = None, width: float | None = None
) -> Figure:
    """Draw the eigenvalue that the verdict rests on, and the verdict of every vehicle.

    Windows that reach beyond a vehicle's end (s) are left out. `width` is in inches (None: a page's).
    """
    count = len(observability.vehicles)
    cut = [observability_of(observability, i, np.nan if ends is None else ends[i]) for i in range(count)]
    frame = _NARROW_FRAME if width is not None and width < style.NARROW else _FRAME
    figure, _ = style.canvas(width, frame + _LANE * count, "")
    local, verdict = figure.subplots(2, 1, height_ratios=(2.0, max(0.3, _LANE * count)))
    handles = _draw_eigenvalues(local, cut)
    low = any((part.local_eigenvalue < _FLOOR).any() for part in cut)
    style.explain(figure, MEANING + (f" Smaller eigenvalues are drawn at {_FLOOR:g}." if low else ""))
    local.axhline(observability.threshold, color=style.INK, linewidth=0.9, linestyle=_DASHES[1])
    handles.append(Line2D([], [], color=style.INK, linewidth=0.9, linestyle=_DASHES[1], label="threshold"))
    window = f"smallest eigenvalue of the\nGramian over {observability.window:.3g} s, scaled [-]"
    local.set_ylabel(window, fontsize=style.NORMAL, color=style.INK)
    style.show_decades(local)
    occurring = _draw_verdict(verdict, cut)
    for ax in (local, verdict):
        if len(observability.t):
            span = np.array([observability.t[0], observability.t[-1] + observability.window])
            style.time_axis(ax, span, labelled=ax is verdict)
    style.legend_above(figure, [*handles, *occurring])
    return figure


def _draw_eigenvalues(ax: Axes, cut: list[Observability]) -> list[Line2D | Patch]:
    """Draw one line per vehicle, of different dashes where they lie upon one another; return what explains them."""
    style.tidy(ax)
    ax.set_yscale("log")
    drawn: list[Line2D | Patch] = []
    for vehicle, part in enumerate(cut):
        name = style.vehicle_label(part.vehicles[0])
        look: dict[str, Any] = {"linewidth": style.LINE, "color": style.vehicle_colour(vehicle), "label": name}
        look["linestyle"] = _DASHES[vehicle % len(_DASHES)]
        drawn.append(Line2D([], [], **look))
        if len(part.t):
            keep = style.thinned(len(part.t))
            values = part.local_eigenvalue[keep, 0]
            ax.plot(part.t[keep], np.maximum(values, _FLOOR), **look)
    return drawn


def _draw_verdict(ax: Axes, cut: list[Observability]) -> list[Patch]:
    """Draw the verdict of every vehicle, and return what explains it."""
    style.tidy(ax)
    ax.grid(False, axis="y")
    occurring = set()
    for vehicle, part in enumerate(cut):
        for observable, look in _VERDICTS.items():
            stretches = [(s, e - s) for s, e, verdict in part.intervals(0) if verdict == observable]
            if stretches:
                occurring.add(observable)
                ax.broken_barh(stretches, (vehicle - 0.32, 0.64), linewidth=0.4, **look)
    ax.set_yticks(range(len(cut)), [style.vehicle_label(part.vehicles[0]) for part in cut])
    ax.set_ylim(len(cut) - 0.5, -0.5)
    return [Patch(**look) for observable, look in _VERDICTS.items() if observable in occurring]
