"""The static part of the scene in the browser: floor, grid, roads and buildings; looks, legend and meshes."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from coopenv.viz.drawing import linear_light
from coopenv.viz.scene import Source, Stage
from coopenv.viz.style import BLUE, DARK_BLUE, GREY, INK, vehicle_colour
from coopenv.viz.topview_geometry import road_corners
from coopenv.viz.topview_ground import ASPHALT, GROUND, ROOF, TRAFFIC

_AT_ONCE = 4  # names and fields of view in a frame while it plays


@dataclass
class Look:
    """Choices of whoever looks, and measures that follow from the scene's size."""

    magnification: float = 1.0
    """Of the ellipsoids."""
    ellipsoids: bool = True
    estimates: bool = True
    sight: bool = True
    """Lines of sight."""
    only: int | None = None
    """Index of the only vehicle with lines of sight; None: all vehicles have them."""
    views: bool = True
    """Fields of view."""
    messages: bool = True
    trails: bool = True
    names: bool = True


def in_turn(turn: int | None, count: int) -> slice:
    """Return which of so many names, or fields of view, are sent in a turn: half, at most four; None: all of them."""
    parts = max(2, -(-count // _AT_ONCE))
    return slice(None) if turn is None else slice(turn % parts, None, parts)


def rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour of Matplotlib as three whole numbers up to 255."""
    r, g, b = (round(255 * part) for part in to_rgb(colour))
    return r, g, b


def linear(colours: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) as viser wants those of many things at once: linear in light, uint8."""
    return np.asarray(np.round(255.0 * linear_light(np.asarray(colours, float) / 255.0)), np.uint8)


def vehicle_colours(count: int) -> np.ndarray:
    """Return (N, 3) uint8, the colour of each vehicle."""
    return np.array([rgb(vehicle_colour(i)) for i in range(count)], np.uint8).reshape(-1, 3)


_ROW = "display:flex;gap:8px;align-items:center;line-height:1.45"
GAIN = "P is a gain matrix of this observer, not a covariance: its ellipsoids are not bounds of the error."


def ellipsoid_words(source: Source, magnification: float) -> str:
    """Return the legend of an ellipsoid."""
    times = f", {magnification:g} times as large" if magnification != 1.0 else ""
    return f"3σ of the estimate{times}" if source.honest else f"observer's P{times} (gain, no covariance)"


def marks(stage: Stage, source: Source, magnification: float) -> list[tuple[str, str]]:
    """Return drawings and words of the marks that can occur."""
    s = stage.scenario
    sensed = s.topology.mode == "sensed"
    entries = [
        (True, _block(BLUE, 1.0), "vehicle, true"),
        (True, _block(BLUE, 0.3), "its estimate; a dashed line joins both"),
        (True, _disc(BLUE, 0.25), ellipsoid_words(source, magnification)),
        (stage.sees_a_part, _block(BLUE, 0.15), "field of view"),
        (True, _line(BLUE), "sees (colour of the observing vehicle)"),
        (sensed and bool(s.obstacles), _line(GREY), "hidden by a building, where the line ends"),
        (sensed, _line(INK), "hidden by a body, where the line ends"),
        (any(camera.miss_probability > 0 for camera in s.cameras), _line(BLUE, "2 4"), "in view, but missed"),
        (stage.landmarks > 0, _disc(DARK_BLUE, 1.0), "landmark"),
        (stage.vehicles > 1, _disc(BLUE, 1.0, 3), "V2X message on its way"),
        (any(vehicle.goal_radius > 0 for vehicle in s.vehicles), _ring(BLUE), "its goal, at the end of its route"),
        (s.highway is not None, _block(TRAFFIC, 1.0), "other traffic"),
    ]
    return [(drawing, words) for occurs, drawing, words in entries if occurs]


def legend_html(stage: Stage, source: Source, magnification: float) -> str:
    """Return the legend as HTML."""
    rows = "".join(
        f'<div style="{_ROW}"><span style="flex:none">{drawing}</span><span>{escape(words)}</span></div>'
        for drawing, words in marks(stage, source, magnification)
    )
    note = f'<div style="margin-top:6px;color:#8A3B00"><b>{escape(GAIN)}</b></div>' if not source.honest else ""
    return rows + note


def swatch(colour: str) -> str:
    """Return a small square in a colour, beside which text stands in ink: many colours are too pale for text."""
    look = f"width:9px;height:9px;background:{colour};border:1px solid {INK}"
    return f'<span style="display:inline-block;{look}"></span>'


def _svg(content: str) -> str:
    return f'<svg width="22" height="12" viewBox="0 0 22 12" style="vertical-align:middle">{content}</svg>'


def _block(colour: str, opacity: float) -> str:
    look = f'fill="{colour}" fill-opacity="{opacity:g}" stroke="{colour}"'
    return _svg(f'<rect x="2" y="2" width="18" height="8" {look}/>')


def _disc(colour: str, opacity: float, radius: int = 5) -> str:
    return _svg(f'<circle cx="11" cy="6" r="{radius}" fill="{colour}" fill-opacity="{opacity:g}" stroke="{colour}"/>')


def _ring(colour: str) -> str:
    return _svg(f'<circle cx="11" cy="6" r="5" fill="none" stroke="{colour}" stroke-width="2"/>')


def _line(colour: str, dashes: str = "") -> str:
    return _svg(f'<path d="M1 6H21" stroke="{colour}" stroke-width="2" stroke-dasharray="{dashes or "none"}"/>')


Mesh = tuple[np.ndarray, np.ndarray]

_SIDES = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7), (3, 2, 1, 0))
_FACES = np.array([t for a, b, c, d in _SIDES for t in ((a, b, c), (a, c, d))], np.uint32)


