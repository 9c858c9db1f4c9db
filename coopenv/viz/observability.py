"""The smallest eigenvalue of the observability Gramian along a run, and the verdict that follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from coopenv.estimation.metrics import observability_of
from coopenv.estimation.observability import Observability
from coopenv.viz.style import (
    GREEN,
    INK,
    LINE,
    NORMAL,
    SMALL,
    VERMILION,
    new_figure,
    show_decades,
    thinned,
    tidy,
    time_axis,
    vehicle_colour,
    vehicle_label,
)

_VERDICTS: dict[bool, dict[str, Any]] = {
    True: {"facecolor": GREEN, "edgecolor": "none", "label": "observable"},
    False: {"facecolor": "white", "edgecolor": VERMILION, "hatch": "//////", "label": "not\nobservable"},
}
_FLOOR = 1e-8  # smaller eigenvalues are drawn here: they are zero but for rounding


def observability_figure(observability: Observability, ends: Sequence[float] | None = None) -> Figure:
    """Draw the eigenvalue that the verdict rests on, the theorem's own, and the verdict of every vehicle.

    Windows that reach beyond a vehicle's end (s) are left out.
    """
    count = len(observability.vehicles)
    cut = [observability_of(observability, i, np.nan if ends is None else ends[i]) for i in range(count)]
    strip = 0.3 + 0.24 * count
    height = 5.6 + strip
    figure = new_figure(9.0, height)
    local, theorem, verdict = figure.subplots(
        3,
        1,
        gridspec_kw={
            "height_ratios": (2.5, 1.6, strip),
            "left": 0.11,
            "right": 0.875,
            "bottom": 0.55 / height,
            "top": 1 - 0.45 / height,
            "hspace": 0.14,
        },
    )
    title = f"Observability Gramian, {observability.window:.3g} s windows (values below {_FLOOR:g} drawn there)"
    figure.suptitle(title, x=0.11, y=1 - 0.12 / height, ha="left", va="top", fontsize=NORMAL + 1, color=INK)
    _draw_eigenvalues(local, [(part.t, part.local_eigenvalue[:, 0]) for part in cut], observability.vehicles)
    local.set_ylabel("smallest eigenvalue about\nthe vehicle, scaled [-]", fontsize=NORMAL)
    local.axhline(observability.threshold, color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="threshold")
    local.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=NORMAL, frameon=False)
    _draw_eigenvalues(theorem, [(part.t, part.min_eigenvalue[:, 0]) for part in cut], observability.vehicles)
    theorem.set_ylabel("smallest eigenvalue\nabout the map origin", fontsize=NORMAL)
    _draw_verdict(verdict, cut)
    for ax in (local, theorem):
        show_decades(ax)
    for ax in (local, theorem, verdict):
        if len(observability.t):
            span = np.array([observability.t[0], observability.t[-1] + observability.window])
            time_axis(ax, span, labelled=ax is verdict)
    return figure


def _draw_eigenvalues(ax: Axes, curves: list[tuple[np.ndarray, np.ndarray]], vehicles: np.ndarray) -> None:
    tidy(ax)
    ax.set_yscale("log")
    for vehicle, (t, values) in enumerate(curves):
        if len(t):
            keep = thinned(len(t))
            drawn = np.maximum(values[keep], _FLOOR)
            look: dict[str, Any] = {"color": vehicle_colour(vehicle), "label": vehicle_label(vehicles[vehicle])}
            ax.plot(t[keep], drawn, linewidth=LINE, **look)


def _draw_verdict(ax: Axes, cut: list[Observability]) -> None:
    tidy(ax)
    ax.grid(False, axis="y")
    occurring = set()
    for vehicle, part in enumerate(cut):
        for observable, look in _VERDICTS.items():
            stretches = [(s, e - s) for s, e, verdict in part.intervals(0) if verdict == observable]
            if stretches:
                occurring.add(observable)
                ax.broken_barh(stretches, (vehicle - 0.32, 0.64), linewidth=0.4, **look)
    ax.set_yticks(range(len(cut)), [vehicle_label(part.vehicles[0]) for part in cut])
    ax.set_ylim(len(cut) - 0.5, -0.5)
    ax.legend(
        handles=[Patch(**look) for observable, look in _VERDICTS.items() if observable in occurring],
        loc="upper left",
        bbox_to_anchor=(1.005, 1.0),
        fontsize=SMALL,
        frameon=False,
        handlelength=1.6,
    )
