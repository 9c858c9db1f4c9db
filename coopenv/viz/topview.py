"""The top view of an environment: lines of sight, estimates and their errors."""

from typing import Any

import numpy as np
from matplotlib.colors import to_rgba_array
from matplotlib.patches import Rectangle
from scipy.spatial.transform import Rotation

from coopenv.base.format import fixed
from coopenv.episode import Frame, FrameSource
from coopenv.estimation import Outcome
from coopenv.observers.registry import states_covariance
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Body
from coopenv.viz import stage as geometry
from coopenv.viz import topview_ground as ground
from coopenv.viz.stage import Stage
from coopenv.viz.style import DARK_BLUE, INK, NORMAL, vehicle_colour
from coopenv.viz.topview_ground import Goals, Layers


class PictureWindow:
    """One window, opened by the first picture and reused by the next ones."""

    def __init__(self, title: str) -> None:
        self._title, self._silent = title, False
        self._image: Any = None

    def show(self, picture: np.ndarray) -> None:
        """Show an (H, W, 3) uint8 picture and let the window react to the user, who may close it for good."""
        if self._image is None and not self._silent:
            self._image = _opened(self._title, picture)
        if self._image is None:
            self._silent = True
            return
        from matplotlib import pyplot as plt

        if plt.fignum_exists(self._image.figure.number):
            self._image.set_data(picture)
            self._image.figure.canvas.draw_idle()
            self._image.figure.canvas.flush_events()

    def close(self) -> None:
        """Close the window; the next picture opens a new one."""
        if self._image is not None:
            from matplotlib import pyplot as plt

            plt.close(self._image.figure)
        self._image, self._silent = None, False


def _opened(title: str, picture: np.ndarray) -> Any:
    """Return the picture of a new window; None where there is no display or no interactive backend."""
    try:
        from matplotlib import pyplot as plt
        from matplotlib.backends.registry import BackendFilter, backend_registry

        if plt.get_backend().lower() not in backend_registry.list_builtin(BackendFilter.INTERACTIVE):
            return None
        dpi = 100
        figure = plt.figure(num=None, figsize=(picture.shape[1] / dpi, picture.shape[0] / dpi), dpi=dpi)
    except Exception:  # each toolkit raises its own error where it is not installed or finds no display
        return None
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    manager: Any = figure.canvas.manager
    manager.set_window_title(title)
    manager.show()
    return ax.imshow(picture)


_SHORTEST = 28  # px, drawn length of a vehicle
_POINTER, _CROSS = 13, 30  # px; a cross on a sensor that measures its place is wider than a vehicle
_LABEL = 3  # px between a vehicle and its name
_FARTHEST = 10.0  # pictures' sides from the middle, of an estimate as drawn
_POINT = Body(size=(2e-3, 1e-3, 1e-3))  # stands in for a vehicle without a body, drawn at the least size


