"""Static background of the top view: axes, roads, buildings, names of landmarks, and the panel's legend."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation, Text
from scipy.spatial.transform import Rotation

from coopenv.episode import Frame
from coopenv.estimation import Sight
from coopenv.observers.registry import states_covariance
from coopenv.scenario import Scenario
from coopenv.scenario.routes import even_points
from coopenv.scenario.schema import agent_starts
from coopenv.viz import style
from coopenv.viz.stage import CORNERS, Stage, nose_shapes, outlines, paths, roads, vehicle_mark, ways
from coopenv.viz.style import (
    DARK_BLUE,
    DPI,
    GREY,
    INK,
    NORMAL,
    SMALL,
    legend,
    mark_look,
    new_figure,
    place_names,
    vehicle_colour,
)

WIDTH, HEIGHT = 896, 672  # px; multiples of 16, as video codecs like them
LEFT, BOTTOM, SIDE = 54, 46, 592  # px, of the square axes
_WORDS = 36  # px, from the axes to what is written beside them, whatever numbers stand between
MAP_RIGHT, MAP_WIDTH = LEFT + SIDE, LEFT + SIDE + 6  # px, right edge of the axes, and with what stands out there
PANEL = MAP_RIGHT + 12  # px, left edge of the panel
SMALLER = 6.5  # pt
ROW = 16  # px
TABLE_TOP = HEIGHT - 66  # px
MOST_ROWS = 16
SWATCH = 8  # px
HALO = (withStroke(linewidth=2.2, foreground="white"),)
_RIM = 0.9  # pt, of marks
_LENGTH = 0.04  # of the side of the map, least length of a vehicle before an episode
LARGEST_ELLIPSE = 0.3  # of the side of the map, semi-axis of an ellipse that is drawn

GROUND, ASPHALT, WALL, ROOF, TRAFFIC = "#F4F2EC", "#E2E2E2", "#8A8172", "#C9C2B4", "#6E6E6E"
DASHED, DOTTED, DASH_DOTTED = (0, (4, 2.5)), (0, (1, 1.8)), (0, (5, 1.8, 1, 1.8))

SIGHT_LOOKS: dict[Sight, dict[str, object]] = {
    Sight.VISIBLE: {"linewidth": 1.1, "alpha": 0.9},
    Sight.MISSED: {"linewidth": 1.1, "linestyle": DOTTED},
    Sight.OCCLUDED_BY_BUILDING: {"linewidth": 0.9, "linestyle": DASHED, "color": GREY},
    Sight.OCCLUDED_BY_BODY: {"linewidth": 1.1, "linestyle": DASHED, "color": INK},
}
"""Lines of sight; lines without a colour have their observer's."""
READING_LOOK: dict[str, object] = {"linewidth": 1.1, "linestyle": DASH_DOTTED}
"""Measurements of sensors beside the camera, in the colour of the vehicle."""


def pixels(x: float, y: float) -> tuple[float, float]:
    """Return figure coordinates of a pixel counted from the lower left corner."""
    return x / WIDTH, y / HEIGHT


def new_ground(stage: Stage) -> tuple[Figure, Axes]:
    """Return a figure with everything that does not change during an episode."""
    figure = new_figure((WIDTH + 0.1) / DPI, (HEIGHT + 0.1) / DPI)
    ax = figure.add_axes((*pixels(LEFT, BOTTOM), *pixels(SIDE, SIDE)))
    ax.set_facecolor(GROUND)
    style.tidy(ax, x_label="x [m]", y_label="y [m]")
    ax.grid(True, color="white", linewidth=0.8)
    ax.xaxis.labelpad = 1
    ax.yaxis.set_label_coords(-_WORDS / SIDE, 0.5)
    ax.spines[:].set(visible=True, linewidth=0.6, color=GREY)
    ax.set(xlim=(stage.low[0], stage.high[0]), ylim=(stage.low[1], stage.high[1]))
    ax.set_aspect("equal")
    ax.set_autoscale_on(False)
    figure.text(*pixels(LEFT, HEIGHT - 21), stage.scenario.title, fontsize=NORMAL + 1.5, color=INK)
    draw_site(ax, stage)
    return figure, ax


