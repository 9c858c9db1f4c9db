"""A scene in the browser, frame after frame: bodies, lines, names, messages on their way; live and in pages alike."""

from collections import deque
from typing import Any

import numpy as np

from coopenv.base.format import fixed
from coopenv.episode import Frame, Origin, semi_axes
from coopenv.estimation import Outcome, Sight
from coopenv.viz import meshes
from coopenv.viz.meshes import (
    NOTHING,
    ROOT,
    Coloured,
    Ground,
    Look,
    MeshNode,
    Segments,
    dashes,
    fine,
    placed,
    update,
)
from coopenv.viz.stage import Box, Stage, entries, vehicle_mark
from coopenv.viz.style import DARK_BLUE, GREY, INK, rgb, vehicle_colour
from coopenv.viz.topview_ground import TRAFFIC

_SHELL = 1.08  # size of an estimate: around the true vehicle, so that both are seen where they agree
_LARGEST = 0.5  # of the scene's side, largest semi-axis of an ellipsoid that is drawn
_HONEST, _GAIN = 0.2, 0.08  # opacity of an ellipsoid: of a covariance, of a matrix of gains
_STEPS, _TURN = 32, 2.0**-9  # of an ellipsoid: sizes in a doubling, and steps of its quaternion
_SMALL = 0.25  # of that, where the view is near
_LIT: dict[str, Any] = {"flat_shading": True, "cast_shadow": True}
_PIN = 0.035  # of the scene's side, height of the pin over a vehicle, which is drawn to scale


def pin_height(stage: Stage, look: Look) -> float:
    """Return the height of the pin over a vehicle, m."""
    return _PIN * stage.side * (_SMALL if look.picked is not None and look.follow else 1.0)


