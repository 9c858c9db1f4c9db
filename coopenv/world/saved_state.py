"""What the fields of a saved state may hold: a rule each, checked before anything of the state is restored.

The rules stand in tables beside the structs that declare the fields.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.format import LARGEST
from coopenv.estimation.validity import are_covariances, are_rotations, are_unit_vectors, everywhere

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Fields = Mapping[str, Array]

TOLERANCE = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-6}
"""How far rotations and directions may be off in a precision."""
LEAST_EIGENVALUE = {np.dtype(np.float32): -1e-4, np.dtype(np.float64): -1e-9}
"""Least eigenvalue of the correlations of a covariance, after rounding in a precision."""


class Rule(NamedTuple):
    """What every element of a field must be."""

    must_be: str  # in words, for errors
    holds: Callable[[Array, Fields, Any], Mask]
    """Returns which elements are so, from the field's values, all fields, and the model."""
    axes: int = 0  # how many of the last axes make up an element: 1 for vectors, 2 for matrices
    used: str = ""
    """Field that says which elements count, by flags or by how many along the last axis; empty: all do. The others must
    be finite."""
    of_truth: bool = False  # whether it is truth, which a recording may not know: NaN


def whole(low: int, high: int | str) -> Rule:
    """Return the rule of numbers within bounds; `high` may be a field of one number per world, or one of the model."""

    def holds(values: Array, fields: Fields, model: Any) -> Mask:
        most: Any = high
        if isinstance(high, str):
            of_world = fields[high].reshape(-1, *(1,) * (values.ndim - 1)) if high in fields else None
            most = getattr(model, high) if of_world is None else of_world
        return np.asarray((values >= low) & (values <= most))

    return Rule(f"in {low} .. {high}", holds)


def numbers(largest: float = LARGEST) -> Rule:
    """Return the rule of finite numbers of at most a size."""
    return Rule(f"finite and at most {largest:g}", lambda values, fields, model: np.abs(values) <= largest)


def _odometry_samples(values: Array, fields: Fields, model: Any) -> Mask:
    """Return which counts are those of the tick, at which sample m has been taken if m / rate is not later."""
    due = fields["tick"][:, None] * (model.camera_period * model.odometry_rate)
    return np.asarray((values >= 0) & (np.abs(values - due) <= 2.0))


ANYTHING = Rule("anything", lambda values, fields, model: np.ones(values.shape, dtype=bool))
FLAG = whole(0, 1)
NUMBER = numbers()
TICK = whole(-1, "tick")  # a tick of the past or the present one; -1: never
ODOMETRY_SAMPLES = Rule("as many as at this tick", _odometry_samples)
ROUTE_COUNT = Rule(
    "0, or how many points a route may have",
    lambda values, fields, model: (values == 0) | ((values >= 2) & (values <= model.routes.points)),
)
ROUTE_DRAWN = Rule(
    "a number of a route, or -1",
    lambda values, fields, model: (values >= -1) & (values < max(model.routes.count.size, 1)),
)
DIRECTION = Rule(
    "a unit vector, or zero",
    lambda values, fields, model: are_unit_vectors(values, TOLERANCE[values.dtype]) | everywhere(values == 0.0, -1),
    axes=1,
)
ROTATION = Rule("a rotation", lambda values, fields, model: are_rotations(values, TOLERANCE[values.dtype]), axes=2)
COVARIANCE = Rule(
    "a covariance", lambda values, fields, model: are_covariances(values, LEAST_EIGENVALUE[values.dtype]), axes=2
)


def checked_state(
    values: Mapping[str, Any], arrays: Mapping[str, Any], rules: Mapping[str, Rule], model: Any, knows_truth: bool
) -> dict[str, Array]:
    """Return copies of what a state holds, in the types of the Warp arrays, by name, that it is to be written to.

    Numbers of a field without a rule have to be finite; `knows_truth` says whether the truth is always there.

    Raises:
        CoopenvError: a field is missing, has another shape or type, or an element is not what its rule says.
    """
    fields = {name: _converted(name, values, target.numpy()) for name, target in arrays.items()}
    begun = has_begun(fields["start_rotation"])
    for name, array in fields.items():
        rule = rules.get(name) or (NUMBER if array.dtype.kind == "f" else ANYTHING)
        valid = _valid(array, rule, fields, model, knows_truth)
        valid[~begun] |= _elements(array[~begun] == 0, rule)
        if not valid.all():
            index = tuple(np.argwhere(~valid)[0].tolist())
            value = f": {shown(array[index].item())}" if array[index].ndim == 0 else ""
            raise CoopenvError(f"state: field '{name}' at {index}{value} is not {rule.must_be}")
    return fields


def has_begun(start_rotation: Array) -> Mask:
    """Return (W,) which worlds have been reset; before that, their fields are zero."""
    return np.asarray(start_rotation.reshape(len(start_rotation), -1).any(axis=1))


def _converted(name: str, values: Mapping[str, Any], like: Array) -> Array:
    if name not in values:
        raise CoopenvError(f"state: field '{name}' is missing")
    try:
        given = np.asarray(values[name])
        if given.shape != like.shape:
            raise CoopenvError(f"state: field '{name}' has shape {given.shape}, expected {like.shape}")
        kinds = "fiu" if like.dtype.kind == "f" else "iub"
        with np.errstate(over="ignore"):
            array = np.array(given, dtype=like.dtype, order="C") if given.dtype.kind in kinds else None
    except (TypeError, ValueError, OverflowError) as error:
        raise CoopenvError(f"state: field '{name}': {error}") from None
    if array is None or (like.dtype.kind != "f" and (array != given).any()):
        raise CoopenvError(f"state: field '{name}' of {given.dtype} does not fit into {like.dtype}")
    return array


def _elements(mask: Array, rule: Rule) -> Mask:
    """Return of which elements a mask of numbers holds."""
    return everywhere(mask, *range(-rule.axes, 0))


def _valid(array: Array, rule: Rule, fields: Fields, model: Any, knows_truth: bool) -> Mask:
    """Return which elements of a field are what they must be, do not count, or are not known."""
    valid = rule.holds(array, fields, model)
    if rule.used:
        used = fields[rule.used]
        if used.ndim < valid.ndim:
            used = np.arange(valid.shape[-1]) < used[..., None]
        valid = valid | ((used == 0) & _elements(np.isfinite(array), rule))
    if rule.of_truth and not knows_truth:
        valid = valid | _elements(np.isnan(array), rule)
    return valid