def draw_site(ax: Axes, stage: Stage) -> None:
    """Draw roads and buildings in plan."""
    origin = stage.origin[:2]
    for road, corners in zip(stage.scenario.roads, roads(stage.scenario), strict=True):
        ax.add_patch(Polygon(corners, color=ASPHALT, zorder=0.5))
        if road.marked:
            line = np.array([road.start, road.end]) - origin
            ax.plot(*line.T, color="white", linewidth=1.2, linestyle=(0, (7, 6)), zorder=0.6)
    for *_, top in (box.faces for box in stage.buildings):
        ax.add_patch(Polygon(top[:, :2], facecolor=ROOF, edgecolor=WALL, linewidth=1.2, hatch="//", zorder=1))


def site_figure(scenario: Scenario) -> Figure:
    """Draw the top view before an episode: nominal places, routes, and prescribed motions."""
    stage = Stage(scenario)
    figure, ax = new_ground(stage)
    fixed = np.array([not landmark.is_drawn for landmark in scenario.landmarks], bool)
    single = np.array([landmark.group is None and landmark.is_drawn for landmark in scenario.landmarks], bool)
    corners = [shape for group in scenario.landmark_groups for shape in group.parallelograms]
    areas = [np.array([c, c + u, c + u + v, c + v])[:, :2] - stage.origin[:2] for c, u, v in np.array(corners)]
    areas_look: dict[str, Any] = {"facecolor": "#00264D40", "edgecolor": DARK_BLUE, "linewidth": 0.9}
    ax.add_collection(PolyCollection(areas, **areas_look), autolim=False)
    along = paths(scenario)
    start, turn = np.array([path[0] for path in along]), agent_starts(scenario)[1][stage.landmarks :]
    colours = [vehicle_colour(i) for i in range(stage.vehicles)]
    routes = [even_points(route)[:, :2] - stage.origin[:2] for route in scenario.routes]
    ax.add_collection(LineCollection(routes, color=GREY, linewidth=0.9, zorder=0.7), autolim=False)
    ax.add_collection(LineCollection(along[stage.landmarks :], colors=colours, linewidth=1.1), autolim=False)
    looks = [mark_look("o", DARK_BLUE, face, 5.5, _RIM) for face in (DARK_BLUE, "white")]
    for look, chosen in zip(looks, (fixed, single), strict=True):
        ax.plot(*start[: stage.landmarks][chosen].T, **look)
    name_landmarks(ax, scenario)
    size, centre = stage.bodies(_LENGTH * stage.side)
    shapes = centre[:, None, :2] + size[:, None, :2] / 2 * CORNERS
    turn = Rotation.from_euler("z", ways(scenario)[:, None]).as_matrix() @ turn
    for part, face in ((shapes, colours), (nose_shapes(shapes), "white")):
        shown = PolyCollection(list(outlines(turn, start[stage.landmarks :], part)), facecolors=face)
        ax.add_collection(shown, autolim=False)
    marks = style.marks(
        (True, "vehicle, nominal start", {"facecolor": GREY}),
        (fixed.any(), "landmark", looks[0]),
        (single.any(), "landmark drawn at reset", looks[1]),
        (areas, "area of drawn landmarks", areas_look),
        (routes, "route", {"color": GREY, "linewidth": 0.9}),
        (any(len(path) > 1 for path in along), "prescribed motion", {"color": GREY, "linewidth": 1.1}),
        (scenario.obstacles, "building", {"facecolor": ROOF, "edgecolor": WALL, "hatch": "//"}),
    )
    legend(figure, marks, "upper left", pixels(PANEL - 4, TABLE_TOP))
    return figure


def name_landmarks(ax: Axes, scenario: Scenario) -> list[Annotation]:
    """Write the names of landmarks that are always in the same place, and return them."""
    fixed = [m for m in scenario.landmarks if m.motion.kind == "static" and not m.is_drawn]
    places = np.array([np.add(m.position, m.marker) for m in fixed]).reshape(-1, 3) - np.array(scenario.map.origin)
    at = ax.transData.transform(places[:, :2])
    offsets = place_names([m.name for m in fixed], at, at, np.zeros((0, 2)), SMALL)
    named = zip(fixed, places, offsets.tolist(), strict=True)
    return [label_landmark(ax, landmark.name, place, (x, y)) for landmark, place, (x, y) in named]


def label_landmark(ax: Axes, name: str, place: np.ndarray, offset: tuple[float, float] = (4.5, 4.5)) -> Annotation:
    """Write a landmark's name beside it; `offset` is that of the name's lower left corner, pt."""
    look: dict[str, Any] = {"path_effects": [withStroke(linewidth=1.8, foreground="white")], "annotation_clip": True}
    look |= {"textcoords": "offset points", "fontsize": SMALL, "color": DARK_BLUE}
    return ax.annotate(name, (float(place[0]), float(place[1])), offset, **look)


