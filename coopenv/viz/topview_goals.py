"""Goals and routes in the top view, where a reset has drawn them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba_array
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from coopenv.scenario import Scenario
from coopenv.viz.scene.frame import Frame
from coopenv.viz.style import INK, SMALL, vehicle_colour
from coopenv.viz.topview_ground import DOTTED, vehicle_mark
from coopenv.viz.topview_layers import Layers

_CORNERS = 48  # of the polygon that stands for a circle
_ANGLE = np.linspace(0.0, 2 * np.pi, _CORNERS, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=-1)
_GAP = 3  # px between goals and their name
_MOST_NAMES = 3  # that stand for goals which touch one another; of the others there is the number


class Goals:
    """The goals of all vehicles, and the routes of those that have drawn one."""

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
        halo = [withStroke(linewidth=2.2, foreground="white")]
        look: dict[str, Any] = {"fontsize": SMALL, "va": "center", "clip_on": True, "color": INK, "path_effects": halo}
        self._names: list[Text] = [layers.keep(axes.text(0, 0, "", **look)) for _ in self._there]

    def place(self, frame: Frame) -> None:
        """Move them to where they are now."""
        center = frame.goal[self._there, :2]
        shapes = center[:, None] + self._radius[:, None, None] * _CIRCLE
        self._discs.set_verts(list(shapes))
        self._rims.set_verts(list(shapes))
        groups = touching(center, self._radius)
        for name, members in zip(self._names, groups + [[]] * (len(self._names) - len(groups)), strict=True):
            name.set_text(self._text(members))
            if members:
                self._put(name, center[members], self._radius[members])
        drawn = [i for i in self._there if frame.route_drawn[i] >= 0]
        self._routes.set_segments([frame.route[i, : int(frame.route_count[i]), :2] for i in drawn])
        self._routes.set_color([vehicle_colour(i) for i in drawn])

    def _text(self, members: list[int]) -> str:
        """Return the name of goals that touch one another."""
        named = len(members) if len(members) <= _MOST_NAMES else _MOST_NAMES - 1
        marks = ", ".join(vehicle_mark(self._there[k]) for k in members[:named])
        return marks + (f" +{len(members) - named}" if len(members) > named else "")

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
