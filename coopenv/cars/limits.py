"""Limits of commands, and the polygon of a geofence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from coopenv.base.errors import CoopenvError


@dataclass(frozen=True)
class Limits:
    """Bounds of commands."""

    speed: float  # m/s
    steering: float  # rad
    acceleration: float  # m/s^2
    steering_rate: float  # rad/s
    reverse: bool = False

    def permit(self, speed: float, steering: float) -> bool:
        """Return whether a command is finite and inside."""
        return (
            math.isfinite(speed)
            and math.isfinite(steering)
            and (-self.speed if self.reverse else 0.0) - SLACK <= speed <= self.speed + SLACK
            and abs(steering) <= self.steering + SLACK
        )

    def approach(self, before: tuple[float, float], wanted: tuple[float, float], dt: float) -> tuple[float, float]:
        """Return the (speed, steering) nearest to what is wanted that can follow after dt s; both in m/s and rad."""
        speed = _toward(before[0], wanted[0], self.acceleration * dt)
        return speed, _toward(before[1], wanted[1], self.steering_rate * dt)

    def check(self, hardest: "Limits") -> "Limits":
        """Return these limits. Raises CoopenvError: one of them is not above zero, or beyond the hardest."""
        for field in fields(self):
            value, most = getattr(self, field.name), getattr(hardest, field.name)
            if field.name != "reverse" and not 0.0 < value <= most:
                raise CoopenvError(f"limit of {field.name.replace('_', ' ')}: must be above 0, at most {most:.4g}")
        return self


def _toward(before: float, wanted: float, most: float) -> float:
    """Return `wanted`, or what is `most` from `before` towards it."""
    return wanted if abs(wanted - before) <= most else before + math.copysign(most, wanted - before)


SLACK = 1e-6
"""m/s or rad, of numbers that have gone through single precision."""

USUAL = Limits(speed=0.5, steering=math.pi / 6, acceleration=1.0, steering_rate=2.0)
"""Default limits."""


Point = tuple[float, float]


def inside(corners: Sequence[Point], x: float, y: float) -> bool:
    """Return whether a point is in a polygon: a ray to the right of it crosses the edges an odd number of times."""
    crossings = 0
    for (x1, y1), (x2, y2) in _edges(corners):
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) * (x2 - x1) / (y2 - y1):
            crossings += 1
    return crossings % 2 == 1


def is_simple(corners: Sequence[Point]) -> bool:
    """Return whether corners enclose something, and no two edges of theirs cross or touch beyond a common corner."""
    edges = _edges(corners)
    if len(edges) < 3 or any(a == b for a, b in edges):
        return False
    for i, (a, b) in enumerate(edges):
        for j in range(i + 1, len(edges)):
            c, d = edges[j]
            if j == i + 1 and not _turns_back(a, b, d):
                continue
            if i == 0 and j == len(edges) - 1 and not _turns_back(c, d, b):
                continue
            if _meet(a, b, c, d):
                return False
    return True


def _edges(corners: Sequence[Point]) -> list[tuple[Point, Point]]:
    return list(zip(corners, [*corners[1:], *corners[:1]], strict=True))


def _side(a: Point, b: Point, c: Point) -> float:
    """Return on which side of the line a-b a point is: positive on the left, 0 on it."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _turns_back(a: Point, b: Point, c: Point) -> bool:
    """Return whether the way a-b-c goes back over itself."""
    along = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1])
    return _side(a, b, c) == 0.0 and along < 0.0


def _meet(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Return whether two segments have a point in common."""
    if _side(a, b, c) * _side(a, b, d) < 0.0 and _side(c, d, a) * _side(c, d, b) < 0.0:
        return True
    return any(_on(p, q, r) for p, q, r in ((a, b, c), (a, b, d), (c, d, a), (c, d, b)))


def _on(a: Point, b: Point, c: Point) -> bool:
    """Return whether c is on the segment a-b."""
    if _side(a, b, c) != 0.0:
        return False
    return min(a[0], b[0]) <= c[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= c[1] <= max(a[1], b[1])
