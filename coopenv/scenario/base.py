"""What every part of a scenario shares: frozen, typed, and strict about its keys."""

import math
from difflib import get_close_matches
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from coopenv.base.errors import shortened, shown, suggest
from coopenv.base.format import LARGEST


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


TOO_DEEP = "lists or tables stand too deep in one another"


def one_line(error: ValidationError, where: str, model: type[BaseModel]) -> str:
    """Return the most helpful of the problems in one line, which begins with `where`; `model` knows the valid keys."""
    details = error.errors(include_url=False)
    # A misspelt key often also leaves a required one missing: the misspelling is what helps.
    first = min(details, key=lambda d: d["type"] != "extra_forbidden")
    # Pydantic puts its own tags of unions into the location; keys of the file are identifiers or stand last.
    last = len(first["loc"]) - 1
    unknown = first["type"] == "extra_forbidden"
    keys = [
        part
        for i, part in enumerate(first["loc"])
        if isinstance(part, int) or part.isidentifier() or (unknown and i == last)
    ]
    field = ".".join(shortened(str(part)) for part in keys)
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    if unknown:
        valid = _valid_keys(first["loc"][:-1], model)
        hint = suggest(str(keys[-1]), valid) or f"; allowed: {', '.join(valid)}"
        return f"{where}: {field}: unknown key{hint}{more}"
    if first["type"] in ("union_tag_not_found", "union_tag_invalid"):
        return f"{where}: {field}.{_kind_message(first)}{more}"
    message = (
        first["msg"].removeprefix("Value error, ").replace("valid tuple", "list").replace("Tuple should", "List should")
    )
    if first["type"] == "missing" and isinstance(keys[-1], int):
        return f"{where}: {field.rpartition('.')[0]}: too few entries, number {keys[-1] + 1} is missing{more}"
    if first["type"] == "value_error":  # our own checks: their messages start with the field that they are about
        joint = "." if field and _starts_with_field(message) else ": "
        return f"{where}: {field}{joint if field else ''}{message}{more}"
    if first["type"] == "json_invalid":
        return f"{where}: {TOO_DEEP if 'recursion' in message else message}"
    got = first.get("input")
    given = f", got {shown(got)}" if isinstance(got, bool | int | float | str) else ""
    return f"{where}: {field}: {message}{given}{more}"


def _kind_message(detail: Any) -> str:
    """Say which kinds exist, for a table whose `kind` is missing, misspelt or unknown."""
    context, given = detail.get("ctx", {}), detail.get("input")
    if "expected_tags" not in context:
        near = get_close_matches("kind", [str(k) for k in given], n=1) if isinstance(given, dict) else []
        return f"{near[0]}: unknown key (did you mean 'kind'?)" if near else "kind: Field required"
    kinds = [tag.strip().strip("'") for tag in context["expected_tags"].split(",")]
    tag = shortened(str(context.get("tag", "")))
    return f"kind: unknown kind '{tag}'{suggest(tag, kinds)}; known: {', '.join(kinds)}"


def _starts_with_field(message: str) -> bool:
    head, colon, _ = message.partition(":")
    return bool(colon) and head.replace(".", "").isidentifier()


def _valid_keys(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """Return the keys allowed at a location of a validation error, by walking the model's annotations."""
    models: list[Any] = [model]
    for part in location:
        if isinstance(part, int):
            continue
        nested = [
            inner
            for model in models
            if isinstance(part, str) and part in model.model_fields
            for inner in _models_in(model.model_fields[part].annotation)
        ]
        tagged = [m for m in models if "kind" in m.model_fields and m.model_fields["kind"].default == part]
        models = nested or tagged or models
    return sorted({name for model in models for name in model.model_fields})


def _models_in(annotation: Any) -> list[Any]:
    if isinstance(annotation, type):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for inner in getattr(annotation, "__args__", ()) for model in _models_in(inner)]
