"""The smallest eigenvalue of the observability Gramian along a run, and the verdict that follows."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from coopenv.estimation.metrics import observability_of
from coopenv.estimation.observability import Observability
from coopenv.viz import style

_VERDICTS: dict[bool, dict[str, Any]] = {
    True: {"facecolor": style.GREEN, "edgecolor": "none", "label": "observable"},
    False: {"facecolor": "white", "edgecolor": style.VERMILION, "hatch": "//////", "label": "not\nobservable"},
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
    figure = style.new_figure(9.0, height)
    edges = {"left": 0.11, "right": 0.875, "bottom": 0.55 / height, "top": 1 - 0.45 / height}
    grid = figure.add_gridspec(3, 1, height_ratios=(2.5, 1.6, strip), hspace=0.14, **edges)
    local, theorem, verdict = grid.subplots(squeeze=False)[:, 0]
    title = f"Observability Gramian, {observability.window:.3g} s windows (values below {_FLOOR:g} drawn there)"
    place = {"x": 0.11, "y": 1 - 0.12 / height, "ha": "left", "va": "top"}
    figure.suptitle(title, fontsize=style.NORMAL + 1, color=style.INK, **place)
    _draw_eigenvalues(local, cut, [part.local_eigenvalue for part in cut])
    local.set_ylabel("smallest eigenvalue about\nthe vehicle, scaled [-]", fontsize=style.NORMAL)
    local.axhline(observability.threshold, color=style.INK, linewidth=0.9, linestyle=(0, (4, 2)), label="threshold")
    style.legend(local, local.get_lines(), "upper left", (1.005, 1.0), fontsize=style.NORMAL)
    _draw_eigenvalues(theorem, cut, [part.min_eigenvalue for part in cut])
    theorem.set_ylabel("smallest eigenvalue about\nthe origin [rad, m mixed]", fontsize=style.NORMAL)
    _draw_verdict(verdict, cut)
    for ax in (local, theorem):
        style.show_decades(ax)
    for ax in (local, theorem, verdict):
        if len(observability.t):
            span = np.array([observability.t[0], observability.t[-1] + observability.window])
            style.time_axis(ax, span, labelled=ax is verdict)
    return figure


def _draw_eigenvalues(ax: Axes, cut: list[Observability], eigenvalues: list[np.ndarray]) -> None:
    style.tidy(ax)
    ax.set_yscale("log")
    for vehicle, (part, values) in enumerate(zip(cut, eigenvalues, strict=True)):
        if len(part.t):
            keep, colour = style.thinned(len(part.t)), style.vehicle_colour(vehicle)
            drawn, name = np.maximum(values[keep, 0], _FLOOR), style.vehicle_label(part.vehicles[0])
            ax.plot(part.t[keep], drawn, linewidth=style.LINE, color=colour, label=name)


def _draw_verdict(ax: Axes, cut: list[Observability]) -> None:
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
    handles = [Patch(**look) for observable, look in _VERDICTS.items() if observable in occurring]
    style.legend(ax, handles, "upper left", (1.005, 1.0), handlelength=1.6)
