"""Meshes and colours that the 3-D views share, and nodes of them in the browser's scene.

Meshes are cars, landmarks, ellipsoids, and what lies flat on the ground. Nodes are copies, lines, and the ground:
floor, grid, roads and buildings.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.viz.stage import CORNERS, Stage, roads
from coopenv.viz.style import linear_light, rgb

SKY, HORIZON, GRASS, GRID = "#6FA8DC", "#DCEBF7", "#8DAA74", "#9CB785"
ASPHALT, MARKS, WALL, DARK = "#54585D", "#F2F2F2", "#D8C9AE", "#1B2026"
DOT = 0.008
"""Radius of a landmark as a share of the scene's side."""
FAR = 2.0
"""Scene's sides from its middle: estimates farther away are drawn there."""
SUN = np.array([-0.45, -0.6, 0.85])
"""Direction to the sun, map."""
Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and triangles (F, 3)."""

_SIDES = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7), (3, 2, 1, 0))
_FACES = np.array([t for a, b, c, d in _SIDES for t in ((a, b, c), (a, c, d))], np.uint32)
_WAIST, _ROOF = 0.06, 0.42  # heights at which the windows of a car begin and end


def _joined(*meshes: Mesh) -> Mesh:
    first = np.cumsum([0, *(len(points) for points, _ in meshes)])
    faces = [faces + np.uint32(start) for (_, faces), start in zip(meshes, first, strict=False)]
    return np.concatenate([points for points, _ in meshes]), np.concatenate(faces)


def _prism(low: tuple[float, ...], high: tuple[float, ...], bottom: float, top: float) -> Mesh:
    """Return a body between two rectangles (x from, x to, half width) at two heights."""
    rings = []
    for (rear, front, half), z in ((low, bottom), (high, top)):
        rings += [(rear, -half, z), (front, -half, z), (front, half, z), (rear, half, z)]
    return np.array(rings, np.float32), _FACES


def box() -> Mesh:
    """Return a cube of edge 1 about the origin."""
    return _prism((-0.5, 0.5, 0.5), (-0.5, 0.5, 0.5), -0.5, 0.5)


def car() -> Mesh:
    """Return the painted parts of a car in the cube of edge 1, which looks along x: hull, bonnet and roof."""
    hull = _prism((-0.5, 0.5, 0.48), (-0.5, 0.49, 0.5), -0.36, -0.08)
    bonnet = _prism((-0.5, 0.49, 0.5), (-0.48, 0.42, 0.45), -0.08, _WAIST)
    roof = _prism((-0.345, 0.055, 0.35), (-0.33, 0.03, 0.33), _ROOF, 0.5)
    return _joined(hull, bonnet, roof)


def car_trim() -> Mesh:
    """Return the dark parts of that car: windows and wheels."""
    windows = _prism((-0.44, 0.2, 0.44), (-0.345, 0.055, 0.35), _WAIST, _ROOF)
    points, faces = _turned(np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.5, 0.5, -0.5, -0.5]), 12)
    wheel = points[:, [0, 2, 1]] * [0.085, 0.12, 0.22], faces[:, ::-1]
    wheels = [(wheel[0] + [x, y, -0.28], wheel[1]) for x in (-0.3, 0.31) for y in (-0.43, 0.43)]
    return _joined(windows, *((points.astype(np.float32), faces) for points, faces in wheels))


def arrow() -> Mesh:
    """Return an arrow head on the bonnet of that car and on its roof, which shows where the front is."""
    bonnet = [(0.24, -0.3, 0.1), (0.44, 0.0, 0.1), (0.24, 0.3, 0.1)]
    roof = [(-0.3, -0.22, 0.52), (0.02, 0.0, 0.52), (-0.3, 0.22, 0.52)]
    return np.array([*bonnet, *roof], np.float32), np.array([(0, 1, 2), (3, 4, 5)], np.uint32)


def _turned(radius: np.ndarray, height: np.ndarray, sides: int) -> Mesh:
    """Return the surface of a profile, from above to below, that is turned about z."""
    angle = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    rings = [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, np.ones(sides))]
    i, j = np.meshgrid(np.arange(len(radius) - 1) * sides, np.arange(sides), indexing="ij")
    a, b = i + j, i + (j + 1) % sides
    faces = np.stack([a, a + sides, b, b, a + sides, b + sides], -1).reshape(-1, 3)
    return np.stack(rings, axis=-1).reshape(-1, 3).astype(np.float32), faces.astype(np.uint32)


def sphere(rings: int = 10) -> Mesh:
    """Return a sphere of radius 1."""
    polar = np.linspace(0.0, np.pi, rings + 1)
    return _turned(np.sin(polar), np.cos(polar), 2 * rings)


def pole() -> Mesh:
    """Return a pole of radius 1 from z = 0 to 1."""
    return _turned(np.ones(2), np.array([1.0, 0.0]), 8)


def pin() -> Mesh:
    """Return a pin of height 1 that points at the origin from above."""
    return _turned(np.array([0.0, 0.3, 0.3, 0.0]), np.array([1.0, 1.0, 0.7, 0.0]), 8)


def quad(corners: np.ndarray, z: float) -> Mesh:
    """Return a flat quadrilateral of corners (4, 2), which follow one another, at a height; it is seen from above."""
    (x, y), (u, v) = corners[1] - corners[0], corners[2] - corners[0]
    points = np.column_stack([corners, np.full(4, z)])[:: 1 if x * v - y * u >= 0 else -1]
    return points.astype(np.float32), np.array([(0, 1, 2), (0, 2, 3)], np.uint32)


@dataclass
class Look:
    """Choices of the viewer, and measures that follow from the scene's size."""

    magnification: float = 1.0
    """Magnification of the ellipsoids."""
    ellipsoids: bool = True
    estimates: bool = True
    sight: bool = True
    """Lines of sight."""
    alone: bool = False
    """Show lines of sight of the picked vehicle alone."""
    views: bool = True
    """Fields of view."""
    messages: bool = True
    levels: bool = False
    """Circles of the protection levels of all vehicles; that of the picked one is drawn in any case."""
    trails: bool = True
    names: bool = True
    picked: int | None = None
    """Index of the vehicle that is looked at."""
    follow: bool = True
    """Let the view follow it."""


