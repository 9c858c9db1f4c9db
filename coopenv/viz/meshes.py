"""Meshes and colours that the 3-D views share: cars, landmarks, ellipsoids, and what lies flat on the ground."""

import numpy as np

SKY, HORIZON, GRASS, GRID = "#6FA8DC", "#DCEBF7", "#8DAA74", "#9CB785"
ASPHALT, MARKS, WALL, DARK = "#54585D", "#F2F2F2", "#D8C9AE", "#1B2026"
DOT = 0.008
"""Of the scene's side, radius of a landmark."""
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