class Actors:
    """Everything that moves but lines."""

    def __init__(self, scene: Any, stage: Stage, source: Origin, floor: Ground, colours: np.ndarray) -> None:
        """Add the nodes."""
        self._scene, self._stage, self._floor = scene, stage, floor
        self._size, self._center = stage.bodies()
        white = np.full((stage.vehicles, 3), 255, np.uint8)
        self.cars = MeshNode(scene, f"{ROOT}/cars/true", meshes.car(), colours, **_LIT)
        dark = np.tile(rgb(meshes.DARK), (stage.vehicles, 1))
        self._trims = MeshNode(scene, f"{ROOT}/cars/trim", meshes.car_trim(), dark, **_LIT)
        self._pins = MeshNode(scene, f"{ROOT}/cars/pins", meshes.pin(), colours, flat_shading=True)
        self._arrows = MeshNode(scene, f"{ROOT}/cars/front", meshes.arrow(), white, side="double")
        self._ghosts = MeshNode(scene, f"{ROOT}/estimates/body", meshes.car(), colours, opacity=0.32, flat_shading=True)
        self._frames = MeshNode(scene, f"{ROOT}/estimates/edges", meshes.box(), colours, wireframe=True, opacity=0.5)
        self._ellipsoids = MeshNode(scene, f"{ROOT}/ellipsoids", meshes.sphere(), colours, opacity=_HONEST)
        self.set_source(source)
        dark = np.tile(rgb(DARK_BLUE), (stage.landmarks, 1))
        self._dots = MeshNode(scene, f"{ROOT}/landmarks/dots", meshes.sphere(6), dark, cast_shadow=True)
        self._poles = MeshNode(scene, f"{ROOT}/landmarks/poles", meshes.pole(), dark, cast_shadow=True)
        bodies = sum(landmark.body is not None for landmark in stage.scenario.landmarks)
        self._boxes = MeshNode(scene, f"{ROOT}/landmarks/bodies", meshes.box(), dark[:bodies])
        self._marks = np.zeros((0, 3))
        self._traffic: MeshNode | None = None

    def set_source(self, source: Origin) -> None:
        """Set the source: ellipsoids of a gain matrix are paler than ellipsoids of a covariance."""
        self._ellipsoids.handle.opacity = _HONEST if source.honest else _GAIN

    def place(self, frame: Frame, look: Look) -> None:
        """Move everything to where it is in a frame."""
        R, R_hat, step, side = frame.rotation, frame.rotation_estimate, self._floor.step, self._stage.side
        at = fine(frame.position + (R @ self._center[..., None])[..., 0], step)
        estimated = self._near(frame.position_estimate + (R_hat @ self._center[..., None])[..., 0])
        true, ghosts = placed(R, at, self._size), placed(R_hat, estimated, _SHELL * self._size)
        self.cars.put(true)
        self._arrows.put(true)
        self._trims.put(true)
        pin = pin_height(self._stage, look)
        top = at + self._size * [0.0, 0.0, 0.5] + [0.0, 0.0, 0.1 * pin]
        self._pins.put(placed(None, fine(top, step), np.full((len(top), 3), pin)))
        self._ghosts.put(ghosts, look.estimates)
        self._frames.put(ghosts, look.estimates)
        semi, axes = semi_axes(frame.position_covariance)
        semi *= look.magnification
        drawn = semi[:, 2] <= _LARGEST * side
        steps = np.log2(np.maximum(np.where(drawn[:, None], semi, np.nan), step / 4)) * _STEPS
        semi = 2.0 ** (np.round(steps) / _STEPS)
        self._ellipsoids.put(placed(axes, self._near(frame.position_estimate), semi, _TURN), look.ellipsoids)
        self._place_landmarks(frame)
        if len(frame.traffic_half):
            if self._traffic is None:
                grey = np.tile(rgb(TRAFFIC), (len(frame.traffic_half), 1))
                self._traffic = MeshNode(self._scene, f"{ROOT}/traffic", meshes.car(), grey, **_LIT)
            size = np.where(frame.traffic_half[:, :1] > 0.0, 2.0 * frame.traffic_half, np.nan)
            self._traffic.put(placed(frame.traffic_rotation, fine(frame.traffic_position, step), size))

    def _near(self, points: np.ndarray) -> np.ndarray:
        return fine(self._stage.nearer(points, meshes.FAR), self._floor.step)

    def _place_landmarks(self, frame: Frame) -> None:
        L, side, step = self._stage.landmarks, self._stage.side, self._floor.step
        place = self._stage.targets(frame)[:L]
        if np.array_equal(place, self._marks, equal_nan=True):
            return
        self._marks = place
        self._dots.put(placed(None, fine(place, step), np.full((L, 3), meshes.DOT * side)))
        foot = np.column_stack([place[:, :2], np.full(L, self._floor.z)])
        thick = np.full((L, 2), 0.2 * meshes.DOT * side)
        self._poles.put(placed(None, fine(foot, step), np.column_stack([thick, np.maximum(place - foot, 0.0)[:, 2]])))
        boxes = [box for box in self._stage.solid(frame) if 0 <= box.agent < L]
        if boxes:
            R, center, size = (
                np.array([getattr(box, part) for box in boxes]) for part in ("rotation", "center", "size")
            )
            self._boxes.put(placed(R, fine(center, step), size))


_ANGLE = np.linspace(0.0, 2 * np.pi, 33)
_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE), np.zeros(33)], axis=-1)
_DOTS, _DASHES = 16, 9  # of a line to a target that was missed, and to an estimate
_TRAIL, _TRAIL_STEP = 36, 0.2  # points, and s between them


def _joined(parts: list[Coloured]) -> Coloured:
    """Return all segments in one pair of arrays."""
    points = np.concatenate([np.asarray(points, float).reshape(-1, 2, 3) for points, _ in parts])
    return points, np.concatenate([np.asarray(colours, np.uint8).reshape(-1, 3) for _, colours in parts])


def sight_lines(stage: Stage, frame: Frame, colours: np.ndarray, look: Look) -> Coloured:
    """Return lines of sight: solid to visible targets, dotted to missed ones, and to hidden ones up to the occluder."""
    eye, target = stage.eyes(frame), stage.targets(frame)
    chosen = (np.arange(stage.vehicles) == look.picked) | (not look.alone or look.picked is None)
    parts = []
    for kind in (Sight.VISIBLE, Sight.MISSED, Sight.OCCLUDED_BY_BUILDING, Sight.OCCLUDED_BY_BODY):
        observer, seen = np.nonzero((frame.sight == kind) & chosen[:, None])
        start, end, shade = eye[observer], target[seen], colours[observer]
        if kind == Sight.MISSED:
            parts.append((dashes(start, end, _DOTS, 0.35), np.tile(shade, (_DOTS, 1))))
            continue
        if kind == Sight.OCCLUDED_BY_BUILDING:
            end, shade = stopped(start, end, stage.buildings), np.tile(rgb(GREY), (len(start), 1))
        elif kind == Sight.OCCLUDED_BY_BODY and len(start):
            end, shade = stopped(start, end, stage.solid(frame)), np.tile(rgb(INK), (len(start), 1))
        parts.append((np.stack([start, end], axis=1), shade))
    vehicles, lines = stage.reading_lines(frame)
    shown = chosen[vehicles]
    parts.append((lines[shown], colours[vehicles[shown]]))
    return _joined(parts)


