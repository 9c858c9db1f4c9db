"""A scene in the browser, frame after frame: lines, names and messages on their way; live and in pages alike."""

from collections import deque
from typing import Any

import numpy as np

from coopenv.base.format import fixed
from coopenv.estimation.outcomes import Outcome, Sight
from coopenv.viz.scene import Frame, Source, Stage
from coopenv.viz.style import GREY, INK
from coopenv.viz.topview_geometry import Box, crossings
from coopenv.viz.web import ground
from coopenv.viz.web.actors import Actors, Batch, SentProperties, fine, placed
from coopenv.viz.web.ground import ROOT, Ground, Look, in_turn, linear, rgb, vehicle_colours

Coloured = tuple[np.ndarray, np.ndarray]
"""Segments (K, 2, 3), m, and their colours (K, 3) uint8."""
_DOTS, _DASHES = 16, 9  # of a line to a target that was missed, and to an estimate
_TRAIL, _TRAIL_STEP = 36, 0.2  # points, and s between them
_GROWTH = 32  # segments by which the arrays grow


class Segments:
    """A node of line segments whose number changes.

    Arrays have room for more, so that they seldom change their shape; unused segments lie in a single point.
    """

    def __init__(self, scene: Any, name: str, thickness: float) -> None:
        """Begin with none; the thickness is in pixels."""
        self._scene, self._name, self._thickness = scene, name, thickness
        self._room = 0
        self._node: SentProperties | None = None
        self._colours, self._shade = np.zeros((0, 3), np.uint8), np.zeros((0, 2, 3), np.uint8)

    def show(self, points: np.ndarray, colours: np.ndarray) -> None:
        """Show segments (K, 2, 3) in colours (K, 3); those with NaN are left out."""
        good = np.isfinite(points).all(axis=(1, 2))
        if not good.all():
            points, colours = points[good], colours[good]
        if self._node is not None:
            self._node.set(visible=len(points) > 0)
        if not len(points):
            return
        grown = len(points) > self._room
        if grown:
            self._room = -(-len(points) // _GROWTH) * _GROWTH
        whole = np.empty((self._room, 2, 3), np.float32)
        whole[: len(points)], whole[len(points) :] = points, points[0, 0]
        if grown or not np.array_equal(colours, self._colours):
            self._colours, shade = colours, linear(colours)
            self._shade = np.empty((self._room, 2, 3), np.uint8)
            self._shade[: len(points)], self._shade[len(points) :] = shade[:, None], shade[0]
        if self._node is None or grown:
            look: dict[str, Any] = {"thickness": self._thickness, "thickness_units": "screen"}
            self._node = SentProperties(self._scene.add_line_segments(self._name, whole, self._shade, **look))
        self._node.set(points=whole, colors=self._shade)


def joined(*parts: Coloured) -> Coloured:
    """Return all segments in one pair of arrays."""
    points = np.concatenate([np.asarray(points, float).reshape(-1, 2, 3) for points, _ in parts])
    return points, np.concatenate([np.asarray(colours, np.uint8).reshape(-1, 3) for _, colours in parts])


def sight_lines(stage: Stage, frame: Frame, colours: np.ndarray, look: Look) -> Coloured:
    """Return lines of sight: solid to visible targets, dotted to missed ones, and to hidden ones up to the occluder."""
    eye, target = stage.eyes(frame), stage.targets(frame)
    chosen = np.ones(stage.vehicles, bool)
    if look.only is not None:
        chosen = np.arange(stage.vehicles) == look.only

    def of(kind: Sight) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        observer, seen = np.nonzero((frame.sight == kind) & chosen[:, None])
        return eye[observer], target[seen], observer

    start, end, observer = of(Sight.VISIBLE)
    seen = np.stack([start, end], axis=1), colours[observer]
    start, end, observer = of(Sight.MISSED)
    missed = _dashed(start, end, colours[observer], _DOTS, 0.35)
    start, end, _ = of(Sight.OCCLUDED_BY_BUILDING)
    built = np.stack([start, stopped(start, end, stage.buildings)], axis=1), _one(GREY, len(start))
    start, end, _ = of(Sight.OCCLUDED_BY_BODY)
    bodies = stage.solid(frame) if len(start) else []
    bodily = np.stack([start, stopped(start, end, bodies)], axis=1), _one(INK, len(start))
    return joined(seen, missed, built, bodily)


def stopped(start: np.ndarray, end: np.ndarray, boxes: list[Box]) -> np.ndarray:
    """Return where paths from start to end (K, 3) first enter a box in which they do not start; else their ends."""
    if not len(start) or not boxes:
        return np.asarray(end)
    enter, leave = crossings(start, end - start, boxes)
    share = np.where((enter < leave) & (enter > 1e-6) & (enter < 1.0), enter, 1.0).min(axis=0)
    return np.asarray(start + share[:, None] * (end - start))


def error_lines(frame: Frame, colours: np.ndarray) -> Coloured:
    """Return dashed lines from true positions to estimates."""
    return _dashed(frame.vehicle_position, frame.estimate_position, colours, _DASHES, 0.6)


def way_lines(stage: Stage, frame: Frame, colours: np.ndarray, z: float) -> Coloured:
    """Return the routes that are drawn, and rings about the goals, at a height."""
    parts: list[Coloured] = [(np.zeros((0, 2, 3)), np.zeros((0, 3)))]
    for i, vehicle in enumerate(stage.scenario.vehicles):
        pale = (0.45 * colours[i] + 0.55 * 255.0)[None]
        points = frame.route[i, : int(frame.route_count[i])].copy()
        points[:, 2:] = z
        if frame.route_drawn[i] >= 0 and len(points) > 1:
            parts.append((np.stack([points[:-1], points[1:]], axis=1), np.repeat(pale, len(points) - 1, axis=0)))
        if vehicle.goal_radius > 0:
            ring = ground.circle(vehicle.goal_radius) + np.array([*frame.goal[i, :2], z])
            parts.append((ring, np.repeat(colours[i][None], len(ring), axis=0)))
    return joined(*parts)


class Trails:
    """Where vehicles have been in the last seconds."""

    def __init__(self) -> None:
        """Start without points."""
        self._points: deque[np.ndarray] = deque(maxlen=_TRAIL)
        self._times: deque[float] = deque(maxlen=_TRAIL)
        self._drawn: Coloured = np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8)

    def lines(self, frame: Frame, time: float, colours: np.ndarray, z: float) -> Coloured:
        """Add a frame and return the trails (paler where they are older), at a height; the same ones till they grow."""
        if self._times and not 0.0 <= time - self._times[-1] < 10.0 * _TRAIL_STEP:
            self._points.clear()
            self._times.clear()
        if not self._times or time - self._times[-1] >= _TRAIL_STEP - 1e-9:
            place = frame.vehicle_position.copy()
            place[:, 2] += z - place[:, 2]
            self._points.append(place)
            self._times.append(time)
            self._drawn = self._segments(colours)
        return self._drawn

    def _segments(self, colours: np.ndarray) -> Coloured:
        points = np.array(self._points)
        if len(points) < 2:
            return np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8)
        segments = np.stack([points[:-1], points[1:]], axis=2)  # (K, N, 2, 3)
        age = np.linspace(0.85, 0.35, len(segments))[:, None, None]
        shade = (1.0 - age) * colours + age * 255.0
        return segments.reshape(-1, 2, 3), shade.reshape(-1, 3).astype(np.uint8)


