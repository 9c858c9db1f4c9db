"""Tables that fit a terminal, and the one that `coopenv run` ends with."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from rich import box
from rich.table import Table

from coopenv.base.format import column, number, seconds
from coopenv.estimation.metrics import CONVERGED, SETTLED

COLUMNS = (
    ("initial_position_error_m", "start\n[m]", column),
    ("initial_orientation_error_deg", "\n[deg]", column),
    ("settle_time_s", "settles\n[s]", seconds),
    ("convergence_time_s", "converges\n[s]", seconds),
    ("steady_position_rmse_m", "RMSE\n[m]", column),
    ("steady_orientation_rmse_deg", "\n[deg]", column),
    ("mean_targets_in_view", "targets\nseen", column),
    ("mean_nees", "mean\nNEES", column),
)
"""Key of a vehicle's metrics, heading, and how a column of them is written."""

RATE_COLUMNS = (
    "rate_per_s",
    "slowest_rate_per_s",
    "slowest_rate_from_s",
    "guaranteed_rate_per_s",
    "guaranteed_rate_at_s",
    "frozen_rate_window_per_s",
    "frozen_rate_window_from_s",
)

VERDICTS = {
    "not_observable_s": "not observable",
    "carried_by_odometry_s": f"not observable now, but carried by odometry (within {CONVERGED.text})",
}


def number_table(names: Sequence[str], numbers: Sequence[str], gap: int = 1) -> Table:
    """Return an empty table: columns of names, then of numbers, `gap` + 1 spaces between them."""
    table = Table(box=box.HORIZONTALS, padding=(0, gap, 0, 0), pad_edge=False, show_edge=False)
    for heading in names:
        table.add_column(heading, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def metrics_table(vehicles: list[dict[str, Any]]) -> Table:
    """Return one row per vehicle: initial error, times to settle and converge, steady errors, targets, NEES."""
    table = number_table(["\nvehicle"], [heading for _, heading, _ in COLUMNS])
    cells = [write([vehicle[key] for vehicle in vehicles]) for key, _, write in COLUMNS]
    for vehicle, row in zip(vehicles, zip(*cells, strict=True), strict=True):
        table.add_row(vehicle["vehicle"], *row)
    return table


def rates(vehicles: list[dict[str, Any]]) -> Iterator[Table | str]:
    """Yield the measured rates beside those of the theory and what they mean; nothing where there is no theory."""
    if all(math.isnan(vehicle["guaranteed_rate_per_s"]) for vehicle in vehicles):
        return
    headings = ["fitted\n[1/s]", "slowest 5 s\n[1/s]", "from\n[s]", "guaranteed\n[1/s]", "at\n[s]"]
    table = number_table(["rate\nvehicle"], [*headings, "frozen, 5 s\n[1/s]", "from\n[s]"])
    for vehicle in vehicles:
        figures = [number(vehicle[key], 3) for key in RATE_COLUMNS]
        table.add_row(vehicle["vehicle"], *figures)
    yield table
    yield "Guaranteed: the least of the run, in the norm of P. Frozen: k lambda_min(P M)."
    yield ""


def legend(steady_from: float, end: float) -> Iterator[str]:
    """Yield what the columns mean, for a steady state that starts at a time and a run that ends at one, s."""
    yield f"Settles: stays below {SETTLED.text}. Converges: stays below {CONVERGED.text}."
    if steady_from < end:
        yield f"RMSE and NEES: steady state, after {steady_from:g} s. NEES of a consistent estimate: 6."
    else:
        yield f"No steady state: it would begin at {steady_from:g} s (see --steady-from)."


def remarks(vehicles: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what is remarkable: early ends, gaps in observability, mirrored estimates."""
    for vehicle in vehicles:
        if not math.isnan(vehicle["ended_at_s"]):
            yield f"{vehicle['vehicle']}: {vehicle['outcome']} at {vehicle['ended_at_s']:.2f} s, where its figures end"
    for vehicle in vehicles:
        for key, words in VERDICTS.items():
            if gaps := vehicle["observability"][key]:
                times = ", ".join(f"{start:.4g}-{end:.4g}" for start, end in gaps)
                yield f"{vehicle['vehicle']}: {words} at {times} s"
    for vehicle in vehicles:
        if vehicle["mirrored"]:
            angle = f"{vehicle['final_orientation_error_deg']:.4g} deg"
            yield f"{vehicle['vehicle']}: mirrored solution, the orientation ends {angle} off"
