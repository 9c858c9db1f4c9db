"""The paths of vehicles and landmarks, in plan and in space: truth dotted, estimate solid."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import proj3d

from coopenv.estimation.metrics import live_ticks
from coopenv.estimation.trajectory import Trajectory
from coopenv.scenario import Scenario
from coopenv.viz import style
from coopenv.viz.clipping import clipped
from coopenv.viz.labels import place_names
from coopenv.viz.style import DARK_BLUE, GREY, INK, NORMAL, vehicle_colour, vehicle_label
from coopenv.viz.topview_ground import ASPHALT, ROOF, WALL, draw_site

_DOTTED = (0, (1, 1.6))
_DASHED = (0, (5, 1.5, 1, 1.5))
_MARGIN_M, _MARGIN_SHARE = 0.5, 0.08  # around the truth
_DEPTH_SHARE = 0.25  # of the scene's extent: farther above or below, the frame does not follow an estimate
_TRANSIENT_SHARE = 0.1  # of the record, in which estimates come from anywhere
_LEGEND = 1.85  # inches
_NAME = NORMAL + 1  # pt


class _Drawing:
    """Axes with what has been drawn on them, names to be placed at the end."""

    def __init__(self, ax: Any, low: np.ndarray, high: np.ndarray, dimensions: int) -> None:
        self.ax, self.low, self.high, self.dimensions = ax, low, high, dimensions
        self.outside = False  # an estimate starts outside the box
        self._marks: list[np.ndarray] = []
        self._lines: list[np.ndarray] = []
        self._names: list[tuple[str, np.ndarray, str]] = []

    def line(self, path: np.ndarray, **look: Any) -> None:
        """Draw what lies in the box of a path (K, 3)."""
        used = slice(self.dimensions)
        shown = clipped(path[:, used], self.low[used], self.high[used])
        self.ax.plot(*shown.T, **look)
        self._lines.append(shown)

    def mark(self, point: np.ndarray, marker: str, edge: str, face: str | None = None) -> None:
        """Mark a point (3,); the face has the colour of the edge unless another one is given."""
        point = point[: self.dimensions]
        self.ax.plot(*point[:, None], clip_on=False, zorder=4, **_marker(marker, edge, face or edge))
        self._marks.append(point)

    def name(self, point: np.ndarray, text: str, colour: str) -> None:
        """Name a point (3,)."""
        self._names.append((text, point[: self.dimensions], colour))

    def write_names(self) -> None:
        """Write the names; the limits of the axes must be final."""
        self.ax.apply_aspect()
        if not self._names:
            return
        texts, points, colours = zip(*self._names, strict=True)
        anchors = self._plane(np.array(points))
        marks, lines = self._plane(np.array(self._marks)), self._plane(np.concatenate(self._lines or [points]))
        pixels = self.ax.transData.transform
        offsets = place_names(texts, pixels(anchors), pixels(marks), pixels(lines), _NAME)
        look: dict[str, Any] = {"fontsize": _NAME, "path_effects": style.HALO, "zorder": 5}
        for text, anchor, offset, colour in zip(texts, anchors, offsets, colours, strict=True):
            self.ax.annotate(text, anchor, offset, textcoords="offset points", color=colour, **look)

    def _plane(self, points: np.ndarray) -> np.ndarray:
        """Return points (K, D) in the coordinates of the plane that is drawn."""
        if self.dimensions == 2:
            return points
        x, y, _ = proj3d.proj_transform(*points.T, self.ax.get_proj())
        return np.stack([x, y], axis=-1)


def trajectory_figure_2d(
    trajectory: Trajectory, ends: Sequence[float] | None = None, scenario: Scenario | None = None
) -> Figure:
    """Draw the paths in plan, axes equal, in metres, over the roads and buildings of a scenario.

    The frame follows the truth. An estimate that starts outside enters from the edge, where an open triangle
    marks it. The paths of a vehicle stop at its end (s). Of a scenario's vehicles that the record is not about, only
    what is true is shown.
    """
    low, high = _scene(trajectory)
    width, depth = high[:2] - low[:2]
    scale = min(6.6 / width, 6.6 / depth)  # inches per metre
    drawn = np.maximum((width * scale, depth * scale), 2.4)
    middle, half = (low[:2] + high[:2]) / 2, drawn / scale / 2
    low[:2], high[:2] = middle - half, middle + half
    w, h = float(drawn[0]) + 0.75 + _LEGEND, float(drawn[1]) + 0.75
    figure = style.new_figure(w, h)
    ax = figure.add_axes((0.65 / w, 0.55 / h, drawn[0] / w, drawn[1] / h))
    style.tidy(ax, x_label="x [m]", y_label="y [m]")
    if scenario is not None:
        draw_site(ax, scenario)
    drawing = _Drawing(ax, low, high, dimensions=2)
    _draw_paths(drawing, trajectory, ends, _elsewhere(trajectory, scenario))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal", adjustable="datalim")
    drawing.write_names()
    _legend(
        figure,
        trajectory,
        (1 - (_LEGEND - 0.1) / w, 1 - 0.2 / h),
        drawing.outside,
        _elsewhere(trajectory, scenario),
        scenario,
    )
    return figure


def trajectory_figure_3d(
    trajectory: Trajectory, ends: Sequence[float] | None = None, scenario: Scenario | None = None
) -> Figure:
    """Draw the paths in space, one scale on all axes, in metres; frame and ends as in plan."""
    low, high = _scene(trajectory)
    figure = style.new_figure(9.5, 5.8)
    ax: Any = figure.add_axes((-0.01, -0.12, 0.85, 1.24), projection="3d")
    ax.view_init(elev=32, azim=-58)
    drawing = _Drawing(ax, low, high, dimensions=3)
    _draw_paths(drawing, trajectory, ends, _elsewhere(trajectory, scenario))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    steep = float((high - low)[2] / np.max((high - low)[:2]))
    ax.set_box_aspect(high - low, zoom=float(np.clip(1.2 - 0.5 * steep, 0.7, 1.0)))
    ax.tick_params(labelsize=style.SMALL, pad=0)
    ax.locator_params(axis="z", nbins=4)
    ax.set_xlabel("x [m]", fontsize=NORMAL)
    ax.set_ylabel("y [m]", fontsize=NORMAL)
    ax.set_zlabel("z [m]", fontsize=NORMAL, labelpad=-2)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_facecolor("#F7F7F7")
    drawing.write_names()
    _legend(figure, trajectory, (0.84, 0.93), drawing.outside, _elsewhere(trajectory, scenario))
    return figure


def _scene(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return opposite corners (3,) in m of a box around everything true, with a margin.

    The box reaches below the ground, and as high, as estimates go once they have come near.
    """
    points = np.concatenate([trajectory.position.reshape(-1, 3), trajectory.target_position.reshape(-1, 3)])
    points = points[np.isfinite(points).all(axis=-1)]
    if not len(points):
        return np.full(3, -1.0), np.full(3, 1.0)
    least, most = points.min(axis=0), points.max(axis=0)
    extent = float(np.max(most - least))
    margin = max(_MARGIN_M, _MARGIN_SHARE * extent)
    low, high = least - margin, most + margin
    if low[2] < 0 <= least[2]:
        low[2] = 0.0
    later = int(_TRANSIENT_SHARE * len(trajectory.t))
    z = trajectory.position_estimate[later:, :, 2]
    reach = margin + _DEPTH_SHARE * extent
    z = z[(z > least[2] - reach) & (z < most[2] + reach)]
    if len(z):
        pad = 0.2 * margin
        low[2] = min(low[2], float(z.min()) - pad) if z.min() < low[2] else low[2]
        high[2] = max(high[2], float(z.max()) + pad)
    return low, high


