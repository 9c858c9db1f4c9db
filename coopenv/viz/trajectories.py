"""The paths of vehicles and landmarks, in plan and in space: truth dotted, estimate solid."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from coopenv.estimation.metrics import SETTLED, live_ticks, settling_times
from coopenv.estimation.trajectory import Trajectory
from coopenv.scenario import Scenario
from coopenv.viz import style
from coopenv.viz.stage import Stage
from coopenv.viz.style import DARK_BLUE, GREY, INK, NORMAL, NOTE, vehicle_colour, vehicle_label
from coopenv.viz.topview_ground import ASPHALT, ROOF, WALL, draw_site

_DOTTED = (0, (1, 1.6))
_DASHED = (0, (5, 1.5, 1, 1.5))
_MARGIN_M, _MARGIN_SHARE = 0.5, 0.08  # around the truth
_DEPTH_SHARE = 0.25  # of the scene's extent: farther above or below, the frame does not follow an estimate
_TRANSIENT_SHARE = 0.1  # of the record, in which estimates come from anywhere
_PAGE, _NARROW_HEIGHT = 7.6, 4.2  # inches, width of the plan on a page and greatest height in a column
_LEGEND = 0.4  # inches, below the plan
_MOST_NAMES = 12  # landmarks; of more, names would cover the paths
_MARKS = 6  # at most, of time along a path
_EARLY: dict[str, Any] = {"linewidth": 0.7, "alpha": 0.6}
_STRETCHES = 150  # of a path
_FAINT: dict[str, Any] = {"linewidth": 0.5, "alpha": 0.3}
_ESTIMATE: dict[str, Any] = {"linewidth": 1.6, "alpha": 0.85}
_TRUTH: dict[str, Any] = {"color": INK, "linewidth": 1.1, "linestyle": _DOTTED}
_STEM: dict[str, Any] = {"color": NOTE, "linewidth": 0.7}


def clipped(path: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the parts (M, D) of a line (K, D) within a box, apart by rows of NaN, each cut where it meets a side."""
    path = np.asarray(path, float)
    if len(path) == 1:
        return path if np.all((path >= low) & (path <= high)) else np.empty((0, path.shape[1]))
    start = path[:-1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        step = np.diff(path, axis=0)
        to_low, to_high = (low - start) / step, (high - start) / step
        still = step == 0
        within = (start >= low) & (start <= high)
        enter = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(to_low, to_high)).max(axis=1)
        leave = np.where(still, np.inf, np.maximum(to_low, to_high)).min(axis=1)
        enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
        drawn = enter <= leave  # False for NaN
        rows = np.stack(
            [np.full_like(start, np.nan), start + enter[:, None] * step, start + leave[:, None] * step], axis=1
        )
    goes_on = np.append(False, drawn[:-1] & (leave[:-1] == 1.0)) & (enter == 0.0)
    used = np.column_stack([~goes_on, ~goes_on, drawn])[drawn]
    used[:1, 0] = False  # no gap before the first part
    return np.asarray(rows[drawn][used])


class Drawing:
    """Axes with lines, marks, and names that are placed at the end."""

    def __init__(self, ax: Any, low: np.ndarray, high: np.ndarray, dimensions: int) -> None:
        self.ax, self.low, self.high, self.dimensions = ax, low, high, dimensions
        self.outside = False  # an estimate starts outside the box
        self._marks: list[np.ndarray] = []
        self._lines: list[np.ndarray] = []
        self._names: list[tuple[str, np.ndarray, str]] = []

    def line(self, path: np.ndarray, **look: Any) -> None:
        """Draw the part of a path (K, 3) that lies in the box."""
        used = slice(self.dimensions)
        shown = clipped(path[:, used], self.low[used], self.high[used])
        self.ax.plot(*shown.T, **look)
        self._lines.append(shown)

    def mark(self, point: np.ndarray, marker: str, edge: str, face: str | None = None) -> None:
        """Mark a point (3,); the face has the colour of the edge unless another one is given."""
        point = point[: self.dimensions]
        self.ax.plot(*point[:, None], clip_on=False, zorder=4, **style.mark_look(marker, edge, face or edge))
        self._marks.append(point)

    def stem(self, point: np.ndarray, **look: Any) -> None:
        """Connect a point (3,) with the floor of the box, in space."""
        if self.dimensions == 3:
            foot = np.array([*point[:2], self.low[2]])
            self.line(np.stack([foot, point]), **look)

    def name(self, point: np.ndarray, text: str, colour: str) -> None:
        """Name a point (3,)."""
        self._names.append((text, point[: self.dimensions], colour))

    def write_names(self) -> None:
        """Arrange the figure, and write the names; the limits of the axes must be final."""
        self.ax.figure.draw_without_rendering()
        self.ax.apply_aspect()
        if not self._names:
            return
        texts, points, colours = zip(*self._names, strict=True)
        anchors = self._plane(np.array(points))
        marks, lines = self._plane(np.array(self._marks)), self._plane(np.concatenate(self._lines or [points]))
        pixels = self.ax.transData.transform
        offsets = style.place_names(texts, pixels(anchors), pixels(marks), pixels(lines), NORMAL + 1)
        look: dict[str, Any] = {"fontsize": NORMAL + 1, "path_effects": style.HALO, "zorder": 5}
        for text, anchor, offset, colour in zip(texts, anchors, offsets, colours, strict=True):
            self.ax.annotate(text, anchor, offset, textcoords="offset points", color=colour, **look)

    def _plane(self, points: np.ndarray) -> np.ndarray:
        """Return points (K, D) in the coordinates of the plane that is drawn."""
        if self.dimensions == 2:
            return points
        x, y, _ = proj3d.proj_transform(*points.T, self.ax.get_proj())
        return np.stack([x, y], axis=-1)