def _dashed(start: np.ndarray, end: np.ndarray, colours: np.ndarray, count: int, share: float) -> Coloured:
    """Return lines from start to end (K, 3) in so many dashes, which take up a share of them."""
    at = np.arange(count)[:, None, None] / count
    dashes = np.stack([start + at * (end - start), start + (at + share / count) * (end - start)], axis=2)
    return dashes.reshape(-1, 2, 3), np.tile(colours, (count, 1))


def _one(colour: str, count: int) -> np.ndarray:
    return np.tile(np.array(rgb(colour), np.uint8), (count, 1))


FLIGHT, PAUSE = 0.5, 1.0
"""s of the scene's time: how long a bead flies, and the least time between two of a link."""
_SIZE = 0.006  # of the scene's side


class Pulses:
    """Beads on the links between vehicles."""

    def __init__(self, scene: Any, stage: Stage, colours: np.ndarray) -> None:
        """Begin with none."""
        n = stage.vehicles
        self._stage = stage
        self._receiver, self._sender = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        self._batch = Batch(scene, f"{ROOT}/messages", ground.sphere(5), colours[self._sender])
        self._began = np.full(n * n, -np.inf)
        self._last = np.full(n * n, -1)
        self._time = -np.inf
        self._step = 2.0 ** np.floor(np.log2(stage.side * 1e-4))

    def place(self, frame: Frame, time: float, shown: bool) -> None:
        """Start the beads of messages that arrived since the last frame, and move the other beads on."""
        arrived = frame.inbox_tick.ravel()
        if time < self._time:
            self._began[:], self._last[:] = -np.inf, arrived
        new = (arrived > self._last) & (time >= self._began + PAUSE)
        self._began[new] = time
        self._last, self._time = arrived.copy(), time
        share = (time - self._began) / FLIGHT
        eye = self._stage.eyes(frame)
        start, end = eye[self._sender], eye[self._receiver]
        flying = (share >= 0.0) & (share <= 1.0) & (self._sender != self._receiver)
        at = start + np.where(flying, share, 0.0)[:, None] * (end - start)
        size = np.where(flying, _SIZE * self._stage.side, np.nan)[:, None].repeat(3, axis=1)
        self._batch.put(placed(None, fine(at, self._step), size), shown)


