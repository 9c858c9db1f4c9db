"""The paths of vehicles and landmarks, in plan and in space: truth dotted, estimate solid."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from coopenv.estimation.trajectory import Trajectory
from coopenv.viz.style import (
    DARK_BLUE,
    INK,
    NORMAL,
    SMALL,
    new_figure,
    target_labels,
    thinned,
    tidy,
    vehicle_colour,
    vehicle_label,
)

_DOTTED = (0, (1, 1.6))
_MARGIN_M, _MARGIN_SHARE = 1.5, 0.06  # around the truth
_LEGEND = 1.75  # inches


def trajectory_figure_2d(trajectory: Trajectory) -> Figure:
    """Draw the paths in plan, axes equal, in metres.

    The frame follows the truth. An estimate that starts outside enters from the edge, where an open triangle
    marks it.
    """
    low, high = _scene(trajectory)
    width, depth = high[:2] - low[:2]
    scale = min(6.6 / width, 6.6 / depth)  # inches per metre
    drawn = np.maximum((width * scale, depth * scale), 2.4)
    figure = new_figure(float(drawn[0]) + 0.75 + _LEGEND, float(drawn[1]) + 0.75)
    w, h = figure.get_size_inches()
    ax = figure.add_axes((0.65 / w, 0.55 / h, drawn[0] / w, drawn[1] / h))
    tidy(ax, x_label="x [m]", y_label="y [m]")
    outside = _draw_paths(ax, trajectory, low, high, dimensions=2)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal", adjustable="datalim")
    _legend(figure, trajectory, x=1 - (_LEGEND - 0.05) / w, y=1 - 0.2 / h, outside=outside)
    return figure


def trajectory_figure_3d(trajectory: Trajectory) -> Figure:
    """Draw the paths in space, one scale on all axes, in metres; the frame follows the truth, as in plan."""
    low, high = _scene(trajectory)
    figure = new_figure(9.5, 5.8)
    ax: Any = figure.add_axes((-0.01, -0.12, 0.85, 1.24), projection="3d")
    ax.view_init(elev=32, azim=-58)
    outside = _draw_paths(ax, trajectory, low, high, dimensions=3)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_zlim(low[2], high[2])
    ax.set_box_aspect(high - low, zoom=1.0)
    ax.tick_params(labelsize=SMALL, pad=0)
    ax.locator_params(axis="z", nbins=4)
    ax.set_xlabel("x [m]", fontsize=NORMAL)
    ax.set_ylabel("y [m]", fontsize=NORMAL)
    ax.set_zlabel("z [m]", fontsize=NORMAL, labelpad=-2)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_facecolor("#F7F7F7")
    _legend(figure, trajectory, x=0.86, y=0.93, outside=outside)
    return figure


def _scene(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return opposite corners (3,) in m of a box around everything true, with a margin."""
    points = np.concatenate([trajectory.position.reshape(-1, 3), trajectory.target_position.reshape(-1, 3)])
    points = points[np.isfinite(points).all(axis=-1)]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(_MARGIN_M, _MARGIN_SHARE * float(np.max(high - low)))
    low, high = low - margin, high + margin
    if low[2] < 0 <= points[:, 2].min():
        low[2] = 0.0
    return low, high


def _draw_paths(ax: Any, trajectory: Trajectory, low: np.ndarray, high: np.ndarray, dimensions: int) -> bool:
    """Draw landmarks, estimates, and the truth on top; return whether an estimate starts outside the box."""
    outside = False
    keep = thinned(len(trajectory.t))
    _draw_landmarks(ax, trajectory, keep, dimensions)
    for vehicle in range(len(trajectory.vehicles)):
        colour = vehicle_colour(vehicle)
        estimate = trajectory.position_estimate[keep, vehicle]
        within = (estimate >= low) & (estimate <= high)
        inside = np.all(within[:, :dimensions], axis=-1, keepdims=True)
        outside |= not inside[0, 0]
        shown = estimate if dimensions == 2 else np.where(inside, estimate, np.nan)  # 3-D axes do not clip
        ax.plot(*shown.T[:dimensions], color=colour, linewidth=1.6, alpha=0.8)
        face = colour if inside[0] else "white"
        _mark(ax, np.clip(estimate[0], low, high)[:dimensions], "^", edge=colour, face=face)
        if inside[-1]:
            _mark(ax, estimate[-1, :dimensions], "x", edge=colour, face=colour)
        truth = trajectory.position[keep, vehicle, :dimensions]
        ax.plot(*truth.T, color=INK, linewidth=1.1, linestyle=_DOTTED)
        _mark(ax, truth[0], "^", edge=INK, face=colour)
        _mark(ax, truth[-1], "x", edge=INK, face=INK)
        _label(ax, truth[0], vehicle_label(trajectory.vehicles[vehicle]), INK)
    return outside


def _draw_landmarks(ax: Any, trajectory: Trajectory, keep: np.ndarray, dimensions: int) -> None:
    vehicles = set(trajectory.vehicles.tolist())
    labels = target_labels(trajectory)
    for target, name in enumerate(trajectory.targets.tolist()):
        if name in vehicles:
            continue
        path = trajectory.target_position[keep, target, :dimensions]
        if trajectory.target_moving[target]:
            ax.plot(*path.T, color=DARK_BLUE, linewidth=1.1, linestyle=(0, (5, 1.5, 1, 1.5)))
            _mark(ax, path[0], "^", edge=DARK_BLUE, face=DARK_BLUE)
            _mark(ax, path[-1], "x", edge=DARK_BLUE, face=DARK_BLUE)
        else:
            _mark(ax, path[0], "o", edge=DARK_BLUE, face=DARK_BLUE)
        _label(ax, path[0], labels[target], DARK_BLUE)


def _mark(ax: Any, point: np.ndarray, marker: str, *, edge: str, face: str) -> None:
    ax.plot(*([value] for value in point), clip_on=False, zorder=4, **_marker(marker, edge, face))


def _marker(marker: str, edge: str, face: str) -> dict[str, Any]:
    return {
        "linestyle": "none",
        "marker": marker,
        "markersize": 6.5,
        "markeredgecolor": edge,
        "markerfacecolor": face,
        "markeredgewidth": 1.1,
    }


def _label(ax: Any, point: np.ndarray, text: str, colour: str) -> None:
    look = {
        "fontsize": NORMAL + 1,
        "color": colour,
        "zorder": 5,
        "path_effects": [withStroke(linewidth=2.0, foreground="white")],
    }
    if len(point) == 2:
        ax.annotate(text, point, xytext=(6, 5), textcoords="offset points", **look)
    else:
        ax.text(*point, f"  {text}", **look)


def _legend(figure: Figure, trajectory: Trajectory, x: float, y: float, *, outside: bool) -> None:
    handles = [
        Line2D([], [], color=vehicle_colour(i), linewidth=1.6, label=vehicle_label(name))
        for i, name in enumerate(trajectory.vehicles)
    ]
    handles += [
        Line2D([], [], color=INK, linewidth=1.1, linestyle=_DOTTED, label="truth"),
        Line2D([], [], color=INK, linewidth=1.6, alpha=0.8, label="estimate"),
        Line2D([], [], label="start", **_marker("^", INK, INK)),
        Line2D([], [], label="end", **_marker("x", INK, INK)),
        Line2D([], [], label="landmark", **_marker("o", DARK_BLUE, DARK_BLUE)),
    ]
    if outside:
        handles.append(Line2D([], [], label="starts outside", **_marker("^", INK, "white")))
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(x, y),
        fontsize=NORMAL,
        frameon=False,
        borderaxespad=0.0,
        handlelength=2.0,
    )
