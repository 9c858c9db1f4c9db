"""A scene in the browser, frame after frame; live and in pages alike."""

from typing import Any

import numpy as np

from coopenv.viz.scene import Frame, Source, Stage
from coopenv.viz.web import lines
from coopenv.viz.web.actors import Actors, fine
from coopenv.viz.web.ground import ROOT, Ground, Look, in_turn, vehicle_colours
from coopenv.viz.web.lines import Labels, Pulses
from coopenv.viz.web.sent import Sent

FIELD_OF_VIEW = 0.72
"""Vertical angle of the first camera, rad."""
_VIEW_RAYS = 4  # every so many of a field of view are drawn


class Picture:
    """Draws frames of one stage into viser's scene."""

    def __init__(self, scene: Any, stage: Stage, source: Source, look: Look) -> None:
        """Draw what stands still, and add what moves."""
        self.stage, self.look = stage, look
        self._scene, self._colours = scene, vehicle_colours(stage.vehicles)
        self.ground = Ground(scene, stage)
        self.actors = Actors(scene, stage, source, self.ground, self._colours)
        self._labels = Labels(scene, stage)
        self._pulses = Pulses(scene, stage, self._colours)
        self._trails = lines.Trails()
        self._sight = lines.Segments(scene, f"{ROOT}/sight", 2.0)
        self._errors = lines.Segments(scene, f"{ROOT}/errors", 1.5)
        self._ways = lines.Segments(scene, f"{ROOT}/ways", 2.0)
        self._trail = lines.Segments(scene, f"{ROOT}/trails", 3.0)
        self._views: list[Sent] = []
        self._drawn_trail: lines.Coloured | None = None
        self._trails_shown = True
        self._drawn_ways: tuple[bytes, ...] = ()
        self._step = 2.0 ** np.floor(np.log2(stage.side * 1e-4))

    def show(self, frame: Frame, turn: int | None = None) -> None:
        """Show a frame.

        Args:
            frame: what is shown.
            turn: its number where another one follows at once: then a part of the names and fields of view waits
                for it, as `in_turn` says.
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
        sight = lines.sight_lines(self.stage, frame, self._colours, look) if look.sight else none
        self._show(self._sight, sight)
        self._show(self._errors, lines.error_lines(frame, self._colours) if look.estimates else none)
        ways = (frame.goal.tobytes(), frame.route_count.tobytes(), frame.route_drawn.tobytes(), frame.route.tobytes())
        if ways != self._drawn_ways:
            self._drawn_ways = ways
            self._show(self._ways, lines.way_lines(self.stage, frame, self._colours, self.ground.z))
        self._show_views(frame, turn)

    def _show(self, node: lines.Segments, what: lines.Coloured) -> None:
        node.show(fine(what[0], self._step), what[1])

    def _show_views(self, frame: Frame, turn: int | None) -> None:
        mine = in_turn(turn if self._views else None, self.stage.vehicles)
        views = self.stage.fields_of_view(frame, _VIEW_RAYS, mine) if self.look.views else None
        if views is None:
            for view in self._views:
                view.tell(visible=False)
            return
        views[..., 2] = (self.ground.z + 2e-4 * self.stage.side * np.arange(1, self.stage.vehicles + 1))[mine, None]
        corners = fine(views, self._step)
        if not self._views:
            self._add_views(corners)
        there = np.isfinite(corners).all(axis=(1, 2)).tolist()
        for i, view in enumerate(self._views[mine]):
            view.tell(visible=there[i])
            if there[i]:
                view.tell(vertices=corners[i])

    def _add_views(self, corners: np.ndarray) -> None:
        n = np.arange(1, corners.shape[1] - 1)
        faces = np.stack([np.zeros_like(n), n + 1, n], axis=-1)
        flat: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False, "side": "double", "opacity": 0.16}
        for i, colour in enumerate(self._colours.tolist()):
            mesh = self._scene.add_mesh_simple(f"{ROOT}/views/{i}", corners[i], faces, color=tuple(colour), **flat)
            self._views.append(Sent(mesh))


def first_camera(stage: Stage, aspect: float = 1.6) -> tuple[np.ndarray, np.ndarray]:
    """Return where the first camera is and what it looks at, (3,) each; from the south, the whole square in sight."""
    middle = np.array([*(stage.low + stage.high) / 2, 0.0])
    direction = np.array([-0.12, -0.72, 0.85])
    half = np.tan(FIELD_OF_VIEW / 2) * min(1.0, aspect)
    distance = 0.52 * stage.side / half
    return middle + distance * direction / np.linalg.norm(direction), middle


def useful_magnification(sigma: np.ndarray, side: float) -> float:
    """Return by how much ellipsoids are to be magnified, 1, 10 or 100, that one of semi-axes (N,) can be seen."""
    good = sigma[np.isfinite(sigma)]
    middle = float(np.median(good)) if len(good) else side
    return next((factor for factor in (1.0, 10.0) if factor * middle > 0.01 * side), 100.0)
