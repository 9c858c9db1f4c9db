"""Root mean squares over seeds, and their standard errors to first order (delta method)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array


class Measured(NamedTuple):
    """A figure and its standard error over the seeds; NaN where there is one seed."""

    value: float
    error: float


UNKNOWN = Measured(float("nan"), float("nan"))


def mean_root(squares: Array) -> Measured:
    """Return the mean over vehicles of the root of the mean over seeds.

    Args:
        squares: (S, N) mean squares of S seeds and N vehicles; vehicles of one seed may depend on one another.
    """
    value, each = _linearised(squares)
    return Measured(value, standard_error(each))


def ratio(squares: Array, reference: Array) -> Measured:
    """Return `mean_root(squares)` over `mean_root(reference)`, seed against seed.

    Args:
        squares: (S, N).
        reference: (S, N) of the same seeds, whose error partly cancels.
    """
    (above, each_above), (below, each_below) = _linearised(squares), _linearised(reference)
    if not below > 0.0:
        return UNKNOWN
    value = above / below
    return Measured(value, value * standard_error(each_above / above - each_below / below) if above else 0.0)


def standard_error(values: Array) -> float:
    """Return the standard error of the mean of (S,) independent values, NaN of a single one."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def _linearised(squares: Array) -> tuple[float, Array]:
    """Return the mean root, and (S,) each seed's share in it: r = sqrt(m), dr = dm / (2 r)."""
    roots = np.sqrt(squares.mean(axis=0))
    return float(roots.mean()), (squares / np.where(roots > 0, 2.0 * roots, 1.0)).mean(axis=1)