def linear(colours: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) as viser wants those of many things at once: linear in light, uint8."""
    return np.asarray(np.round(255.0 * linear_light(np.asarray(colours, float) / 255.0)), np.uint8)


class Copies(NamedTuple):
    """Poses of copies; absent copies have size zero."""

    wxyzs: np.ndarray  # (N, 4)
    positions: np.ndarray  # (N, 3) m
    scales: np.ndarray  # (N, 3) m


def placed(rotation: np.ndarray | None, position: np.ndarray, scale: np.ndarray, turn: float = 2.0**-11) -> Copies:
    """Return copies at positions (N, 3) with rotations (N, 3, 3; None: upright) and sizes (N, 3), NaN: not there.

    Quaternions are given in steps of `turn`.
    """
    R = np.broadcast_to(np.eye(3), (len(position), 3, 3)) if rotation is None else rotation
    there = np.isfinite(np.concatenate([position, scale, R.reshape(-1, 9)], axis=1)).all(axis=1)[:, None]
    whole = Rotation.from_matrix(np.where(there[..., None], R, np.eye(3)))
    turned = fine(whole.as_quat(canonical=True, scalar_first=True), turn)
    return Copies(turned, *(np.where(there, part, 0.0).astype(np.float32) for part in (position, scale)))


def fine(values: np.ndarray, step: float) -> np.ndarray:
    """Return values in whole steps, in single precision: a file of them can be packed better."""
    return (np.round(np.asarray(values, float) / step) * step).astype(np.float32)


class MeshNode:
    """A node with copies of a mesh."""

    def __init__(self, scene: Any, name: str, mesh: Mesh, colours: np.ndarray, **look: Any) -> None:
        """Add them, one per colour (N, 3), to be placed; of none there is no node."""
        count = len(colours)
        self.handle: Any = None
        """viser's."""
        if count:
            self.handle = scene.add_batched_meshes_simple(
                name,
                *mesh,
                np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                np.zeros((count, 3)),
                batched_scales=np.zeros((count, 3)),
                batched_colors=linear(colours),
                lod="off",
                **{**_FLAT, **look},
            )

    def put(self, places: Copies, shown: bool = True) -> None:
        """Put the copies to their places."""
        if self.handle is not None:
            wxyzs, positions, scales = places
            update(self.handle, shown, batched_wxyzs=wxyzs, batched_positions=positions, batched_scales=scales)


