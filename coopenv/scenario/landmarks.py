"""Groups of landmarks that are drawn anew, all of them, in every world and at every reset."""

import math
from collections.abc import Mapping
from typing import Any, Self

from pydantic import Field, model_validator

from coopenv.scenario.base import Number, Part, PositiveVector2, Probability, Vector2


class Area(Part):
    """A rectangle whose sides are parallel to the axes."""

    center: Vector2
    """In the coordinates of this file, m."""
    half: PositiveVector2
    """Half of its sides along x and y, m."""


class Line(Part):
    """A straight line."""

    start: Vector2
    end: Vector2
    """In the coordinates of this file, m."""


class LandmarkGroup(Part):
    """Landmarks NAME_1, NAME_2, ..., each drawn uniformly over areas, or along lines, and over heights."""

    name: str = Field(min_length=1, max_length=56, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    count: int = Field(ge=1, le=1000)
    boxes: tuple[Area, ...] = Field(default=(), max_length=1000)
    lines: tuple[Line, ...] = Field(default=(), max_length=1000)
    height: tuple[Number, Number]
    """Lowest and highest z, m."""
    presence: Probability = 1.0
    """Chance that a landmark of the group is there, drawn for each."""

    @model_validator(mode="after")
    def _is_somewhere(self) -> Self:
        if bool(self.boxes) == bool(self.lines):
            raise ValueError("give boxes or lines, one of them")
        if self.height[0] > self.height[1]:
            raise ValueError(f"height: the lowest is {self.height[0]:g} m, the highest {self.height[1]:g} m")
        for i, line in enumerate(self.lines):
            if line.start == line.end:
                raise ValueError(f"lines.{i}: has no length")
        return self

    @property
    def parallelograms(self) -> list[tuple[Vector2, Vector2, Vector2]]:
        """Corner and two edges of each area, m; the second edge of a line is zero."""
        boxes = [
            ((b.center[0] - b.half[0], b.center[1] - b.half[1]), (2 * b.half[0], 0.0), (0.0, 2 * b.half[1]))
            for b in self.boxes
        ]
        lines = [(li.start, (li.end[0] - li.start[0], li.end[1] - li.start[1]), (0.0, 0.0)) for li in self.lines]
        return [*boxes, *lines]

    @property
    def weights(self) -> list[float]:
        """How large each area is, or how long each line, m^2 or m."""
        boxes = [4.0 * b.half[0] * b.half[1] for b in self.boxes]
        return [*boxes, *(math.dist(line.start, line.end) for line in self.lines)]


def with_groups(raw: Any) -> Any:
    """Return the plain data of a scenario with an entry of `landmarks` for each that its groups draw.

    What is not as it should be is left for the schema to complain about.
    """
    groups = raw.get("landmark_groups") if isinstance(raw, Mapping) else None
    landmarks = raw.get("landmarks", []) if isinstance(raw, Mapping) else None
    if not isinstance(groups, list) or not isinstance(landmarks, list):
        return raw
    there = {mark.get("name") for mark in landmarks if isinstance(mark, Mapping) and "group" in mark}
    added = []
    for group in groups:
        try:
            made = LandmarkGroup.model_validate(group)
        except ValueError:
            return raw
        x, y = made.parallelograms[0][0]
        for k in range(made.count):
            name = f"{made.name}_{k + 1}"
            if name not in there:
                added.append(
                    {"name": name, "position": [x, y, made.height[0]], "group": made.name, "presence": made.presence}
                )
    return {**raw, "landmarks": [*landmarks, *added]}
