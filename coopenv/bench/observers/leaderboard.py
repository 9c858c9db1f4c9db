"""What a comparison of observers holds: the samples, and what comes of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from coopenv.base.format import with_error
from coopenv.bench.observers.judge import Sample, Window
from coopenv.bench.observers.rows import (
    Measured,
    Row,
    Total,
    WindowRow,
    rows_of,
    standard_error,
    totals_of,
    window_rows,
)
from coopenv.estimation.metrics import SETTLED
from coopenv.estimation.poses import Array

BOUNDS = {"bound_m": "bound (joint)", "bound_ancestors_m": "bound (ancestors)", "bound_single_m": "bound (alone)"}
"""Column to its line in tables."""


@dataclass(frozen=True)
class Leaderboard:
    """How observers did on the same records, summed up over seeds."""

    environment: str
    """Name of the environment, dataset or log file."""
    observers: tuple[str, ...]
    variants: Mapping[str, str]
    """Those that were run, each with what it is."""
    seeds: tuple[int, ...]
    samples: Sequence[Sample] = field(repr=False)
    """One observer on one record each, by variant, observer, seed."""

    @cached_property
    def rows(self) -> list[Row]:
        """One per variant, observer and vehicle."""
        return rows_of(self.environment, self.samples)

    @cached_property
    def window_rows(self) -> list[WindowRow]:
        """One per variant, observer, window and vehicle; the last window is the steady state."""
        return window_rows(self.environment, self.samples)

    @cached_property
    def totals(self) -> dict[tuple[str, str], Total]:
        """Over all vehicles, by variant and observer."""
        return totals_of(self.samples)

    @cached_property
    def ranked(self) -> list[str]:
        """The observers by their error in the first variant, those that failed there last."""
        first = next(iter(self.variants))
        error = {name: self.totals[first, name].rmse.value for name in self.observers}
        return sorted(self.observers, key=lambda name: (error[name] != error[name], error[name]))

    @property
    def title(self) -> str:
        """What was compared, on one line."""
        first, last = self.seeds[0], self.seeds[-1]
        whole = len(self.seeds) > 1 and self.seeds == tuple(range(first, last + 1))
        seeds = f"{first} to {last}" if whole else ", ".join(map(str, self.seeds))
        return f"{self.environment}, seed{'s' if len(self.seeds) > 1 else ''} {seeds}"

    def rows_in(self, variant: str, observer: str) -> list[Row]:
        """Return the rows of one observer in one variant, a vehicle each."""
        return [row for row in self.rows if (row.variant, row.observer) == (variant, observer)]

    @property
    def windows(self) -> tuple[Window, ...]:
        """The stretches of the run that are judged one by one, the steady state last."""
        return self.samples[0].scene.windows

    def windows_in(self, variant: str, observer: str, window: Window) -> list[WindowRow]:
        """Return the rows of one observer in one variant and window, a vehicle each."""
        wanted = (variant, observer, window.name)
        return [row for row in self.window_rows if (row.variant, row.observer, row.window) == wanted]

    def bounds_in(self, variant: str) -> dict[str, list[float]]:
        """Return the bounds that are known of each vehicle in a variant, by column."""
        first = self.rows_in(variant, self.observers[0])
        found = {column: [float(getattr(row, column)) for row in first] for column in BOUNDS}
        return {column: values for column, values in found.items() if np.isfinite(values).all()}

    def samples_in(self, variant: str) -> dict[str, list[Sample]]:
        """Return the samples of one variant of every observer that did not fail, the best first."""
        own = {name: [s for s in self.samples if (s.variant, s.observer) == (variant, name)] for name in self.ranked}
        return {name: samples for name, samples in own.items() if not any(sample.failure for sample in samples)}


def quality(board: Leaderboard, variant: str, observer: str) -> dict[str, Any]:
    """Return shares in %, costs and NIS with standard errors, and the rows with the largest and smallest figures.

    Vehicles of one seed may depend on one another: errors are those of the means of each seed.
    """
    own = [s for s in board.samples if (s.variant, s.observer) == (variant, observer)]
    rows = board.rows_in(variant, observer)
    stated = sorted((row for row in rows if np.isfinite(row.anees)), key=lambda row: row.anees)
    dof = _each(own, "nis_dof").sum(axis=1)
    nis = _each(own, "nis").sum(axis=1) / np.where(dof > 0, dof, np.nan)
    return {
        "settled": _share(np.isfinite(_each(own, "settle_time"))),
        "diverged": _share(_each(own, "diverged")),
        "sent": _measured(np.array([s.bytes_per_s for s in own]).mean(axis=1)),
        "time": _measured(np.array([s.us_per_update for s in own]).mean(axis=1)),
        "nis": _measured(nis),
        "worst_ratio": max(rows, key=lambda row: row.ratio_to_bound_ancestors),
        "low_anees": stated[0] if stated else None,
        "high_anees": stated[-1] if stated else None,
        "worst_anees": max(stated, key=_dishonesty) if stated else None,
    }


def headline(board: Leaderboard) -> list[str]:
    """Return in a few sentences what the first variant says: who is best, by how much, and who settles."""
    first = next(iter(board.variants))
    names = [name for name in board.ranked if not any(row.failure for row in board.rows_in(first, name))]
    if not names:
        return ["Every observer failed."]
    best = quality(board, first, names[0])
    lines = [
        f"Best of {len(board.observers)} in {board.title} ({first}): {names[0]}, "
        f"mean position RMSE {_words(board.totals[first, names[0]].rmse)} m in the steady state"
    ]
    row = best["worst_ratio"]
    if np.isfinite(row.ratio_to_bound_ancestors):
        ratio = Measured(row.ratio_to_bound_ancestors, row.ratio_to_bound_ancestors_se)
        lines[0] += f", {_words(ratio)} times the Cramér-Rao bound at worst ({row.vehicle})"
    if len(names) > 1:
        lines[0] += f"; {names[1]} follows with {_words(board.totals[first, names[1]].rmse)} m"
    always = [name for name in names if quality(board, first, name)["settled"].value == 100.0]
    told = ", ".join(always) if always else "none"
    return [lines[0] + ".", f"Every vehicle settles below {SETTLED.text} in every seed with: {told}."]


def _words(measured: Measured) -> str:
    value, error = with_error(*measured)
    return f"{value} ± {error}" if error else value


def _dishonesty(row: Row) -> float:
    return float(abs(np.log(row.anees))) if row.anees > 0 else np.inf


def _each(samples: list[Sample], name: str) -> Array:
    """Return (S, N) a measure of every seed and vehicle."""
    return np.array([sample.measured(name) for sample in samples], float)


def _share(values: Array) -> Measured:
    return _measured(100.0 * np.asarray(values, float).mean(axis=1))


def _measured(each: Array) -> Measured:
    return Measured(float(each.mean()), standard_error(each))
