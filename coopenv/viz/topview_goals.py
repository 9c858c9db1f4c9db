"""Goals and routes in the top view, where a reset has drawn them."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba_array

from coopenv.scenario import Scenario
from coopenv.viz.scene.frame import Frame
from coopenv.viz.style import INK, SMALL, vehicle_colour
from coopenv.viz.topview_ground import DOTTED, vehicle_mark
from coopenv.viz.topview_layers import Layers

_CORNERS = 48  # of the polygon that stands for a circle
_ANGLE = np.linspace(0.0, 2 * np.pi, _CORNERS, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=-1)


class Goals:
    """The goals of all vehicles, and the routes of those that have drawn one."""

    def __init__(self, scenario: Scenario, axes: Axes, layers: Layers) -> None:
        """Add the artists."""
        self._radius = np.array([vehicle.goal_radius for vehicle in scenario.vehicles])
        self._there = [i for i, radius in enumerate(self._radius) if radius > 0]
        colours = [vehicle_colour(i) for i in self._there]
        self._rgba = to_rgba_array(colours)
        self._routes = layers.lines(linewidth=0.9, alpha=0.55)
        self._discs = layers.polygons(facecolor="white", edgecolor="none", alpha=0.6)
        self._rims = layers.polygons(facecolor="none", edgecolor=self._rgba, linestyle=DOTTED, linewidth=1.6)
        look: dict[str, Any] = {"fontsize": SMALL, "ha": "center", "va": "center", "clip_on": True}
        texts = [axes.text(0, 0, vehicle_mark(i), color=INK, **look) for i in self._there]
        self._names = [layers.keep(text) for text in texts]

    def place(self, frame: Frame) -> None:
        """Move them to where they are now."""
        center = frame.goal[self._there, :2]
        shapes = center[:, None] + self._radius[self._there, None, None] * _CIRCLE
        self._discs.set_verts(list(shapes))
        self._rims.set_verts(list(shapes))
        for i, (name, place) in enumerate(zip(self._names, center, strict=True)):
            apart = np.linalg.norm(center - place, axis=-1)
            same = np.flatnonzero(apart < self._radius[self._there] / 2).tolist()
            more = f" +{len(same) - 1}" if len(same) > 1 else ""  # goals at one place have one name
            name.set_text(vehicle_mark(self._there[i]) + more if i == same[0] else "")
            name.set_position(place.tolist())
        drawn = [i for i in self._there if frame.route_drawn[i] >= 0]
        self._routes.set_segments([frame.route[i, : int(frame.route_count[i]), :2] for i in drawn])
        self._routes.set_color([vehicle_colour(i) for i in drawn])
