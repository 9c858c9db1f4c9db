"""Limits of commands, and the polygon of a geofence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Annotated

from pydantic import Field

from coopenv.base.errors import CoopenvError

Positive = Annotated[float, Field(gt=0.0, le=1e6)]
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Of settings of cars, narrower than those of an environment."""


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
            if field.name == "reverse":
                if value and not most:
                    raise CoopenvError("limit reverse: this make does not reverse")
            elif not 0.0 < value <= most:
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
    crossing = any(
        _side(a, b, c) * _side(a, b, d) < 0.0 and _side(c, d, a) * _side(c, d, b) < 0.0
        for (a, b), (c, d) in combinations(edges, 2)
    )
    touching = any(_between(a, c, b) for a, b in edges for c in corners if c not in (a, b))
    return 3 <= len(corners) == len(set(corners)) and not crossing and not touching


def _edges(corners: Sequence[Point]) -> list[tuple[Point, Point]]:
    return list(zip(corners, [*corners[1:], *corners[:1]], strict=True))


def _side(a: Point, b: Point, c: Point) -> float:
    """Return on which side of the line a-b a point is: positive on the left, 0 on it."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _between(a: Point, c: Point, b: Point) -> bool:
    """Return whether c is on the segment a-b."""
    return _side(a, b, c) == 0.0 and min(a, b) <= c <= max(a, b)