def stopped(start: np.ndarray, end: np.ndarray, boxes: list[Box]) -> np.ndarray:
    """Return the first entries of paths (start to end, (K, 3)) into a box that they start outside; else the ends."""
    enter = entries(start, end - start, boxes)
    share = np.where(enter > 1e-6, enter, np.inf).min(axis=0, initial=1.0)
    return np.asarray(start + share[:, None] * (end - start))


def way_lines(stage: Stage, frame: Frame, colours: np.ndarray, z: float) -> Coloured:
    """Return the routes that are drawn, and rings about the goals, at a height."""
    parts = [NOTHING]
    for i, vehicle in enumerate(stage.scenario.vehicles):
        points = frame.route[i, : int(frame.route_count[i])].copy()
        points[:, 2:] = z
        ring = vehicle.goal_radius * _CIRCLE + [*frame.goal[i, :2], z]
        pale = 0.45 * colours[i] + 0.55 * 255.0
        for path, colour, drawn in (
            (points, pale, frame.route_drawn[i] >= 0),
            (ring, colours[i], vehicle.goal_radius > 0),
        ):
            if drawn and len(path) > 1:
                parts.append((np.stack([path[:-1], path[1:]], axis=1), np.tile(colour, (len(path) - 1, 1))))
    return _joined(parts)


def level_lines(frame: Frame, colours: np.ndarray, look: Look, largest: float, z: float) -> Coloured:
    """Return circles of the protection levels, up to a radius, about the estimates at a height."""
    radius = frame.protection_level[:, 0]
    drawn = (look.levels | (np.arange(len(radius)) == look.picked)) & (radius <= largest)
    points = frame.position_estimate[drawn, None] + radius[drawn, None, None] * _CIRCLE
    points[..., 2] = z
    segments = np.stack([points[:, :-1], points[:, 1:]], axis=2)  # (drawn, 32, 2, 3)
    return segments.reshape(-1, 2, 3), np.repeat(colours[drawn], segments.shape[1], axis=0)


class Trails:
    """Positions of vehicles in the last seconds."""

    def __init__(self) -> None:
        """Start without points."""
        self._points: deque[np.ndarray] = deque(maxlen=_TRAIL)
        self._time = np.inf
        self._drawn = NOTHING

    def lines(self, frame: Frame, time: float, colours: np.ndarray, z: float) -> Coloured:
        """Add a frame and return the trails (paler where they are older), at a height; the same ones till they grow."""
        if not 0.0 <= time - self._time < 10.0 * _TRAIL_STEP:
            self._points.clear()
        if not self._points or time - self._time >= _TRAIL_STEP - 1e-9:
            place = frame.position.copy()
            place[:, 2] += z - place[:, 2]
            self._points.append(place)
            self._time = time
            points = np.array(self._points)
            segments = np.stack([points[:-1], points[1:]], axis=2)  # (K, N, 2, 3)
            age = np.linspace(0.85, 0.35, len(segments))[:, None, None]
            shade = (1.0 - age) * colours + age * 255.0
            self._drawn = segments.reshape(-1, 2, 3), shade.reshape(-1, 3).astype(np.uint8)
        return self._drawn


FLIGHT, PAUSE = 0.5, 1.0
"""Flight time of a bead, and least time between two beads of a link, s of the scene's time."""
_SIZE = 0.006  # of the scene's side