def trajectory_figure_2d(
    trajectory: Trajectory,
    ends: Sequence[float] | None = None,
    scenario: Scenario | None = None,
    width: float | None = None,
) -> Figure:
    """Draw the paths in plan, axes equal, in metres, over the roads and buildings of a scenario.

    The frame follows the truth. An estimate that starts outside enters from the edge, where an open triangle
    marks it; until it has settled its line is thin. Dots on the true paths mark the time. The paths of a vehicle stop
    at its end (s). Of a scenario's vehicles that the record is not about, only what is true is shown. `width` is in
    inches (None: a page's).
    """
    low, high = _scene(trajectory)
    inches = _PAGE if width is None else width
    room, most = inches - 0.75, _PAGE if inches > style.NARROW else _NARROW_HEIGHT
    scale = min(room / (high - low)[0], most / (high - low)[1])  # inches per metre
    drawn = np.maximum((high - low)[:2] * scale, (room, 0.45 * room))
    middle, half = (low[:2] + high[:2]) / 2, drawn / scale / 2
    low[:2], high[:2] = middle - half, middle + half
    figure, _ = style.canvas(inches, float(drawn[1]) + 0.6 + _LEGEND)
    ax = figure.add_subplot()
    style.tidy(ax, x_label="x [m]", y_label="y [m]")
    drawing = Drawing(ax, low, high, dimensions=2)
    handles = _draw_paths(drawing, trajectory, ends, scenario)
    if scenario is not None:
        draw_site(ax, Stage(scenario))
        handles += style.marks(
            (scenario.roads, "road", {"facecolor": ASPHALT, "edgecolor": "none"}),
            (scenario.obstacles, "building", {"facecolor": ROOF, "edgecolor": WALL, "hatch": "//"}),
        )
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal", adjustable="box")
    style.legend_above(figure, handles)
    drawing.write_names()
    return figure