def _draw_paths(
    drawing: _Drawing, trajectory: Trajectory, ends: Sequence[float] | None, elsewhere: Sequence[str]
) -> None:
    """Draw landmarks, estimates, and the truth on top."""
    low, high = drawing.low, drawing.high
    used = slice(drawing.dimensions)
    _draw_landmarks(drawing, trajectory, elsewhere)
    for vehicle, ticks in enumerate(live_ticks(trajectory.t, len(trajectory.vehicles), ends)):
        keep = style.thinned(ticks)
        colour = vehicle_colour(vehicle)
        estimate = np.asarray(trajectory.position_estimate[keep, vehicle], float)
        inside = np.all((estimate >= low)[:, used] & (estimate <= high)[:, used], axis=-1)
        drawing.line(estimate, color=colour, linewidth=1.6, alpha=0.8)
        if np.isfinite(estimate[0]).all():
            drawing.outside |= not inside[0]
            start = np.clip(estimate[0], low, high)
            drawing.mark(start, "^", colour, None if inside[0] else "white")
        if inside[-1]:
            drawing.mark(estimate[-1], "x", colour)
        truth = trajectory.position[keep, vehicle]
        drawing.line(truth, color=INK, linewidth=1.1, linestyle=_DOTTED)
        drawing.mark(truth[0], "^", INK, colour)
        drawing.mark(truth[-1], "x", INK)
        drawing.name(truth[0], vehicle_label(trajectory.vehicles[vehicle]), INK)


