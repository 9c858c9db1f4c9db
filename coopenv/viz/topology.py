"""The switching sensing topology: which target each camera measures, and why not."""

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
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
}
_WORDS = {
    Sight.VISIBLE: "always visible",
    Sight.OUT_OF_VIEW: "never in view",
    Sight.OCCLUDED_BY_BODY: "always behind a body",
    Sight.OCCLUDED_BY_BUILDING: "always behind a building",
    Sight.MISSED: "always missed",
}
_BAR = {Sight.OUT_OF_VIEW: 0.14}  # share of a row; 0.62 for the others
_MISSED: dict[str, Any] = {"color": style.INK, "linestyle": "none", "marker": "|", "markersize": 3.0}
_LANE, _TITLE, _FRAME = 0.19, 0.42, 0.7  # inches
_EMPTY = 0.1  # lanes, of a vehicle without any
_LETTER = 0.068  # inches
_MOST_NAMES = 8


def topology_figure(trajectory: Trajectory, ends: Sequence[float] | None = None, width: float | None = None) -> Figure:
    """Draw, per vehicle, one lane per target against time, the bar telling what became of the sight line.

    Targets that are the same from begin to end, such as those of a fixed topology, stand in words above the lanes.
    Blue shading: a moving target is detected, or a moving body hides a target. Grey: the vehicle has ended (at `ends`,
    s) and is parked; others may see it. `width` is in inches (None: a page's).
    """
    count = len(trajectory.vehicles)
    live = live_ticks(trajectory.t, count, ends)
    lanes = [_changing(trajectory, vehicle, ticks) for vehicle, ticks in enumerate(live)]
    rows = [max(_EMPTY, len(targets)) * _LANE + _TITLE for targets in lanes]
    figure, inches = style.canvas(width, _FRAME + sum(rows), "")
    axes = figure.subplots(count, 1, squeeze=False, height_ratios=[max(_EMPTY, len(lane)) for lane in lanes])[:, 0]
    shaded = missed = False
    last = max((vehicle for vehicle, targets in enumerate(lanes) if len(targets)), default=-1)
    for vehicle, (ax, targets) in enumerate(zip(axes, lanes, strict=True)):
        involved, some = _draw_lanes(ax, trajectory, vehicle, targets, live[vehicle])
        shaded, missed = shaded | involved, missed | some
        style.time_axis(ax, trajectory.t, labelled=vehicle == last)
        _write_title(ax, trajectory, vehicle, targets, live[vehicle], inches)
    drawn = [trajectory.sight[:ticks, i][:, lanes[i]] for i, ticks in enumerate(live)]
    occurring = {kind for part in drawn for kind in np.unique(part)}
    handles: list[Patch | Line2D] = [Patch(**look) for kind, look in _LOOKS.items() if kind in occurring]
    if missed:
        handles.append(Line2D([], [], label="a frame missed", **_MISSED))
    if shaded:
        handles.append(Patch(facecolor=style.SHADE, label="moving target involved"))
    if live.min() < len(trajectory.t):
        handles.append(Patch(facecolor=style.ENDED, label="ended, parked"))
    if handles:
        style.legend_above(figure, handles)
    return figure


def _changing(trajectory: Trajectory, vehicle: int, ticks: int) -> np.ndarray:
    """Return the neighbours of a vehicle that are not the same all the time."""
    sight = trajectory.sight[:ticks, vehicle]
    return np.flatnonzero(np.any(sight != Sight.NOT_A_NEIGHBOUR, axis=0) & np.any(sight != sight[:1], axis=0))


def _draw_lanes(ax: Axes, trajectory: Trajectory, vehicle: int, targets: np.ndarray, ticks: int) -> tuple[bool, bool]:
    """Draw one vehicle's lanes; return whether a moving target is ever involved, and whether a frame is missed."""
    if not len(targets):
        ax.axis("off")
        return False, False
    names, live = style.target_labels(trajectory), np.arange(len(trajectory.t)) < ticks
    sight = np.where(live[:, None], trajectory.sight[:, vehicle], Sight.NOT_A_NEIGHBOUR)
    style.tidy(ax)
    ax.grid(False, axis="y")
    seen = style.moving_target_seen(trajectory, vehicle, ticks)
    involved = seen | np.any(sight == Sight.OCCLUDED_BY_BODY, axis=-1)
    style.shade(ax, style.runs(trajectory.t, involved, style.MERGED_GAP))
    style.shade_ended(ax, trajectory.t, ticks)
    missed = False
    for lane, target in enumerate(targets):
        for kind, look in _LOOKS.items():
            gap = style.MERGED_GAP if kind == Sight.VISIBLE else 0.0  # a frame missed does not cut a bar
            stretches = style.runs(trajectory.t, sight[:, target] == kind, gap)
            if stretches:
                width = _BAR.get(kind, 0.62)
                ax.broken_barh(stretches, (lane - width / 2, width), linewidth=0.4, **look)
        lost = trajectory.t[sight[:, target] == Sight.MISSED]
        missed |= len(lost) > 0
        ax.plot(lost, np.full(len(lost), lane - 0.42), **_MISSED)
    ax.set_yticks(range(len(targets)), [names[target] for target in targets])
    ax.set_ylim(len(targets) - 0.5, -0.6)
    return bool(involved.any()), missed


def _write_title(
    ax: Axes, trajectory: Trajectory, vehicle: int, targets: np.ndarray, ticks: int, inches: float
) -> None:
    """Write the vehicle's name, how much it sees, and what never changes."""
    seen = mean_targets_in_view(trajectory.visible[:ticks, vehicle])
    parts = [f"{seen:.2f} targets in view on average"]
    names, first = style.target_labels(trajectory), trajectory.sight[0, vehicle]
    neighbours = np.any(trajectory.sight[:ticks, vehicle] != Sight.NOT_A_NEIGHBOUR, axis=0)
    for kind, words in _WORDS.items():
        same = [names[i] for i in np.flatnonzero(neighbours & (first == kind)) if i not in targets]
        if same:
            parts.append(f"{words}: {_listed(same)}")
    if not neighbours.any():
        parts = ["no neighbours"]
    words = f"{style.vehicle_label(trajectory.vehicles[vehicle])}:  {'; '.join(parts)}"
    room = int(0.9 * inches / _LETTER)
    ax.set_title(fill(words, room), loc="left", fontsize=style.SMALL + 0.5, pad=3.0, color=style.INK)


def _listed(names: Sequence[str]) -> str:
    """Return names with commas between, of many the first and the last."""
    if len(names) <= _MOST_NAMES:
        return ", ".join(names)
    return f"{names[0]} to {names[-1]} ({len(names)})"