class TopView:
    """Draws one world of an engine from above.

    The picture depends on the engine's present state alone. The static part is drawn once; the few artists that
    move are kept and updated.
    """

    def __init__(self, scenario: Scenario, *, panel: bool = True) -> None:
        """Draw the ground.

        Args:
            scenario: of the engine.
            panel: table and legend beside the map; without them the mean error of those under way stands above it.
        """
        self.scenario, self._panel = scenario, panel
        self._error_words = "mean error" if len(scenario.vehicles) > 1 else "error"
        self._stage = Stage(scenario)
        self._gain = not states_covariance(scenario.observer.name)
        self._figure, self._axes = ground.new_ground(self._stage)
        self._layers = Layers(self._figure, self._axes)
        self._pixel = self._stage.side / self._axes.get_window_extent().width  # m
        self._prepare_shapes()
        self._prepare_artists()
        self._prepare_table()
        self._window = PictureWindow(scenario.title)

    def draw(self, engine: FrameSource) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of world 0, as wide as the map if that is all."""
        return self.paint(Frame.of(engine))

    def paint(self, frame: Frame) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of a frame, as wide as the map if that is all."""
        self._place_ellipses(frame)
        self._goals.place(frame)
        self._place_bodies(frame)
        there = frame.traffic_half[:, 0] > 0.0
        corners = frame.traffic_half[there, None, :2] * geometry.CORNERS
        outline = geometry.outlines(frame.traffic_rotation[there], frame.traffic_position[there, :2], corners)
        self._traffic.set_verts(outline)
        self._place_sight(frame)
        self._place_marks(frame)
        self._write(frame)
        picture = self._layers.paint()
        return picture if self._panel else picture[:, : ground.MAP_WIDTH].copy()

    def show(self, picture: np.ndarray) -> None:
        """Show a picture in a window, if there is a display."""
        self._window.show(picture)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._window.close()

    def _prepare_shapes(self) -> None:
        s = self.scenario
        shortest = _SHORTEST * self._pixel
        boxes = geometry.box_shapes([vehicle.body or _POINT for vehicle in s.vehicles], shortest)
        noses = geometry.nose_shapes(boxes)
        turn, still = Rotation.from_euler("z", geometry.ways(s)[:, None]).as_matrix(), np.zeros((len(boxes), 2))
        self._box, self._nose = geometry.outlines(turn, still, boxes), geometry.outlines(turn, still, noses)
        bodies = {i: landmark.body for i, landmark in enumerate(s.landmarks) if landmark.body}
        self._others, self._other_box = list(bodies), geometry.box_shapes(list(bodies.values()), shortest)
        flank = np.stack([boxes[:, :, 0].mean(axis=1), boxes[:, 2, 1]], axis=-1)
        aside = np.tile([0.0, 1.0], (len(flank), 1))
        self._flank = geometry.outlines(turn, still, np.stack([flank, aside], axis=1))

    def _prepare_artists(self) -> None:
        layers = self._layers
        self._goals = Goals(self.scenario, layers)
        colours = [vehicle_colour(i) for i in range(len(self.scenario.vehicles))]
        self._rgba = to_rgba_array(colours)
        self._wedges = layers.polygons(facecolor=to_rgba_array(self._rgba, 0.11), edgecolor="none")
        pale, strong = to_rgba_array(self._rgba, 0.09), to_rgba_array(self._rgba, 0.8)
        self._ellipses = layers.polygons(facecolor=pale, edgecolor=strong, linewidth=1.0)
        self._readings = layers.lines(**ground.READING_LOOK)
        self._sight = {sight: layers.lines(**look) for sight, look in ground.SIGHT_LOOKS.items()}
        self._still = layers.points("o", DARK_BLUE, "white", 5.5)
        self._other = layers.polygons(facecolor=DARK_BLUE, edgecolor="white", linewidth=0.8)
        self._moving = layers.points("D", DARK_BLUE, "white", 5.5)
        self._traffic = layers.polygons(facecolor=ground.TRAFFIC, edgecolor="white", linewidth=0.8)
        self._truth = layers.polygons(facecolor=self._rgba, edgecolor=INK, linewidth=0.8)
        self._truth_nose = layers.polygons(facecolor="white", edgecolor="none")
        self._links = layers.lines(color=colours, linewidth=1.0, linestyle=ground.DASH_DOTTED)
        self._casing = layers.polygons(facecolor="none", edgecolor="white", linewidth=2.3)
        self._estimate = layers.polygons(facecolor="none", edgecolor=self._rgba, linewidth=1.1)
        self._estimate_nose = layers.polygons(facecolor="none", edgecolor=self._rgba, linewidth=0.9)
        self._pointers = layers.polygons(facecolor="white", edgecolor=self._rgba, linewidth=1.3)
        self._strays = layers.polygons(facecolor=self._rgba, edgecolor=self._rgba, linewidth=1.3)
        self._arrived = layers.points("*", "white", INK, 12)
        self._collided = layers.points("X", INK, "white", 11)
        landmarks = [layers.keep(name) for name in ground.name_landmarks(self._axes, self.scenario)]
        self._goals.add_names(self._axes, layers, landmarks)
        look: dict[str, Any] = {"fontsize": NORMAL, "weight": "bold", "color": INK, "path_effects": ground.HALO}
        look |= {"ha": "center", "va": "center", "clip_on": True}
        named = range(ground.MOST_ROWS)  # vehicles of the table: more names would overlap
        marks = (geometry.vehicle_mark(i) if i in named else "" for i in range(len(colours)))
        self._names = [layers.keep(self._axes.text(0, 0, mark, **look)) for mark in marks]
        boxes = [name.get_window_extent() for name in self._names]
        self._half_name = np.array([(box.width, box.height) for box in boxes]) / 2 * self._pixel
        self._moving_names = {
            i: layers.keep(ground.label_landmark(self._axes, m.name, np.zeros(2)))
            for i, m in enumerate(self.scenario.landmarks)
            if (m.motion.kind != "static" or m.is_drawn) and m.group is None  # names of a group say little, and overlap
        }

    def _prepare_table(self) -> None:
        count = len(self.scenario.vehicles)
        shown = min(count, ground.MOST_ROWS)
        x, aligned = (ground.PANEL, "left") if self._panel else (ground.MAP_RIGHT, "right")
        place = ground.pixels(x, ground.HEIGHT - 21)
        size = NORMAL + 1.5 if self._panel else NORMAL
        title = self._figure.text(*place, "", fontsize=size, weight="bold", color=INK, ha=aligned)
        self._time = self._layers.keep(title)
        if not self._panel:  # the title leaves room beside it
            title.set_text(f"{self._error_words} 00.00 m   t = 000.00 s")
            room = ground.MAP_RIGHT - ground.LEFT - title.get_window_extent().width - 10  # px
            name = self._figure.texts[0]
            name.set_fontsize(float(name.get_fontsize()) * min(1.0, room / name.get_window_extent().width))
        look: dict[str, Any] = {"fontsize": ground.SMALLER, "family": "monospace"}
        head = f"{'':6}{'error':>7}{'error':>7}{'3σ':>7}{'sees':>6}\n{'':6}{'[m]':>7}{'[deg]':>7}{'[m]':>7}"
        self._figure.text(*ground.pixels(ground.PANEL, ground.TABLE_TOP), head, color=INK, va="bottom", **look)
        places = [ground.pixels(ground.PANEL, ground.TABLE_TOP - ground.ROW * (i + 1)) for i in range(shown + 1)]
        self._rows = [self._layers.keep(self._figure.text(*place, "", color=INK, **look)) for place in places[:shown]]
        side = ground.pixels(ground.SWATCH, ground.SWATCH)
        rim: dict[str, Any] = {"edgecolor": INK, "linewidth": 0.5, "transform": self._figure.transFigure}
        for i, place in enumerate(places[:shown]):
            swatch = Rectangle(place, *side, facecolor=vehicle_colour(i), **rim)
            self._figure.add_artist(swatch)
        if count > shown:
            self._figure.text(*places[-1], f"and {count - shown} more", color=INK, **look)
        ground.draw_legend(self._figure, self._stage, shown + 1)

    def _place_ellipses(self, frame: Frame) -> None:
        """Place the 3-sigma ellipses of estimates in sight, but for large ones."""
        stage, estimate = self._stage, frame.position_estimate[:, :2]
        shapes, semi = geometry.ellipses(estimate, frame.position_covariance[:, :2, :2])
        inside = np.all((estimate >= stage.low) & (estimate <= stage.high), axis=-1)
        shapes[~inside | ~(semi <= ground.LARGEST_ELLIPSE * stage.side) | self._gain] = np.nan
        self._ellipses.set_verts(shapes)

    def _place_bodies(self, frame: Frame) -> None:
        R, R_hat, outlines = frame.rotation, frame.rotation_estimate, geometry.outlines
        place = frame.position[:, :2]
        guess = self._stage.nearer(frame.position_estimate[:, :2], _FARTHEST)
        self._truth.set_verts(outlines(R, place, self._box))
        self._truth_nose.set_verts(outlines(R, place, self._nose))
        self._casing.set_verts(outlines(R_hat, guess, self._box))
        self._estimate.set_verts(outlines(R_hat, guess, self._box))
        self._estimate_nose.set_verts(outlines(R_hat, guess, self._nose))
        others = self._others
        self._other.set_verts(
            outlines(frame.target_rotation[others], frame.target_position[others, :2], self._other_box)
        )
        self._links.set_segments(list(np.stack([place, guess], axis=1)))
        corners, size = (self._stage.low, self._stage.high), _POINTER * self._pixel
        self._pointers.set_verts(geometry.pointers(place, guess, *corners, size))
        self._strays.set_verts(geometry.pointers(guess, place, *corners, size))

    def _place_sight(self, frame: Frame) -> None:
        target, eye = self._stage.targets(frame)[:, :2], self._stage.eyes(frame)[:, :2]
        for kind, lines in self._sight.items():
            observer, seen = np.nonzero(frame.sight == kind)
            lines.set_segments(list(np.stack([eye[observer], target[seen]], axis=1)))
            if "color" not in ground.SIGHT_LOOKS[kind]:
                lines.set_color(to_rgba_array(self._rgba[observer], 0.9))
        observer, lines = self._stage.reading_lines(frame, _CROSS * self._pixel)
        self._readings.set_segments(list(lines[..., :2]))
        self._readings.set_color(to_rgba_array(self._rgba[observer], 0.9))
        wedges = self._stage.fields_of_view(frame)
        if wedges is not None:
            self._wedges.set_verts(wedges[..., :2])
        moving = np.flatnonzero(self._stage.moving)
        self._still.set_data(*np.delete(target[: frame.landmarks], moving, axis=0).T)
        self._moving.set_data(*target[moving].T)
        for i, name in self._moving_names.items():
            name.set_visible(bool(np.isfinite(target[i]).all()))
            body = self.scenario.landmarks[i].body
            above = 0.0 if body is None else float(np.abs(frame.target_rotation[i, 1]) @ np.array(body.size) / 2)
            name.xy = (float(target[i, 0]), float(target[i, 1]) + above)

    def _place_marks(self, frame: Frame) -> None:
        R, position = frame.rotation, frame.position[:, :2]
        place = geometry.outlines(R, position, self._box.mean(axis=1, keepdims=True))[:, 0]
        self._arrived.set_data(*place[frame.ended == Outcome.ARRIVED].T)
        self._collided.set_data(*place[frame.ended == Outcome.COLLIDED].T)
        flank = geometry.outlines(R, position, self._flank[:, :1])[:, 0]
        aside = geometry.outlines(R, np.zeros_like(flank), self._flank[:, 1:])[:, 0]
        half = np.sum(np.abs(aside) * self._half_name, axis=-1, keepdims=True)  # of the name, away from the vehicle
        beside = flank + (half + _LABEL * self._pixel) * aside
        for name, (x, y) in zip(self._names, beside.tolist(), strict=True):
            name.set_position((x, y))

    def _write(self, frame: Frame) -> None:
        time = float(frame.tick) / self.scenario.rates.camera
        errors = frame.position_error[frame.ended == Outcome.UNDER_WAY]
        error = f"{self._error_words} {fixed(errors.mean(), 2)} m   " if len(errors) and not self._panel else ""
        self._time.set_text(f"{error}t = {time:.2f} s")
        table = frame.table(not self._gain)
        for i, row in enumerate(self._rows):
            row.set_text("  {:<4}{:>7}{:>7}{:>7}{:>6}".format(geometry.vehicle_mark(i), *table[i]))
