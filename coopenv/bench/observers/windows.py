"""Stretches of a run, judged one by one: an observer that is good in the end may have been lost for half a minute.

Errors are held against the bound of the same stretch, so that a slow start counts where measurements allow a quick one.
Standard errors are over the seeds; those of root mean squares to first order (delta method), the bound taken as exact.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.bench.observers.rows import grouped, mean_root, standard_error
from coopenv.bench.observers.samples import Sample, Window
from coopenv.estimation.arrays import Array

EDGES = (5.0, 10.0, 20.0, 35.0)
"""s; starts of up to 10 deg and 1 m are found within the first of these windows by the best observers."""

MOST_EDGES = 20
EXPECTED = f"expected 2 to {MOST_EDGES} increasing times in s, such as 5,10,20,35, or none"


def checked_edges(given: Iterable[float] | str) -> tuple[float, ...]:
    """Return the edges of windows, s, from numbers or a text with commas between; none where there are to be none.

    Raises:
        CoopenvError: they are not increasing times.
    """
    words = [] if given in ("", "none") else given.split(",") if isinstance(given, str) else list(given)
    said = given if isinstance(given, str) else ",".join(map(str, words))
    try:
        edges = tuple(float(word) for word in words)
    except (TypeError, ValueError):
        raise CoopenvError(f"--windows {shown(said)}: {EXPECTED}") from None
    times = all(0.0 <= edge < math.inf for edge in edges) and all(b > a for a, b in pairwise(edges))
    if not times or len(edges) == 1 or len(edges) > MOST_EDGES:
        raise CoopenvError(f"--windows {shown(said)}: {EXPECTED}")
    return edges


@dataclass(frozen=True)
class WindowRow:
    """One observer, one vehicle, one variant, one stretch of time; NaN where there is no such figure."""

    environment: str
    variant: str
    observer: str
    vehicle: str
    window: str
    """For example `5-10 s`, or `steady`."""
    from_s: float
    to_s: float
    position_rmse_m: float
    position_rmse_se_m: float
    bound_ancestors_m: float
    ratio_to_bound_ancestors: float
    ratio_to_bound_ancestors_se: float
    anees: float
    anees_se: float


ERRORS = {
    "position_rmse_m": "position_rmse_se_m",
    "ratio_to_bound_ancestors": "ratio_to_bound_ancestors_se",
    "anees": "anees_se",
}
"""Column to that of its standard error."""


class Spread(NamedTuple):
    """What a figure comes to over all vehicles: the middle one, and the worst with its standard error and owner."""

    median: float
    worst: float
    error: float
    vehicle: str


def spread(rows: Sequence[WindowRow], column: str) -> Spread:
    """Return the median over vehicles of a column, and its worst: the largest, or of ANEES the farthest from 1."""
    values = np.array([getattr(row, column) for row in rows], float)
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return Spread(math.nan, math.nan, math.nan, "")
    off = np.abs(np.log(np.maximum(values[known], 1e-300))) if column == "anees" else values[known]
    worst = rows[int(known[np.argmax(off)])]
    error = getattr(worst, ERRORS[column])
    return Spread(float(np.median(values[known])), float(getattr(worst, column)), float(error), worst.vehicle)


def window_rows(environment: str, samples: Sequence[Sample]) -> list[WindowRow]:
    """Sum up samples over seeds, in the order of variants and observers in which they come."""
    return [
        _row(environment, own, i, w)
        for own in grouped(samples).values()
        for w in range(len(own[0].scene.windows))
        for i in range(len(own[0].scene.vehicles))
    ]


def _row(environment: str, own: Sequence[Sample], i: int, w: int) -> WindowRow:
    def over_seeds(name: str) -> Array:
        return np.array([sample.in_windows(name)[i, w] for sample in own], float)

    window: Window = own[0].scene.windows[w]
    position, anees = mean_root(over_seeds("window_mse")[:, None]), over_seeds("window_anees")
    bound = math.sqrt(np.mean([sample.scene.window_bound_mse[i, w] for sample in own]))
    figures: dict[str, Any] = {
        "position_rmse_m": position.value,
        "position_rmse_se_m": position.error,
        "bound_ancestors_m": bound,
        "ratio_to_bound_ancestors": position.value / bound if bound > 0.0 else math.nan,
        "ratio_to_bound_ancestors_se": position.error / bound if bound > 0.0 else math.nan,
        "anees": float(np.mean(anees)),
        "anees_se": standard_error(anees),
    }
    who = (environment, own[0].variant, own[0].observer, own[0].scene.vehicles[i])
    return WindowRow(*who, window.name, window.start, window.end, **figures)
