"""The table of the arrays of ticks, recordings and logs: axes, rule and kind of each, and checks by it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from coopenv.base.sections import LARGEST
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import (
    Fields,
    Mask,
    Rule,
    are_covariances,
    are_numbers,
    are_rotations,
    are_unit_vectors,
    everywhere,
)
from coopenv.observers.contract import Setup

if TYPE_CHECKING:
    from coopenv.scenario import Scenario

LARGEST_PAN = 3.15  # rad, after rounding
LEAST_EIGENVALUE = 1e-12  # least eigenvalue of the correlations of an initial estimate


def _vector(values: Array, others: Fields, model: Any) -> Mask:
    return everywhere(are_numbers(values), -1)


def _direction(values: Array, others: Fields, model: Any) -> Mask:
    return are_unit_vectors(values) | (everywhere(np.isnan(values), -1) & ~others["visible"])


def _sent(values: Array, others: Fields, model: Any) -> Mask:
    return np.asarray((values == -1) | ((values >= 0) & (values <= others["now"]) & (values % others["period"] == 0)))


VECTOR = Rule(f"finite numbers of at most {LARGEST:g}", _vector, axes=1)
ROTATION = Rule("a rotation", lambda values, others, model: are_rotations(values), axes=2)
DIRECTION = Rule("unit vectors, or NaN where nothing is visible", _direction, axes=1)
COVARIANCE = Rule(
    "a symmetric and positive definite matrix",
    lambda values, others, model: are_covariances(values, LEAST_EIGENVALUE),
    axes=2,
)
SENT = Rule("-1, nor a multiple of the message period up to now", _sent)
FLAG = Rule("true or false", lambda values, others, model: np.ones(values.shape, dtype=bool))
AGE = Rule("a number of at least 0", lambda values, others, model: values >= 0.0)
ANGLE = Rule(f"within {LARGEST_PAN} rad", lambda values, others, model: np.abs(values) <= LARGEST_PAN)


class ArraySpec(NamedTuple):
    """One array of a tick, of a recording and of its log."""

    axes: str  # K ticks (in a tick: none), N vehicles, T targets, L landmarks, or a length
    rule: Rule
    kind: str = "f"  # NumPy's
    recorded: bool = True  # False: only ticks have it
    optional: float | None = None  # the value of all entries of an absent array; None: the array is always there
    present: Callable[["Scenario | None"], bool] = lambda scenario: True  # whether a scenario's recordings have it

    @property
    def dtype(self) -> Any:
        """The NumPy type of its entries."""
        return {"f": np.float64, "i": np.int64, "b": np.bool_}[self.kind]

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Return the shape by the lengths of the axes; an axis without one is left out."""
        return tuple(int(axis) if axis.isdigit() else sizes[axis] for axis in self.axes if axis != "K" or axis in sizes)


ARRAYS = {
    "rotation": ArraySpec("KN33", ROTATION),
    "translation": ArraySpec("KN3", VECTOR),
    "velocity": ArraySpec("KN3", VECTOR),
    "angular_velocity": ArraySpec("KN3", VECTOR),
    "bearings": ArraySpec("KNT3", DIRECTION),
    "visible": ArraySpec("KNT", FLAG, "b"),
    "landmarks": ArraySpec("KL3", VECTOR),
    "inbox_tick": ArraySpec("KNN", SENT, "i"),
    "due": ArraySpec("K", FLAG, "b"),
    "pan": ArraySpec("KN", ANGLE, optional=0.0, present=lambda s: s is not None and s.action.pan is not None),
    "bearing_age": ArraySpec(
        "KN", AGE, optional=0.0, present=lambda s: s is not None and any(c.is_late for c in s.cameras)
    ),
    "truth.rotation": ArraySpec("KN33", ROTATION._replace(of_truth=True)),
    "truth.position": ArraySpec("KN3", VECTOR._replace(of_truth=True)),
    "odometry_age": ArraySpec("KN", AGE, recorded=False, optional=0.0),
    "missing": ArraySpec("KN", FLAG, "b", recorded=False, optional=False),
    "late": ArraySpec("KN", FLAG, "b", recorded=False, optional=False),
    "start_rotation": ArraySpec("N33", ROTATION),
    "start_position": ArraySpec("N3", VECTOR),
    "start_covariance": ArraySpec("N66", COVARIANCE),
}
"""Arrays by name; arrays of the truth are fields of `Truth`."""
KINDS_OF_TICKS = {"f": "fiu", "i": "iu", "b": "b"}


def recorded_names(scenario: "Scenario | None") -> list[str]:
    """Return the names of the arrays that a recording in a scenario has; None: of recorded robots."""
    return [name for name, spec in ARRAYS.items() if spec.recorded and spec.present(scenario)]


def sizes_of(setups: Sequence[Setup]) -> dict[str, int]:
    """Return the lengths of the axes N, T and L."""
    return {"N": len(setups), "T": len(setups[0].target_names), "L": setups[0].landmarks}


def misshapen(values: Mapping[str, Any], sizes: Mapping[str, int], kinds: Mapping[str, str]) -> Iterator[str]:
    """Yield the errors of arrays with a shape or type other than the table's."""
    for name, value in values.items():
        spec = ARRAYS[name]
        shape, kind = spec.shape(sizes), kinds[spec.kind]
        if not (isinstance(value, np.ndarray) and value.shape == shape and value.dtype.kind in kind):
            got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            yield f"{name}: expected an array of shape {shape} and kind {kind}, got {got}"


def invalid_rows(values: Mapping[str, Array], about: Mapping[str, Any], ticks: bool) -> Iterator[tuple[str, Mask, str]]:
    """Yield (name, which rows are valid, what the others are not); rows are those of ticks, if there are many, and N.

    Args:
        values: arrays by name.
        about: further inputs of rules: the tick `now` and the message period.
        ticks: True if arrays have the axis K.
    """
    for name, array in values.items():
        axes, rule = ARRAYS[name].axes, ARRAYS[name].rule
        valid = rule.valid(array, {**values, **about}, None, knows_truth=False)
        rows = (axes[0] == "K" and ticks) + ("N" in axes)
        unless = " or unknown (NaN)" if rule.of_truth else ""
        yield name, everywhere(valid, *range(rows, valid.ndim)), f"not {rule.must_be}{unless}"