class MessageBeads:
    """Beads on the links between vehicles."""

    def __init__(self, scene: Any, stage: Stage, floor: Ground, colours: np.ndarray) -> None:
        """Begin with none."""
        n = stage.vehicles
        self._stage, self._step = stage, floor.step
        self._receiver, self._sender = (part.ravel() for part in np.indices((n, n)))
        self._batch = MeshNode(scene, f"{ROOT}/messages", meshes.sphere(5), colours[self._sender])
        self._began = np.full(n * n, -np.inf)
        self._last = np.full(n * n, -1)
        self._time = -np.inf

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


_AT_ONCE = 4  # names and fields of view in a frame while it plays
_OFTEN = 0.5  # s between two texts of a label
_CLOSE, _RAISED = 0.09, 0.035  # of the scene's side: vehicles so close have their names so far above each other
_APART = 0.06  # of the scene's side, distance from which on an estimate has a name of its own
_MOST_NAMES = 24  # landmarks; more would hide one another


def in_turn(turn: int | None, count: int) -> slice:
    """Return the indices of the names, or fields of view, that are sent in a turn: half, at most four; None: all."""
    parts = max(2, -(-count // _AT_ONCE))
    return slice(None) if turn is None else slice(turn % parts, None, parts)


class Labels:
    """Names over vehicles, estimates and landmarks."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """Add them."""
        self._stage, self._said = stage, -np.inf
        self._marks = [vehicle_mark(i) for i in range(stage.vehicles)]
        self._above = stage.bodies()[0] * [0.0, 0.0, 1.0] + [0.0, 0.0, 0.005 * stage.side]

        def label(name: str, text: str, **look: Any) -> Any:
            return scene.add_label(f"{ROOT}/names/{name}", text, anchor="bottom-center", depth_test=False, **look)

        small = {"font_screen_scale": 0.85}
        self._cars = [label(mark, mark) for mark in self._marks]
        self._estimates = [label(f"estimates/{mark}", f"{mark} estimated", **small) for mark in self._marks]
        self._landmarks = {
            i: label(f"landmarks/{i}", stage.short_name(i), **small)
            for i, landmark in enumerate(stage.scenario.landmarks)
            if landmark.group is None and stage.landmarks <= _MOST_NAMES
        }

    def place(self, frame: Frame, time: float, look: Look, turn: int | None = None) -> None:
        """Move the names; with a `turn` the names of some vehicles, as in `Picture.show`."""
        stage, side, shown = self._stage, self._stage.side, look.names
        if turn is None or not 0.0 <= time - self._said < _OFTEN - 1e-9:
            self._said = time
            for i, label in enumerate(self._cars if shown else ()):
                label.text = self._text(frame, i)
        mine = in_turn(turn, stage.vehicles)
        above = self._above + 1.1 * pin_height(stage, look) * np.array([0.0, 0.0, 1.0])
        places, estimates = frame.position + above, frame.position_estimate + above
        places[:, 2] += _RAISED * side * levels(places[:, :2], _CLOSE * side)
        inside = np.all((estimates[:, :2] > stage.low) & (estimates[:, :2] < stage.high), axis=-1)
        named = inside & (frame.position_error > _APART * side)  # estimates away from their vehicles
        for i in range(stage.vehicles)[mine]:
            _put(self._cars[i], places[i], shown)
            _put(self._estimates[i], estimates[i], shown and bool(named[i]))
        targets = stage.targets(frame) + np.array([0.0, 0.0, 0.015 * side])
        for i, label in self._landmarks.items():
            _put(label, targets[i], shown)

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


def _put(label: Any, place: np.ndarray, shown: bool) -> None:
    """Put a label to a place (3,), NaN: nowhere."""
    update(label, bool(shown and not np.isnan(place[0])), position=tuple(place.round(3).tolist()))


FIELD_OF_VIEW = 0.72
"""Vertical angle of the first camera, rad."""
_VIEW_RAYS = 4  # every so many of a field of view are drawn


class Picture:
    """Draws frames of one stage into viser's scene."""

    def __init__(self, scene: Any, stage: Stage, source: Origin, look: Look) -> None:
        """Draw the static part, and add the moving parts."""
        self.stage, self.look = stage, look
        self._scene = scene
        self._colours = np.array([rgb(vehicle_colour(i)) for i in range(stage.vehicles)])
        self.ground = Ground(scene, stage)
        self.actors = Actors(scene, stage, source, self.ground, self._colours)
        self._labels = Labels(scene, stage)
        self._pulses = MessageBeads(scene, stage, self.ground, self._colours)
        self._trails = Trails()
        self._lines = {
            name: Segments(scene, f"{ROOT}/{name}", thickness, self.ground.step)
            for name, thickness in (("sight", 2.0), ("errors", 1.5), ("ways", 2.0), ("trails", 3.0), ("levels", 2.0))
        }
        self._views: list[Any] = []
        self._drawn_ways: tuple[bytes, ...] = ()

    def show(self, frame: Frame, turn: int | None = None) -> None:
        """Show a frame.

        Args:
            frame: to show.
            turn: number of the frame where another frame follows at once: then some names and fields of view wait
                for that frame, see `in_turn`.
        """
        time, look, side = float(frame.tick) / self.stage.scenario.rates.camera, self.look, self.stage.side
        self.actors.place(frame, look)
        self._labels.place(frame, time, look, turn)
        self._pulses.place(frame, time, look.messages)
        trail = self._trails.lines(frame, time, self._colours, self.ground.z + 1e-3 * side)
        self._lines["trails"].show(trail if look.trails else NOTHING)
        sight = sight_lines(self.stage, frame, self._colours, look) if look.sight else NOTHING
        self._lines["sight"].show(sight)
        errors = dashes(frame.position, frame.position_estimate, _DASHES, 0.6)
        self._lines["errors"].show((errors, np.tile(self._colours, (_DASHES, 1))) if look.estimates else NOTHING)
        circles = level_lines(frame, self._colours, look, _LARGEST * side, self.ground.z + 2e-3 * side)
        self._lines["levels"].show(circles)
        ways = (frame.goal.tobytes(), frame.route_count.tobytes(), frame.route_drawn.tobytes(), frame.route.tobytes())
        if ways != self._drawn_ways:
            self._drawn_ways = ways
            self._lines["ways"].show(way_lines(self.stage, frame, self._colours, self.ground.z))
        self._show_views(frame, turn)

    def _show_views(self, frame: Frame, turn: int | None) -> None:
        mine = in_turn(turn if self._views else None, self.stage.vehicles)
        views = self.stage.fields_of_view(frame, _VIEW_RAYS, mine) if self.look.views else None
        if views is None:
            for view in self._views:
                view.visible = False
            return
        views[..., 2] = (self.ground.z + 2e-4 * self.stage.side * np.arange(1, self.stage.vehicles + 1))[mine, None]
        corners = fine(views, self.ground.step)
        if not self._views:
            n = np.arange(1, corners.shape[1] - 1)
            faces = np.stack([np.zeros_like(n), n + 1, n], axis=-1)
            flat: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False, "side": "double", "opacity": 0.16}
            self._views = [
                self._scene.add_mesh_simple(f"{ROOT}/views/{i}", corner, faces, color=colour, **flat)
                for i, (corner, colour) in enumerate(zip(corners, self._colours, strict=True))
            ]
        there = np.isfinite(corners).all(axis=(1, 2)).tolist()
        for view, corner, shown in zip(self._views[mine], corners, there, strict=True):
            update(view, shown, vertices=corner)


def first_camera(stage: Stage, aspect: float = 1.6) -> tuple[np.ndarray, np.ndarray]:
    """Return the position and the target of the first camera, (3,) each; from the south, the whole square in sight."""
    direction = np.array([-0.12, -0.72, 0.85])
    half = np.tan(FIELD_OF_VIEW / 2) * min(1.0, aspect)
    distance = 0.52 * stage.side / half
    return stage.middle + distance * direction / np.linalg.norm(direction), stage.middle


def first_look(three_sigma: np.ndarray, stage: Stage, source: Origin) -> Look:
    """Return the look with a magnification of 1, 10 or 100 at which ellipsoids of semi-axes (N,), m, can be seen.

    Those of a gain matrix are not magnified.
    """
    good = three_sigma[np.isfinite(three_sigma)]
    middle = float(np.median(good)) if len(good) and source.honest else stage.side
    factor = next((factor for factor in (1.0, 10.0) if factor * middle > 0.01 * stage.side), 100.0)
    return Look(magnification=factor)
