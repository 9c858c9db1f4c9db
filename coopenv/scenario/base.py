"""Types of the quantities in a scenario file, and sections laid over one another."""

import math
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, Field

from coopenv.base.errors import shown
from coopenv.base.format import LARGEST
from coopenv.base.sections import Section

P = TypeVar("P", bound=Section)


def overlaid(base: P, part: P | None) -> P:
    """Return a section with what another one gives in place of its own entries; tables within are overlaid likewise."""
    if part is None:
        return base
    changes = {}
    for name in part.model_fields_set:
        own, given = getattr(base, name), getattr(part, name)
        changes[name] = overlaid(own, given) if isinstance(own, Section) and isinstance(given, Section) else given
    return base.model_copy(update=changes)


def _unit_quaternion(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.sqrt(sum(x * x for x in q))
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(f"a rotation needs a unit quaternion, this one has norm {norm:.4g}")
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def _points_somewhere(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if sum(x * x for x in direction) < 1e-12:
        raise ValueError("must not be zero")
    return direction


def rotation_of(yaw: float | None, quaternion_wxyz: Any) -> np.ndarray:
    """Return the rotation (3, 3) that a file gives as a quaternion or a yaw."""
    if quaternion_wxyz is None:
        w, x, y, z = math.cos((yaw or 0.0) / 2), 0.0, 0.0, math.sin((yaw or 0.0) / 2)
    else:
        w, x, y, z = quaternion_wxyz
        length = math.sqrt(x * x + y * y + z * z + w * w)
        w, x, y, z = w / length, x / length, y / length, z / length
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return np.array(
        [
            [xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww],
        ]
    )


def _readable(text: str) -> str:
    for line in text.splitlines():
        if not line.replace("\t", " ").isprintable():
            raise ValueError(f"control characters are not allowed, got {shown(line)}")
    return text


Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
Direction = Annotated[Vector3, AfterValidator(_points_somewhere)]
QuaternionWxyz = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_unit_quaternion)]
Positive = Annotated[float, Field(gt=0.0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Loss = Annotated[float, Field(ge=0.0, lt=1.0)]
Rate = Annotated[float, Field(ge=1e-3, le=1e5)]
PositiveVector2 = tuple[Positive, Positive]
PositiveVector3 = tuple[Positive, Positive, Positive]
NonNegativeVector3 = tuple[NonNegative, NonNegative, NonNegative]
Sample = Literal["sample"]
Word = Annotated[str, AfterValidator(_readable)]
Text = Annotated[str, Field(max_length=10_000), AfterValidator(_readable)]
"""Printed as it is, so that nothing in it may command a terminal."""
