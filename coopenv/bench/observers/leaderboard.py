"""What a comparison of observers holds: the samples, and what comes of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from coopenv.bench.observers.rows import Row, Total, rows_of, totals_of
from coopenv.bench.observers.samples import Sample, Window
from coopenv.bench.observers.windows import WindowRow, window_rows

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