def update(handle: Any, shown: bool, **properties: Any) -> None:
    """Show or hide one of viser's nodes; the properties of a hidden one are not sent."""
    handle.visible = shown
    for name, value in properties.items() if shown else ():
        setattr(handle, name, value)


Coloured = tuple[np.ndarray, np.ndarray]
"""Segments (K, 2, 3), m, and their colours (K, 3) uint8."""
NOTHING: Coloured = np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8)
_GROWTH = 32  # segments by which the arrays grow


def add_lines(scene: Any, name: str, points: np.ndarray, colours: Any, thickness: float, **look: Any) -> Any:
    """Add a node of line segments (K, 2, 3), as many pixels thick, and return its handle."""
    return scene.add_line_segments(name, points, colours, thickness=thickness, thickness_units="screen", **look)


class Segments:
    """A node of line segments whose number changes.

    Arrays have room for more, so that they seldom change their shape; unused segments lie in a single point.
    """

    def __init__(self, scene: Any, name: str, thickness: float, step: float) -> None:
        """Begin with none; the thickness is in pixels, and ends are given in steps, m."""
        self._scene, self._name, self._step = scene, name, step
        self._handle: Any = None
        self._thickness, self._room = thickness, 0

    def show(self, segments: Coloured) -> None:
        """Show segments; segments with NaN are left out."""
        points, colours = fine(segments[0], self._step), segments[1]
        good = np.isfinite(points).all(axis=(1, 2))
        points, colours = points[good], colours[good]
        if self._handle is not None:
            self._handle.visible = len(points) > 0
        if not len(points):
            return
        grown = len(points) > self._room
        if grown:
            self._room = -(-len(points) // _GROWTH) * _GROWTH
        rest = self._room - len(points)
        whole = np.concatenate([points, np.broadcast_to(points[0, 0], (rest, 2, 3))])
        shade = linear(np.concatenate([colours, np.tile(colours[:1], (rest, 1))]))[:, None].repeat(2, axis=1)
        if grown:
            self._handle = add_lines(self._scene, self._name, whole, shade, self._thickness)
        else:
            self._handle.points, self._handle.colors = whole, shade


def dashes(start: np.ndarray, end: np.ndarray, count: int, share: float) -> np.ndarray:
    """Return lines from start to end (K, 3) in so many dashes, which take up a share of them: (count K, 2, 3)."""
    at = np.arange(count)[:, None, None] / count
    return np.stack([start + at * (end - start), start + (at + share / count) * (end - start)], axis=2).reshape(
        -1, 2, 3
    )


ROOT = "/world"
"""The node that everything hangs on; moving it moves the world."""
_SOLID, _FADED = 1.0, 0.15  # opacity of buildings, and of those in front of the picked vehicle
_FLAT = {"cast_shadow": False, "receive_shadow": False}


def spacing_of(side: float) -> float:
    """Return the spacing of the grid, m: 1, 2 or 5 times a power of ten, a tenth of the side or a little less."""
    power = 10.0 ** np.floor(np.log10(side / 10))
    return float(power * max(factor for factor in (1, 2, 5) if factor * power <= side / 10 + 1e-9))


class Ground:
    """Floor, roads and buildings."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """Draw them; `scene` is viser's."""
        self._scene, self._stage = scene, stage
        self.z = stage.floor
        self.step = 2.0 ** np.floor(np.log2(stage.side * 1e-4))
        """Resolution of positions, m."""
        self.root = scene.add_frame(ROOT, show_axes=False)
        """viser's handle of the node that everything hangs on."""
        scene.configure_environment_map(None)
        scene.configure_default_lights(False, False)
        scene.add_light_ambient("/light/everywhere", intensity=1.7)
        sun = tuple(stage.side * SUN)
        scene.add_light_directional("/light/sun", intensity=2.2, position=sun, cast_shadow=True)
        shade = np.linspace(rgb(SKY), rgb(HORIZON), 64)
        scene.set_background_image(shade[:, None].repeat(2, axis=1).astype(np.uint8), "png")
        self._add_floor()
        self._add_roads()
        self._buildings = [
            scene.add_box(
                f"{ROOT}/buildings/{i}",
                dimensions=tuple(building.size),
                color=rgb(WALL),
                opacity=_SOLID,
                position=tuple(building.center),
                wxyz=tuple(Rotation.from_matrix(building.rotation).as_quat(scalar_first=True)),
            )
            for i, building in enumerate(stage.buildings)
        ]

    def fade(self, hiding: np.ndarray) -> None:
        """Make the buildings transparent that hide something, (B,) bool, and all other ones solid."""
        for building, hides in zip(self._buildings, hiding, strict=True):
            building.opacity = _FADED if hides else _SOLID

    def _add_floor(self) -> None:
        side, spacing = self._stage.side, spacing_of(self._stage.side)
        middle = self._stage.middle[:2]
        corners = middle + 8.0 * side * CORNERS
        floor = quad(corners, self.z - 0.004 * side)
        self._scene.add_mesh_simple(f"{ROOT}/floor", *floor, color=rgb(GRASS), cast_shadow=False)
        count = int(np.ceil(0.7 * side / spacing))
        at, reach = spacing * np.arange(-count, count + 1), spacing * count
        lines = [np.array([(x, -reach, 0.0), (x, reach, 0.0)]) for x in at]
        lines += [line[:, [1, 0, 2]] for line in lines]
        place = (*(np.round(middle / spacing) * spacing), self.z - 0.003 * side)
        add_lines(self._scene, f"{ROOT}/grid", np.array(lines), rgb(GRID), 1.0, position=place)
        edge = (float(middle[0]), float(self._stage.low[1] + 0.02 * side), self.z)
        unit = f"grid {spacing:g} m" if spacing >= 1 else f"grid {100 * spacing:g} cm"
        self._scene.add_label(f"{ROOT}/scale", unit, position=edge, font_screen_scale=0.85, anchor="top-center")

    def _add_roads(self) -> None:
        side, origin, scenario = self._stage.side, self._stage.origin[:2], self._stage.scenario
        marks = [np.zeros((0, 2, 3))]
        for i, (road, corners) in enumerate(zip(scenario.roads, roads(scenario), strict=True)):
            mesh = quad(corners, self.z - side * (2e-3 - 1e-4 * (i % 8)))
            self._scene.add_mesh_simple(f"{ROOT}/roads/{i}", *mesh, color=rgb(ASPHALT), cast_shadow=False)
            if road.marked:
                start, end = (np.array([[*(p - origin), self.z - 5e-4 * side]]) for p in (road.start, road.end))
                count = max(1, int(np.linalg.norm(end - start) / (0.04 * side)))
                marks.append(dashes(start, end, count, 0.55))
        points = np.concatenate(marks)
        if len(points):
            add_lines(self._scene, f"{ROOT}/marks", points, (255, 255, 255), 2.0)
