"""The tables that `coopenv evaluate` prints."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.table import Table

from coopenv.base.format import NONE
from coopenv.bench.agents.contest import Evaluation
from coopenv.evaluation import Difference, Result
from coopenv.runs.table import number_table

COLUMNS = {
    "arrival_rate": ("arrived\n[%]", 100.0),
    "collision_rate": ("collided\n[%]", 100.0),
    "travel_time_s": ("travel\n[s]", 1.0),
    "e50_m": ("e50\n[cm]", 100.0),
    "e95_m": ("e95\n[cm]", 100.0),
    "orientation_e95_deg": ("e95\n[deg]", 1.0),
    "few_targets_share": ("few\n[%]", 100.0),
    "return": ("return\n", 1.0),
}
"""Metric, its heading, and the factor to the heading's unit."""
COMPARED = ("travel_time_s", "e50_m", "e95_m", "orientation_e95_deg")


def results_table(evaluation: Evaluation) -> Table:
    """Return one row per driver: figures, with their intervals below."""
    table = number_table(("agent",), [heading for heading, _ in COLUMNS.values()], gap=0)
    for name, results in evaluation.results.items():
        known = {result.metric: result for result in results}
        table.add_row(name, *(_cell(known[metric], factor) for metric, (_, factor) in COLUMNS.items()))
    return table


def differences_table(evaluation: Evaluation) -> Table:
    """Return one row per driver but the reference: relative differences, with their intervals below."""
    headings = [COLUMNS[metric][0].split("\n")[0] for metric in COMPARED]
    headings[-1] += " (deg)"
    table = number_table((f"against {evaluation.reference}",), [f"{heading}\n[%]" for heading in headings], gap=0)
    for name, differences in evaluation.differences.items():
        known = {difference.metric: difference for difference in differences}
        table.add_row(name, *(_change(known[metric]) for metric in COMPARED))
    return table


def shown(mean: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a figure and the ends of its interval with as many decimals as the first digit of its width needs."""
    width = high - low
    decimals = 1
    if np.isfinite(width) and width > 0.0:
        decimals = int(np.clip(-np.floor(np.log10(width)), 0, 2))
    first, second, third = (f"{v:z.{decimals}f}" if np.isfinite(v) else NONE for v in (mean, low, high))
    return first, second, third


def cell(result: Mapping[str, Any], factor: float) -> str:
    """Return a figure of a file, `mean` with `ci_low` and `ci_high`, with its interval in brackets."""
    values = [float("nan") if result[key] is None else factor * result[key] for key in ("mean", "ci_low", "ci_high")]
    mean, low, high = shown(*values)
    return NONE if mean == NONE else f"{mean} [{low}, {high}]"


def _cell(result: Result, factor: float) -> str:
    mean, low, high = shown(factor * result.mean, factor * result.ci_low, factor * result.ci_high)
    return mean if low == NONE else f"{mean}\n{low}..{high}"


def _change(difference: Difference) -> str:
    percent = [100 * v for v in (difference.relative, difference.relative_ci_low, difference.relative_ci_high)]
    mean, low, high = (text if text.startswith("-") else f"+{text}" for text in shown(*percent))
    return f"{mean}\n{low}..{high}" if np.isfinite(percent[1]) else mean


EXPLANATIONS = {
    "intervals": "95 %, bootstrap over worlds",
    "e50, e95": "median and 95th percentile of the error of vehicles under way, from 3 s on",
    "few": "share of that time with fewer than three targets in view",
    "return": "sum of the rewards of a vehicle",
}
"""What the words of the tables mean."""
