"""Figures of one observer over all vehicles, each with its standard error over the seeds, and what they come to."""

from typing import Any

import numpy as np

from coopenv.base.format import with_error
from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.rows import Measured, Row, standard_error
from coopenv.bench.observers.samples import Sample
from coopenv.estimation.arrays import Array
from coopenv.estimation.metrics import SETTLED


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
