"""What every part of a scenario shares: frozen, typed, and strict about its keys."""

import math
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from coopenv.base.errors import shown


class Part(BaseModel):
    """A frozen section of a scenario file; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


P = TypeVar("P", bound=Part)


def overlaid(base: P, part: P | None) -> P:
    """Return a section with what another one gives in place of its own entries; tables within are overlaid likewise."""
    if part is None:
        return base
    changes = {}
    for name in part.model_fields_set:
        own, given = getattr(base, name), getattr(part, name)
        changes[name] = overlaid(own, given) if isinstance(own, Part) and isinstance(given, Part) else given
    return base.model_copy(update=changes)


def _unit_quaternion(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.sqrt(sum(x * x for x in q))
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(f"a rotation needs a unit quaternion, this one has norm {norm:.4g}")
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def _readable(text: str) -> str:
    for line in text.splitlines():
        if not line.replace("\t", " ").isprintable():
            raise ValueError(f"control characters are not allowed, got {shown(line)}")
    return text


LARGEST = 1e9
"""Largest magnitude of any quantity, in its own unit: products of four such numbers still fit into single precision."""

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
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
