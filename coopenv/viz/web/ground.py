"""What stands still: floor, grid, roads and buildings."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.viz.scene import Stage
from coopenv.viz.topview_geometry import road_corners
from coopenv.viz.topview_ground import ASPHALT, GROUND, ROOF
from coopenv.viz.web import shapes
from coopenv.viz.web.look import linear, rgb

ROOT = "/world"
"""The node that everything hangs on; moving it moves the world."""
SOLID, FADED = 0.8, 0.15
"""Opacity of buildings, and of those that hide what is looked at."""
_GRID = "#DEDBD1"


def height_of(stage: Stage) -> float:
    """Return the height of the floor, m: below the vehicles as they start, and no higher than the map's own."""
    size, center = stage.bodies
    starts = [v.initial_pose.position[2] for v in stage.scenario.vehicles if v.initial_pose and v.initial_pose.position]
    lowest = min(starts, default=stage.origin[2]) - stage.origin[2]
    return float(lowest + np.min(center[:, 2] - size[:, 2] / 2))


def spacing_of(side: float) -> float:
    """Return the spacing of the grid, m: 1, 2 or 5 times a power of ten, a tenth of the side or a little less."""
    power = 10.0 ** np.floor(np.log10(side / 10))
    return float(power * max(factor for factor in (1, 2, 5) if factor * power <= side / 10 + 1e-9))


def _light(scene: Any, side: float) -> None:
    """Light the scene evenly, so that colours are those of the figures."""
    scene.configure_environment_map(None)
    scene.configure_default_lights(False, False)
    scene.add_light_ambient("/light/everywhere", intensity=3.0)
    scene.add_light_directional("/light/sun", intensity=0.9, position=(-0.5 * side, -0.9 * side, 1.6 * side))


class Ground:
    """Floor, roads and buildings."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """Draw them; `scene` is viser's."""
        self._stage, self.z = stage, height_of(stage)
        self.spacing = spacing_of(stage.side)
        self.root = scene.add_frame(ROOT, show_axes=False)
        """viser's handle of the node that everything hangs on."""
        _light(scene, stage.side)
        self._floor(scene)
        self._roads(scene)
        self.buildings = [self._building(scene, i) for i in range(len(stage.scenario.obstacles))]

    def fade(self, hidden: set[int]) -> None:
        """Let the buildings of these indices be seen through, the others not."""
        for i, building in enumerate(self.buildings):
            building.opacity = FADED if i in hidden else SOLID

    def _floor(self, scene: Any) -> None:
        side, spacing = self._stage.side, self.spacing
        middle = (self._stage.low + self._stage.high) / 2
        even = np.round(middle / spacing) * spacing
        flat: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        corners = middle + 0.75 * side * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        floor = shapes.quad(corners, self.z - 0.004 * side)
        scene.add_mesh_simple(f"{ROOT}/floor", *floor, color=rgb(GROUND), **flat)
        count = int(np.ceil(0.7 * side / spacing))
        at, reach = spacing * np.arange(-count, count + 1), spacing * count
        lines = [np.array([(x, -reach, 0.0), (x, reach, 0.0)]) for x in at]
        lines += [line[:, [1, 0, 2]] for line in lines]
        place = (*even, self.z - 0.003 * side)
        look = {"thickness": 1.0, "thickness_units": "screen", "position": place}
        scene.add_line_segments(f"{ROOT}/grid", np.array(lines), linear(np.array(rgb(_GRID))), **look)
        edge = (float(middle[0]), float(self._stage.low[1] + 0.02 * side), self.z)
        unit = f"grid {spacing:g} m" if spacing >= 1 else f"grid {100 * spacing:g} cm"
        scene.add_label(f"{ROOT}/scale", unit, position=edge, font_screen_scale=0.85, anchor="top-center")

    def _roads(self, scene: Any) -> None:
        side, origin = self._stage.side, self._stage.origin[:2]
        for i, road in enumerate(self._stage.scenario.roads):
            z = self.z - side * (2e-3 - 1e-4 * (i % 8))
            mesh = shapes.quad(road_corners(road.start, road.end, road.width) - origin, z)
            scene.add_mesh_simple(
                f"{ROOT}/roads/{i}", *mesh, color=rgb(ASPHALT), cast_shadow=False, receive_shadow=False
            )
        dashes = [dash for road in self._stage.scenario.roads if road.marked for dash in self._dashes(road)]
        if dashes:
            points = np.array(dashes)
            scene.add_line_segments(f"{ROOT}/marks", points, (255, 255, 255), thickness=2.0, thickness_units="screen")

    def _dashes(self, road: Any) -> list[np.ndarray]:
        start, end = (np.array([*p, 0.0]) - [*self._stage.origin[:2], 0.0] for p in (road.start, road.end))
        count = max(1, int(np.linalg.norm(end - start) / (0.04 * self._stage.side)))
        share = np.arange(count)[:, None] / count
        first = start + share * (end - start)
        dashes = np.stack([first, first + 0.55 * (end - start) / count], axis=1)
        dashes[..., 2] = self.z - 5e-4 * self._stage.side
        return list(dashes)

    def _building(self, scene: Any, index: int) -> Any:
        box = self._stage.buildings[index]
        quaternion = Rotation.from_matrix(box.rotation).as_quat(scalar_first=True)
        return scene.add_box(
            f"{ROOT}/buildings/{index}",
            dimensions=tuple(box.size),
            color=rgb(ROOF),
            opacity=SOLID,
            position=tuple(box.center),
            wxyz=tuple(quaternion),
            cast_shadow=False,
        )