def trajectory_figure_3d(
    trajectory: Trajectory,
    ends: Sequence[float] | None = None,
    scenario: Scenario | None = None,
    width: float | None = None,
) -> Figure:
    """Draw the paths in space, one scale on all axes, in metres; arguments, frame and ends as in plan.

    Stems show over which point of the floor a start, an end or a landmark is.
    """
    low, high = _scene(trajectory)
    steep = float((high - low)[2] / np.max((high - low)[:2]))
    inches = style.PAGE if width is None else width
    figure, _ = style.canvas(inches, inches * float(np.clip(0.52 + 0.4 * steep, 0.52, 0.9)) + _LEGEND)
    figure.set_layout_engine(None)  # which does not know how far labels in space reach
    ax: Any = figure.add_subplot(projection="3d")
    ax.view_init(elev=32, azim=-58)
    drawing = Drawing(ax, low, high, dimensions=3)
    for box in [] if scenario is None else Stage(scenario).buildings:
        *sides, _, top = np.clip(box.faces, low, high)
        ax.add_collection3d(Poly3DCollection([*sides, top], facecolor=ROOF, edgecolor=WALL, linewidth=0.6, alpha=0.35))
    handles = _draw_paths(drawing, trajectory, ends, scenario)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(high - low, zoom=float(np.clip((1.45 if inches > style.NARROW else 1.2) - 0.5 * steep, 0.7, 1.4)))
    ax.tick_params(labelsize=style.SMALL, pad=0)
    for axis, count in zip("xyz", (5, 5, 3), strict=True):
        ax.locator_params(axis=axis, nbins=count)
    ax.set_xlabel("x [m]", fontsize=NORMAL, color=INK, labelpad=0)
    ax.set_ylabel("y [m]", fontsize=NORMAL, color=INK, labelpad=0)
    ax.zaxis.set_major_formatter("{x:g} m")  # a label of the axis would be cut off at the side
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_facecolor("#F7F7F7")
    height = float(figure.get_figheight())
    style.legend_above(figure, handles)
    whole = float(figure.get_figheight())
    ax.set_position((0.0, 0.1 / whole, 1.0, (height - _LEGEND) / whole))
    drawing.write_names()
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
    drawing: Drawing, trajectory: Trajectory, ends: Sequence[float] | None, scenario: Scenario | None
) -> list[Line2D | Patch]:
    """Draw landmarks, estimates, and the truth on top; return the entries of the legend.

    A scenario's vehicles that the record is not about are estimated elsewhere.
    """
    others = {*trajectory.targets.tolist()} - {*trajectory.vehicles.tolist()}
    elsewhere = [] if scenario is None else [name for name in scenario.vehicle_names if name in others]
    _draw_landmarks(drawing, trajectory, elsewhere)
    live = live_ticks(trajectory.t, len(trajectory.vehicles), ends)
    settled = np.nan_to_num(settling_times(trajectory, ends, SETTLED), nan=np.inf)
    for vehicle, ticks in enumerate(live):
        keep = style.thinned(ticks)
        early = trajectory.t[keep] <= settled[vehicle]
        _draw_estimate(drawing, np.asarray(trajectory.position_estimate[keep, vehicle], float), early, vehicle)
    step = _round_step(float(trajectory.t[-1] - trajectory.t[0]))
    for vehicle, ticks in enumerate(live):
        truth, colour = trajectory.position[:ticks, vehicle], vehicle_colour(vehicle)
        drawing.line(truth[style.thinned(ticks)], **_TRUTH)
        whole = np.arange(step, float(trajectory.t[ticks - 1]), step)
        for k in np.searchsorted(trajectory.t, whole):
            drawing.mark(truth[min(k, ticks - 1)], ".", INK)
        for place, mark in ((truth[0], "^"), (truth[-1], "X")):
            drawing.stem(place, **_STEM)
            drawing.mark(place, mark, INK, colour)
        name = vehicle_label(trajectory.vehicles[vehicle])
        drawing.name(truth[0], name, INK)
        if np.linalg.norm(truth[-1] - truth[0]) > _MARGIN_SHARE * np.max(drawing.high - drawing.low):
            drawing.name(truth[-1], name, INK)
    motions = {moving for i, moving in _landmarks(trajectory) if trajectory.targets[i] not in elsewhere}
    names = enumerate(trajectory.vehicles)
    return style.marks(
        *((True, vehicle_label(name), {"color": vehicle_colour(i), "linewidth": 1.6}) for i, name in names),
        (True, "truth", _TRUTH),
        (True, "estimate", {"color": INK, **_ESTIMATE}),
        (True, "before it settles", {"color": INK, **_EARLY}),
        (True, f"every {step:g} s", style.mark_look(".", INK, INK)),
        (True, "true start", style.mark_look("^", INK, GREY)),
        (True, "first estimate", style.mark_look("^", GREY, GREY)),
        (True, "true end", style.mark_look("X", INK, GREY)),
        (True, "last estimate", style.mark_look("x", GREY, GREY)),
        (elsewhere, "received by radio", {"color": GREY, "linewidth": 1.1, "linestyle": _DOTTED}),
        (False in motions, "landmark", style.mark_look("o", DARK_BLUE, DARK_BLUE)),
        (True in motions, "moving landmark", {"color": DARK_BLUE, "linewidth": 1.1, "linestyle": _DASHED}),
        (drawing.outside, "starts outside", style.mark_look("^", INK, "white")),
    )


def _draw_estimate(drawing: Drawing, estimate: np.ndarray, early: np.ndarray, vehicle: int) -> None:
    """Draw an estimate's path (K, 3): thin where it is `early`, then its medians; mark where it begins and ends."""
    low, high, used, colour = drawing.low, drawing.high, slice(drawing.dimensions), vehicle_colour(vehicle)
    inside = np.all((estimate >= low)[:, used] & (estimate <= high)[:, used], axis=-1)
    last = int(early.sum())
    drawing.line(estimate[: last + 1], color=colour, **_EARLY)
    rest = estimate[last:]
    if len(rest):
        drawing.line(rest, color=colour, **_FAINT)
        ticks = np.arange(len(rest), dtype=float)  # medians hide less of the truth than the noise would
        middle = np.stack([style.summed_up(ticks, column, _STRETCHES)[1] for column in rest.T], axis=-1)
        drawing.line(np.concatenate([rest[:1], middle, rest[-1:]]), color=colour, **_ESTIMATE)
    if np.isfinite(estimate[0]).all():
        drawing.outside |= not inside[0]
        drawing.mark(np.clip(estimate[0], low, high), "^", colour, None if inside[0] else "white")
    if inside[-1]:
        drawing.mark(estimate[-1], "x", colour)


def _round_step(duration: float) -> float:
    """Return a round time, s, of which a duration has at most `_MARKS`."""
    least = max(duration, 1e-3) / _MARKS
    decade = 10.0 ** np.floor(np.log10(least))
    return float(next(decade * factor for factor in (1, 2, 5, 10) if decade * factor >= least))


def _draw_landmarks(drawing: Drawing, trajectory: Trajectory, elsewhere: Sequence[str]) -> None:
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
        drawing.stem(path[0], **_STEM)
        if len(_landmarks(trajectory)) <= _MOST_NAMES:
            drawing.name(path[0], labels[target], NOTE if colour == GREY else colour)


def _landmarks(trajectory: Trajectory) -> list[tuple[int, bool]]:
    """Return (index among the targets, whether it moves) of every landmark."""
    vehicles = set(trajectory.vehicles.tolist())
    names, moving = trajectory.targets.tolist(), trajectory.target_moving.tolist()
    return [(i, moves) for i, (name, moves) in enumerate(zip(names, moving, strict=True)) if name not in vehicles]