def draw_legend(figure: Figure, stage: Stage, rows: int) -> None:
    """Explain the marks that can occur in a scenario, under a table of `rows` rows."""
    scenario, largest = stage.scenario, LARGEST_ELLIPSE * stage.side
    sensed, end = scenario.topology.mode == "sensed", scenario.termination
    goals, bodies = (any(getattr(vehicle, part) for vehicle in scenario.vehicles) for part in ("goal_radius", "body"))
    honest = states_covariance(scenario.observer.name)
    way = ", and its way" if np.any(ways(scenario)) else ""
    shown: dict[Sight, dict[str, Any]] = {kind: {"color": GREY, **look} for kind, look in SIGHT_LOOKS.items()}
    marks = style.marks(
        (True, "vehicle, true" + way, {"facecolor": GREY, "edgecolor": INK, "linewidth": 0.7}),
        (True, "its estimate", {"facecolor": "white", "edgecolor": GREY, "linewidth": 1.4}),
        (True, "error of the estimate", {"color": GREY, "linewidth": 1.0, "linestyle": DASH_DOTTED}),
        (honest, f"3σ, where below {largest:.2g} m", {"facecolor": "#7F7F7F30", "edgecolor": GREY, "linewidth": 0.8}),
        (not honest, "no 3σ: P is a gain matrix", mark_look("$-$", INK, INK, 5, _RIM)),
        (stage.sees_a_part, "field of view", {"facecolor": "#7F7F7F24", "edgecolor": "none"}),
        (True, "sees (its colour)", shown[Sight.VISIBLE]),
        (sensed and scenario.obstacles, "hidden by a building", shown[Sight.OCCLUDED_BY_BUILDING]),
        (sensed, "hidden by a body", shown[Sight.OCCLUDED_BY_BODY]),
        (any(camera.miss_probability > 0 for camera in scenario.cameras), "in view, but missed", shown[Sight.MISSED]),
        (True, "landmark", mark_look("o", DARK_BLUE, DARK_BLUE, 5, _RIM)),
        (stage.moving.any(), "moving landmark", mark_look("D", DARK_BLUE, DARK_BLUE, 4.5, _RIM)),
        (scenario.cosimulator, "other traffic", {"facecolor": TRAFFIC, "edgecolor": "white", "linewidth": 0.8}),
        (goals, "goal", mark_look("o", GREY, "white", 7, _RIM)),
        (goals and end.arrival, "arrived", mark_look("*", INK, "white", 9, _RIM)),
        (bodies and end.collision, "collided", mark_look("X", "white", INK, 8, _RIM)),
        (True, "estimate outside", mark_look(">", GREY, "white", 6, _RIM)),
    )
    place = pixels(PANEL - 4, TABLE_TOP - ROW * (rows + 1))
    gaps = {"borderaxespad": 0.0, "borderpad": 0.0, "handlelength": 1.9, "labelspacing": 0.42}
    legend(figure, marks, "upper left", place, labelcolor=INK, **gaps)


class Layers:
    """The moving artists of a figure, from below to above in the order in which they are added."""

    def __init__(self, figure: Figure, axes: Axes) -> None:
        self._figure, self._axes = figure, axes
        self._canvas = cast(FigureCanvasAgg, figure.canvas)
        self._artists: list[Artist] = []
        self._background: Any = None

    def polygons(self, **look: Any) -> Any:
        """Add a collection of polygons, in axes coordinates."""
        return self.keep(self._axes.add_collection(PolyCollection([], **look), autolim=False))

    def lines(self, **look: Any) -> Any:
        """Add a collection of lines, in axes coordinates."""
        return self.keep(self._axes.add_collection(LineCollection([], **look), autolim=False))

    def points(self, marker: str, face: str, edge: str, size: float) -> Any:
        """Add points, in axes coordinates; `size` in pt."""
        return self.keep(self._axes.add_line(Line2D([], [], **mark_look(marker, edge, face, size, _RIM))))

    def keep(self, artist: Any) -> Any:
        """Add an artist that is already in the figure."""
        artist.set_animated(True)
        self._artists.append(artist)
        return artist

    def paint(self) -> np.ndarray:
        """Return the picture, (H, W, 3) uint8; what is no layer must not have changed since the first one."""
        if self._background is None:
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self._figure.bbox)
        self._canvas.restore_region(self._background)
        renderer = self._canvas.get_renderer()
        for artist in self._artists:
            artist.draw(renderer)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