def _draw_landmarks(drawing: _Drawing, trajectory: Trajectory, elsewhere: Sequence[str]) -> None:
    keep = style.thinned(len(trajectory.t))
    labels = style.target_labels(trajectory)
    for target, moving in _landmarks(trajectory):
        path = trajectory.target_position[keep, target]
        path = path[np.isfinite(path).all(axis=-1)]
        colour, dash = (GREY, _DOTTED) if trajectory.targets[target] in elsewhere else (DARK_BLUE, _DASHED)
        if not len(path):
            continue
        if moving:
            drawing.line(path, color=colour, linewidth=1.1, linestyle=dash)
            drawing.mark(path[0], "^", colour)
            drawing.mark(path[-1], "x", colour)
        else:
            drawing.mark(path[0], "o", colour)
        drawing.name(path[0], labels[target], colour)


def _landmarks(trajectory: Trajectory) -> list[tuple[int, bool]]:
    """Return (index among the targets, whether it moves) of every landmark."""
    vehicles = set(trajectory.vehicles.tolist())
    names, moving = trajectory.targets.tolist(), trajectory.target_moving.tolist()
    return [(i, moves) for i, (name, moves) in enumerate(zip(names, moving, strict=True)) if name not in vehicles]


def _elsewhere(trajectory: Trajectory, scenario: Scenario | None) -> list[str]:
    """Return the names of vehicles that the record is not about: they are estimated elsewhere."""
    return [] if scenario is None else [n for n in scenario.vehicle_names if n not in trajectory.vehicles]


def _marker(marker: str, edge: str, face: str) -> dict[str, Any]:
    look = {"marker": marker, "markeredgecolor": edge, "markerfacecolor": face}
    return {"linestyle": "none", "markersize": 6.5, "markeredgewidth": 1.1, **look}


def _legend(
    figure: Figure,
    trajectory: Trajectory,
    place: tuple[float, float],
    outside: bool,
    elsewhere: Sequence[str],
    scenario: Scenario | None = None,
) -> None:
    truth = {"color": INK, "linewidth": 1.1, "linestyle": _DOTTED}
    looks: dict[str, dict[str, Any]] = {
        vehicle_label(name): {"color": vehicle_colour(i), "linewidth": 1.6}
        for i, name in enumerate(trajectory.vehicles)
    }
    looks |= {"truth": truth, "estimate": {"color": INK, "linewidth": 1.6, "alpha": 0.8}}
    looks |= {"true start": _marker("^", INK, GREY), "first estimate": _marker("^", GREY, GREY)}
    looks |= {"end": _marker("x", INK, INK)}
    if elsewhere:
        looks["heard by radio"] = {"color": GREY, "linewidth": 1.1, "linestyle": _DOTTED}
    motions = {moving for i, moving in _landmarks(trajectory) if trajectory.targets[i] not in elsewhere}
    if False in motions:
        looks["landmark"] = _marker("o", DARK_BLUE, DARK_BLUE)
    if True in motions:
        looks["moving landmark"] = {"color": DARK_BLUE, "linewidth": 1.1, "linestyle": _DASHED}
    if outside:
        looks["starts outside"] = _marker("^", INK, "white")
    handles: list[Line2D | Patch] = [Line2D([], [], label=label, **look) for label, look in looks.items()]
    if scenario is not None and scenario.roads:
        handles.append(Patch(facecolor=ASPHALT, edgecolor="none", label="road"))
    if scenario is not None and scenario.obstacles:
        handles.append(Patch(facecolor=ROOF, edgecolor=WALL, hatch="//", label="building"))
    style.legend(figure, handles, "upper left", place, fontsize=NORMAL, borderaxespad=0.0, handlelength=2.0)
