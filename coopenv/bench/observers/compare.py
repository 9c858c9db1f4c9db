"""Observers compared on the same records: Monte Carlo over seeds and variants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from coopenv.bench.observers.executors import Engine, Local
from coopenv.bench.observers.judge import Sample, Task, judge
from coopenv.bench.observers.rows import Row, rows_of
from coopenv.bench.observers.sources import Source
from coopenv.observers.registry import find


@dataclass(frozen=True)
class Outcome:
    """The rows, and the samples behind them."""

    rows: list[Row]
    samples: list[Sample] = field(repr=False)
    """By variant, observer, seed."""


def compare(
    source: Source,
    observers: Sequence[str],
    seeds: int,
    variants: Sequence[str] | None = None,
    steady_from: float | None = None,
    engine: Engine | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Outcome:
    """Judge observers over seeds 0, 1, ...; the result does not depend on the engine.

    Args:
        source: of the records.
        observers: names.
        seeds: how many; a recorded source has one record only.
        variants: of the source; None: its usual ones.
        steady_from: s; None: the source's own.
        engine: where the work is done; None: this process.
        on_progress: called with the share that is done.

    Raises:
        CoopenvError: an unknown observer, a record that cannot be made, or a start of the steady state beyond it.
    """
    source.steady_from(steady_from)
    factories = {name: find(name) for name in observers}
    # One record serves all observers. Recorded robots are few records and long ones: their observers are shared out.
    groups = [factories] if source.seeded else [{name: factory} for name, factory in factories.items()]
    tasks = [
        Task(source, variant, seed, group, steady_from)
        for variant in variants or source.usual
        for seed in range(seeds if source.seeded else 1)
        for group in groups
    ]
    judged = (engine or Local(1)).map(judge, tasks, lambda done: on_progress(done / len(tasks)))
    found = [sample for samples in judged for sample in samples]
    samples = [
        sample
        for variant in variants or source.usual
        for name in factories
        for sample in found
        if (sample.variant, sample.observer) == (variant, name)
    ]
    return Outcome(rows_of(source.name, samples), samples)
