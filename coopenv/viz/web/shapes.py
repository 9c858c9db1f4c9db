"""Meshes of unit size: vertices (V, 3) and faces (F, 3)."""

import numpy as np

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