_OFTEN = 0.5  # s between two texts of a label
_CLOSE, _RAISED = 0.09, 0.035  # of the scene's side: vehicles so close have their names so far above each other
_APART = 0.06  # of the scene's side, distance from which on an estimate has a name of its own
_MOST_NAMES = 24  # landmarks; more would hide one another


class Labels:
    """Names over vehicles, estimates and landmarks."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """Add them."""
        self._stage, self._said = stage, -np.inf
        look: dict[str, Any] = {"anchor": "bottom-center", "depth_test": False}
        marks = [stage.short_name(stage.landmarks + i) for i in range(stage.vehicles)]
        self._cars = [SentProperties(scene.add_label(f"{ROOT}/names/{mark}", mark, **look)) for mark in marks]
        self._marks = marks
        self._marked, self._marks_at = False, np.zeros((0, 3))
        above = stage.bodies[0][:, 2] + 0.012 * stage.side
        self._above = np.column_stack([np.zeros((len(above), 2)), above])
        small = {**look, "font_screen_scale": 0.85}
        estimated = f"{ROOT}/names/estimates"
        self._estimates = [
            SentProperties(scene.add_label(f"{estimated}/{mark}", f"{mark} estimated", **small)) for mark in marks
        ]
        self._landmarks = {
            i: SentProperties(scene.add_label(f"{ROOT}/names/landmarks/{i}", stage.short_name(i), **small))
            for i, landmark in enumerate(stage.scenario.landmarks)
            if landmark.group is None and stage.landmarks <= _MOST_NAMES
        }

    def place(self, frame: Frame, time: float, shown: bool, turn: int | None = None) -> None:
        """Move the names; with a `turn` those of some vehicles, as in `Picture.show`."""
        again = not 0.0 <= time - self._said < _OFTEN - 1e-9
        self._said = time if again else self._said
        if again and shown:
            for i, label in enumerate(self._cars):
                label.set(text=self._text(frame, i))
        mine = in_turn(turn, self._stage.vehicles)
        places = frame.vehicle_position + self._above
        places[:, 2] += _RAISED * self._stage.side * levels(places[:, :2], _CLOSE * self._stage.side)
        for label, place in zip(self._cars[mine], places[mine], strict=True):
            _put(label, place, shown)
        self._place_estimates(frame, shown, mine)
        places = self._stage.targets(frame)[: self._stage.landmarks]
        if shown != self._marked or not np.array_equal(places, self._marks_at, equal_nan=True):
            self._marked, self._marks_at = shown, places
            for i, label in self._landmarks.items():
                _put(label, places[i] + [0.0, 0.0, 0.015 * self._stage.side], shown)

    def _place_estimates(self, frame: Frame, shown: bool, mine: slice) -> None:
        """Name the estimates that are not where their vehicles are."""
        places = (frame.estimate_position + self._above)[mine]
        inside = np.all((places[:, :2] > self._stage.low) & (places[:, :2] < self._stage.high), axis=-1)
        named = inside & (frame.position_error[mine] > _APART * self._stage.side)
        for label, place, there in zip(self._estimates[mine], places, named.tolist(), strict=True):
            _put(label, place, shown and there)

    def _text(self, frame: Frame, vehicle: int) -> str:
        mark, ended = self._marks[vehicle], int(frame.ended[vehicle])
        if ended == Outcome.UNDER_WAY:
            return f"{mark}  {fixed(frame.position_error[vehicle], 2)} m"
        known = {outcome.value for outcome in Outcome}
        return f"{mark}  {Outcome(ended).words}" if ended in known else f"{mark}  ended"


def levels(points: np.ndarray, close: float) -> np.ndarray:
    """Return (N,) on which level the name of each point (N, 2) stands: no two of one level are close to each other.

    Of two close points the northern one has the higher level: the first camera looks from the south.
    """
    near = np.linalg.norm(points[:, None] - points, axis=-1) < close
    level, done = np.zeros(len(points), int), np.zeros(len(points), bool)
    for i in np.argsort(points[:, 1], kind="stable"):
        taken = set(level[near[i] & done].tolist())
        level[i] = next(k for k in range(len(points)) if k not in taken)
        done[i] = True
    return level


def _put(label: SentProperties, place: np.ndarray, shown: bool) -> None:
    """Put a label to a place (3,), NaN: nowhere."""
    shown = shown and not np.isnan(place[0])
    label.set(visible=shown)
    if shown:
        label.set(position=tuple(place.round(3).tolist()))


FIELD_OF_VIEW = 0.72
"""Vertical angle of the first camera, rad."""
_VIEW_RAYS = 4  # every so many of a field of view are drawn


class Picture:
    """Draws frames of one stage into viser's scene."""

    def __init__(self, scene: Any, stage: Stage, source: Source, look: Look) -> None:
        """Draw the static part, and add the moving parts."""
        self.stage, self.look = stage, look
        self._scene, self._colours = scene, vehicle_colours(stage.vehicles)
        self.ground = Ground(scene, stage)
        self.actors = Actors(scene, stage, source, self.ground, self._colours)
        self._labels = Labels(scene, stage)
        self._pulses = Pulses(scene, stage, self._colours)
        self._trails = Trails()
        self._sight = Segments(scene, f"{ROOT}/sight", 2.0)
        self._errors = Segments(scene, f"{ROOT}/errors", 1.5)
        self._ways = Segments(scene, f"{ROOT}/ways", 2.0)
        self._trail = Segments(scene, f"{ROOT}/trails", 3.0)
        self._views: list[SentProperties] = []
        self._drawn_trail: Coloured | None = None
        self._trails_shown = True
        self._drawn_ways: tuple[bytes, ...] = ()
        self._step = 2.0 ** np.floor(np.log2(stage.side * 1e-4))

    def show(self, frame: Frame, turn: int | None = None) -> None:
        """Show a frame.

        Args:
            frame: to show.
            turn: number of the frame where another frame follows at once: then some names and fields of view wait
                for that frame, see `in_turn`.
        """
        time, look, nothing = float(frame.tick) / self.stage.scenario.rates.camera, self.look, np.zeros((0, 2, 3))
        none = nothing, np.zeros((0, 3), np.uint8)
        self.actors.place(frame, look)
        self._labels.place(frame, time, look.names, turn)
        self._pulses.place(frame, time, look.messages)
        trail = self._trails.lines(frame, time, self._colours, self.ground.z + 1e-3 * self.stage.side)
        if trail is not self._drawn_trail or look.trails != self._trails_shown:
            self._drawn_trail, self._trails_shown = trail, look.trails
            self._show(self._trail, trail if look.trails else none)
        sight = sight_lines(self.stage, frame, self._colours, look) if look.sight else none
        self._show(self._sight, sight)
        self._show(self._errors, error_lines(frame, self._colours) if look.estimates else none)
        ways = (frame.goal.tobytes(), frame.route_count.tobytes(), frame.route_drawn.tobytes(), frame.route.tobytes())
        if ways != self._drawn_ways:
            self._drawn_ways = ways
            self._show(self._ways, way_lines(self.stage, frame, self._colours, self.ground.z))
        self._show_views(frame, turn)

    def _show(self, node: Segments, what: Coloured) -> None:
        node.show(fine(what[0], self._step), what[1])

    def _show_views(self, frame: Frame, turn: int | None) -> None:
        mine = in_turn(turn if self._views else None, self.stage.vehicles)
        views = self.stage.fields_of_view(frame, _VIEW_RAYS, mine) if self.look.views else None
        if views is None:
            for view in self._views:
                view.set(visible=False)
            return
        views[..., 2] = (self.ground.z + 2e-4 * self.stage.side * np.arange(1, self.stage.vehicles + 1))[mine, None]
        corners = fine(views, self._step)
        if not self._views:
            self._add_views(corners)
        there = np.isfinite(corners).all(axis=(1, 2)).tolist()
        for i, view in enumerate(self._views[mine]):
            view.set(visible=there[i])
            if there[i]:
                view.set(vertices=corners[i])

    def _add_views(self, corners: np.ndarray) -> None:
        n = np.arange(1, corners.shape[1] - 1)
        faces = np.stack([np.zeros_like(n), n + 1, n], axis=-1)
        flat: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False, "side": "double", "opacity": 0.16}
        for i, colour in enumerate(self._colours.tolist()):
            mesh = self._scene.add_mesh_simple(f"{ROOT}/views/{i}", corners[i], faces, color=tuple(colour), **flat)
            self._views.append(SentProperties(mesh))


def first_camera(stage: Stage, aspect: float = 1.6) -> tuple[np.ndarray, np.ndarray]:
    """Return where the first camera is and what it looks at, (3,) each; from the south, the whole square in sight."""
    middle = np.array([*(stage.low + stage.high) / 2, 0.0])
    direction = np.array([-0.12, -0.72, 0.85])
    half = np.tan(FIELD_OF_VIEW / 2) * min(1.0, aspect)
    distance = 0.52 * stage.side / half
    return middle + distance * direction / np.linalg.norm(direction), middle


def useful_magnification(sigma: np.ndarray, side: float) -> float:
    """Return the magnification, 1, 10 or 100, at which an ellipsoid of semi-axes (N,), m, can be seen."""
    good = sigma[np.isfinite(sigma)]
    middle = float(np.median(good)) if len(good) else side
    return next((factor for factor in (1.0, 10.0) if factor * middle > 0.01 * side), 100.0)