def _prism(low: tuple[float, ...], high: tuple[float, ...], bottom: float, top: float) -> Mesh:
    """Return a body between two rectangles (x from, x to, half width) at two heights."""
    rings = []
    for (rear, front, half), z in ((low, bottom), (high, top)):
        rings += [(rear, -half, z), (front, -half, z), (front, half, z), (rear, half, z)]
    return np.array(rings, np.float32), _FACES


def _joined(*parts: Mesh) -> Mesh:
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = [faces + np.uint32(offset) for (_, faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def box() -> Mesh:
    """Return a cube of edge 1 about the origin."""
    return _prism((-0.5, 0.5, 0.5), (-0.5, 0.5, 0.5), -0.5, 0.5)


def car() -> Mesh:
    """Return a car in the cube of edge 1, which looks along x: a hull, and a cabin nearer to the rear."""
    hull = _prism((-0.5, 0.5, 0.5), (-0.48, 0.44, 0.46), -0.5, 0.05)
    return _joined(hull, _prism((-0.42, 0.2, 0.42), (-0.34, 0.04, 0.33), 0.05, 0.5))


def arrow() -> Mesh:
    """Return an arrow head on the bonnet of that car and on its roof, which shows where the front is."""
    bonnet = [(0.24, -0.3, 0.07), (0.46, 0.0, 0.07), (0.24, 0.3, 0.07)]
    roof = [(-0.3, -0.22, 0.52), (0.02, 0.0, 0.52), (-0.3, 0.22, 0.52)]
    return np.array([*bonnet, *roof], np.float32), np.array([(0, 1, 2), (3, 4, 5)], np.uint32)


def sphere(rings: int = 10) -> Mesh:
    """Return a sphere of radius 1."""
    polar, around = np.linspace(0.0, np.pi, rings + 1), np.linspace(0.0, 2 * np.pi, 2 * rings, endpoint=False)
    theta, phi = np.meshgrid(polar, around, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    n = len(around)
    i, j = np.meshgrid(np.arange(rings) * n, np.arange(n), indexing="ij")
    a, b = i + j, i + (j + 1) % n
    faces = np.stack([np.stack([a, a + n, b], -1), np.stack([b, a + n, b + n], -1)], -2).reshape(-1, 3)
    return points.reshape(-1, 3).astype(np.float32), faces.astype(np.uint32)


def pole(sides: int = 8) -> Mesh:
    """Return a pole of radius 1 from z = 0 to 1."""
    angle = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=-1)
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = np.concatenate([np.stack([k, n, k + sides], -1), np.stack([n, n + sides, k + sides], -1)])
    return np.concatenate([ring, ring + np.array([0.0, 0.0, 1.0])]).astype(np.float32), faces.astype(np.uint32)


def quad(corners: np.ndarray, z: float) -> Mesh:
    """Return a flat quadrilateral of corners (4, 2), which follow one another, at a height; it is seen from above."""
    points = np.column_stack([corners, np.full(4, z)])
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    if first[0] * second[1] - first[1] * second[0] < 0:
        points = points[::-1]
    return points.astype(np.float32), np.array([(0, 1, 2), (0, 2, 3)], np.uint32)


def circle(radius: float, points: int = 32) -> np.ndarray:
    """Return a circle as segments (K, 2, 3) about the origin."""
    angle = np.linspace(0.0, 2 * np.pi, points + 1)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(points + 1)], axis=-1)
    return np.stack([ring[:-1], ring[1:]], axis=1)


ROOT = "/world"
"""The node that everything hangs on; moving it moves the world."""
SOLID, FADED = 0.8, 0.15
"""Opacity of buildings, and of buildings in front of the picked vehicle."""
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
        """Make the buildings of these indices transparent, and all other ones solid."""
        for i, building in enumerate(self.buildings):
            building.opacity = FADED if i in hidden else SOLID

    def _floor(self, scene: Any) -> None:
        side, spacing = self._stage.side, self.spacing
        middle = (self._stage.low + self._stage.high) / 2
        even = np.round(middle / spacing) * spacing
        flat: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        corners = middle + 0.75 * side * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        floor = quad(corners, self.z - 0.004 * side)
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
            mesh = quad(road_corners(road.start, road.end, road.width) - origin, z)
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