_CORNERS = 48  # of the polygon that stands for a circle
_ANGLE = np.linspace(0.0, 2 * np.pi, _CORNERS, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=-1)
_GAP = 3  # px between goals and their name
_MOST_NAMES = 3  # that stand for goals which touch one another; of the others there is the number


class Goals:
    """The goals of all vehicles, and the routes that vehicles have drawn."""

    def __init__(self, scenario: Scenario, layers: Layers) -> None:
        """Add all but the names."""
        there = [i for i, vehicle in enumerate(scenario.vehicles) if vehicle.goal_radius > 0]
        self._there = there
        self._radius = np.array([scenario.vehicles[i].goal_radius for i in there])
        colours = to_rgba_array([vehicle_colour(i) for i in there])
        self._routes = layers.lines(linewidth=0.9, alpha=0.55)
        self._discs = layers.polygons(facecolor="white", edgecolor="none", alpha=0.6)
        self._rims = layers.polygons(facecolor="none", edgecolor=colours, linestyle=DOTTED, linewidth=1.6)

    def add_names(self, axes: Axes, layers: Layers, others: Sequence[Text]) -> None:
        """Add the names, over all that has been added before and where `others`, which stand still, are not."""
        low, self._end = axes.get_xlim()
        self._pixel = (self._end - low) / axes.get_window_extent().width  # m
        taken = [axes.transData.inverted().transform(other.get_window_extent()) for other in others]
        self._taken = np.array(taken).reshape(-1, 2, 2)  # m, lower left and upper right corners
        look: dict[str, Any] = {"fontsize": SMALL, "va": "center", "clip_on": True, "color": INK, "path_effects": HALO}
        self._names: list[Text] = [layers.keep(axes.text(0, 0, "", **look)) for _ in self._there]

    def place(self, frame: Frame) -> None:
        """Move them to where they are now."""
        center = frame.goal[self._there, :2]
        shapes = center[:, None] + self._radius[:, None, None] * _CIRCLE
        self._discs.set_verts(list(shapes))
        self._rims.set_verts(list(shapes))
        groups = touching(center, self._radius) if len(self._there) <= MOST_ROWS else []  # more names would overlap
        for name, members in zip(self._names, groups + [[]] * (len(self._names) - len(groups)), strict=True):
            named = len(members) if len(members) <= _MOST_NAMES else _MOST_NAMES - 1
            marks = ", ".join(vehicle_mark(self._there[k]) for k in members[:named])
            name.set_text(marks + (f" +{len(members) - named}" if len(members) > named else ""))
            if members:
                self._put(name, center[members], self._radius[members])
        drawn = [i for i in self._there if frame.route_drawn[i] >= 0]
        self._routes.set_segments([frame.route[i, : int(frame.route_count[i]), :2] for i in drawn])
        self._routes.set_color([vehicle_colour(i) for i in drawn])

    def _put(self, name: Text, center: np.ndarray, radius: np.ndarray) -> None:
        """Write a name into a goal if it fits, else to the right of it, or to the left, where no other name is."""
        extent = name.get_window_extent()
        wide, tall, gap = extent.width * self._pixel, extent.height * self._pixel, _GAP * self._pixel
        left, right = float((center[:, 0] - radius).min()), float((center[:, 0] + radius).max())
        y = float((center[:, 1].min() + center[:, 1].max()) / 2)
        places = [right + gap, left - gap - wide]  # of the name's left end
        if len(center) == 1 and wide + 2 * gap < right - left:
            places.insert(0, (left + right - wide) / 2)
        inside = [x for x in places if x + wide < self._end] or places[-1:]
        name.set(x=next((x for x in inside if self._is_free(x, y, wide, tall)), inside[0]), y=y)

    def _is_free(self, x: float, y: float, wide: float, tall: float) -> bool:
        """Return whether a name of a size would cover no other one; `x`, `y`: the middle of its left side, m."""
        low, high = np.array([x, y - tall / 2]), np.array([x + wide, y + tall / 2])
        return not ((self._taken[:, 0] < high) & (self._taken[:, 1] > low)).all(axis=1).any()


def touching(center: np.ndarray, radius: np.ndarray) -> list[list[int]]:
    """Return the indices of circles, centres (N, 2) and radii (N,), in groups that touch one another."""
    groups: list[list[int]] = []
    for i in range(len(center)):
        if not np.isfinite(center[i]).all():
            continue
        reach = np.linalg.norm(center - center[i], axis=-1) < radius + radius[i]
        near = [group for group in groups if reach[group].any()]
        groups = [group for group in groups if group not in near] + [sorted(sum(near, [i]))]
    return groups
