"""The Warp functions of a user's kind against its NumPy functions."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import UserCodeError, error_text
from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import MOST_ROWS, Kind
from coopenv.measurements.own import AGREEMENT, OwnKind

VECTOR, VALUE = wp.types.vector(3, wp.float64), wp.types.vector(MOST_ROWS, wp.float64)
MATRIX = wp.types.matrix((3, 3), wp.float64)


def check_in_warp(kind: Kind) -> None:
    """Compare the Warp functions of a kind with its class at a few random places.

    Raises:
        UserCodeError: one cannot be compiled, or returns something else; it names the function and the entry.
    """
    assert isinstance(kind, OwnKind) and kind.in_warp is not None
    pairs, given = kind.trials(), kind.in_warp
    places: list[Any] = [
        wp.array([getattr(pair[side], name) for pair in pairs], dtype=MATRIX if name == "rotation" else VECTOR)
        for side in range(2)
        for name in ("rotation", "position", "velocity")
    ]
    noise = np.linspace(-0.1, 0.1, kind.rows)
    predicted = [kind.predict(*pair) for pair in pairs]
    measured = [kind.sample(value, noise) for value in predicted]
    like = wp.zeros(len(pairs), dtype=VECTOR)
    calls: dict[str, tuple[list[Any], Sequence[Sequence[Array]]]] = {
        "predict": ([*places, wp.zeros(len(pairs), dtype=VALUE)], [predicted]),
        "sample": ([_six(predicted), _six([noise] * len(pairs)), like], [measured]),
        "residual": ([_six(measured), _six(predicted), like], [list(map(kind.residual, measured, predicted))]),
        "jacobian": (places, [*zip(*(kind.jacobian(*pair) for pair in pairs), strict=True)]),
    }
    for name, (arguments, expected) in calls.items():
        if (function := getattr(given, name)) is not None:
            _compare(f"sensor '{kind.reference}': in_warp: {name}", function, arguments, expected)


def _compare(where: str, function: Any, arguments: list[Any], expected: Sequence[Sequence[Array]]) -> None:
    """Compare what a Warp function returns for each place with arrays; it pads them with zeros."""
    try:
        found: Any = wp.map(function, *arguments)
    except Exception as error:  # of any user's code
        raise UserCodeError(f"{where}: {error_text(error)}") from error
    for array, right in zip(found if isinstance(found, list) else [found], expected, strict=True):
        for at, got, wanted in _different(array.numpy(), np.array(right)):
            raise UserCodeError(f"{where}: entry {at} is {got:.6g}, in NumPy {wanted:.6g}")


def _different(found: Array, right: Array) -> Iterator[tuple[list[int], float, float]]:
    """Yield index and both values of the entry that differs most, if it differs by more than `AGREEMENT`."""
    wanted = np.zeros_like(found)
    wanted[tuple(slice(size) for size in right.shape)] = right
    off = np.nan_to_num(np.abs(found - wanted), nan=np.inf)
    if off.max() > AGREEMENT * max(1.0, float(np.abs(right).max())):
        at = np.unravel_index(np.argmax(off), off.shape)
        yield [int(n) for n in at[1:]], float(found[at]), float(wanted[at])


def _six(values: Sequence[Array]) -> Any:
    """Return vectors as six numbers each."""
    return wp.array([np.pad(value, (0, MOST_ROWS - len(value))) for value in values], dtype=VALUE)
