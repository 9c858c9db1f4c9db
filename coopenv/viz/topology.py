"""The switching sensing topology: which target each camera measures, and why not."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from coopenv.estimation.metrics import live_ticks, mean_targets_in_view
from coopenv.estimation.outcomes import Sight
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style


def _hatched(colour: str, hatch: str, label: str) -> dict[str, Any]:
    return {"facecolor": "white", "edgecolor": colour, "hatch": hatch, "label": label}


_LOOKS: dict[Sight, dict[str, Any]] = {
    Sight.VISIBLE: {"facecolor": style.BLUE, "edgecolor": "none", "label": "visible"},
    Sight.OCCLUDED_BY_BODY: _hatched(style.VERMILION, "//////", "occluded by a moving body"),
    Sight.OCCLUDED_BY_BUILDING: _hatched(style.ORANGE, "......", "occluded by a building"),
    Sight.OUT_OF_VIEW: {"facecolor": style.GREY, "edgecolor": "none", "label": "out of view"},
    Sight.MISSED: {"facecolor": style.INK, "edgecolor": "none", "label": "missed"},
}
_BAR = {Sight.OUT_OF_VIEW: 0.14}  # share of a row; 0.62 for the others
_LANE, _PANEL_GAP, _HEAD, _FOOT = 0.19, 0.36, 0.55, 0.5  # inches


def topology_figure(trajectory: Trajectory, ends: Sequence[float] | None = None) -> Figure:
    """Draw, per vehicle, one lane per target against time, the bar telling what became of the sight line.

    Targets that are never a vehicle's neighbours have no lane. Blue shading: a moving target is detected, or
    a moving body hides a target. Grey: the vehicle has ended (at `ends`, s) and is parked; others may see it.
    """
    neighbours = np.any(trajectory.sight != Sight.NOT_A_NEIGHBOUR, axis=0)
    lanes = [np.flatnonzero(targets) for targets in neighbours]
    rows = [max(1, len(targets)) * _LANE for targets in lanes]
    height = _HEAD + _FOOT + sum(rows) + _PANEL_GAP * (len(rows) - 1)
    figure = style.new_figure(9.0, height)
    top = height - _HEAD
    live = live_ticks(trajectory.t, len(lanes), ends)
    shaded = False
    for vehicle, targets in enumerate(lanes):
        bottom = top - rows[vehicle]
        ax = figure.add_axes((0.105, bottom / height, 0.875, rows[vehicle] / height))
        shaded |= _draw_lanes(ax, trajectory, vehicle, targets, live[vehicle])
        style.time_axis(ax, trajectory.t, labelled=vehicle == len(lanes) - 1)
        top = bottom - _PANEL_GAP
    occurring = {kind for vehicle, ticks in enumerate(live) for kind in np.unique(trajectory.sight[:ticks, vehicle])}
    handles = [Patch(**look) for kind, look in _LOOKS.items() if kind in occurring]
    if shaded:
        handles.append(Patch(facecolor=style.SHADE, label="moving target involved"))
    if live.min() < len(trajectory.t):
        handles.append(Patch(facecolor=style.ENDED, label="ended, parked"))
    style.legend(figure, handles, "upper center", ncols=7, handlelength=1.8, columnspacing=1.3)
    return figure


def _draw_lanes(ax: Axes, trajectory: Trajectory, vehicle: int, targets: np.ndarray, ticks: int) -> bool:
    """Draw one vehicle's lanes; return whether a moving target is ever involved."""
    names, live = style.target_labels(trajectory), np.arange(len(trajectory.t)) < ticks
    sight = np.where(live[:, None], trajectory.sight[:, vehicle], Sight.NOT_A_NEIGHBOUR)
    style.tidy(ax)
    ax.grid(False, axis="y")
    seen = style.moving_target_seen(trajectory, vehicle, ticks)
    involved = seen | np.any(sight == Sight.OCCLUDED_BY_BODY, axis=-1)
    style.shade(ax, style.runs(trajectory.t, involved, style.MERGED_GAP))
    style.shade_ended(ax, trajectory.t, ticks)
    for lane, target in enumerate(targets):
        for kind, look in _LOOKS.items():
            stretches = style.runs(trajectory.t, sight[:, target] == kind)
            if stretches:
                width = _BAR.get(kind, 0.62)
                ax.broken_barh(stretches, (lane - width / 2, width), linewidth=0.4, **look)
    ax.set_yticks(range(len(targets)), [names[target] for target in targets])
    ax.set_ylim(max(1, len(targets)) - 0.5, -0.5)
    if not len(targets):
        ax.text(0.5, 0.5, "no neighbours", transform=ax.transAxes, ha="center", va="center", color=style.GREY)
    title, look = style.vehicle_label(trajectory.vehicles[vehicle]), {"pad": 2.5, "color": style.INK}
    ax.set_title(title, loc="left", fontsize=style.NORMAL + 2, **look)
    seen = mean_targets_in_view(trajectory.visible[:ticks, vehicle])
    ax.set_title(f"{seen:.2f} targets in view on average", loc="right", fontsize=style.SMALL, **look)
    return bool(involved.any())
