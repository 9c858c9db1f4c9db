"""The table that `coopenv run` ends with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from rich import box
from rich.table import Table

from coopenv.estimation.metrics import SETTLED_ORIENTATION_DEG, SETTLED_POSITION_M
from coopenv.runs.metrics import COARSE_ORIENTATION_DEG, COARSE_POSITION_M


def metrics_table(vehicles: list[dict[str, Any]], noisy: bool) -> Table:
    """Return one row per vehicle.

    With noise, which may keep an estimate from the settling tolerances, also the time to settle within wider ones;
    not in a small scene, where all estimates start about as near.
    """
    coarse = noisy and any(v["initial_position_error_m"] > 2 * COARSE_POSITION_M for v in vehicles)
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("\n\nvehicle", no_wrap=True)
    for header in _headers(coarse):
        table.add_column(header, justify="right", no_wrap=True)
    for vehicle in vehicles:
        table.add_row(*_cells(vehicle, coarse))
    return table


def _headers(with_coarse: bool) -> list[str]:
    fine = f"below\n{SETTLED_POSITION_M:g} m\n{SETTLED_ORIENTATION_DEG:g} deg"
    coarse = [f"below\n{COARSE_POSITION_M:g} m\n{COARSE_ORIENTATION_DEG:g} deg"] if with_coarse else []
    return [
        "start\nerror\nm",
        "\n\ndeg",
        fine,
        *coarse,
        "steady\nRMSE\nm",
        "\n\ndeg",
        "seen\ntar-\ngets",
        "\nmean\nNEES",
        "\nrate\n1/s",
        "obser-\nvable\n%",
    ]


def _cells(vehicle: dict[str, Any], with_coarse: bool) -> list[str]:
    coarse = [seconds(vehicle["coarse_settle_time_s"])] if with_coarse else []
    return [
        vehicle["vehicle"],
        figure(vehicle["initial_position_error_m"]),
        figure(vehicle["initial_orientation_error_deg"]),
        seconds(vehicle["settle_time_s"]),
        *coarse,
        figure(vehicle["steady_position_rmse_m"]),
        figure(vehicle["steady_orientation_rmse_deg"]),
        figure(vehicle["mean_targets_in_view"]),
        figure(vehicle["mean_nees"]),
        figure(vehicle["rate_per_s"]),
        percent(vehicle["observability"]["share_observable"]),
    ]


def remarks(vehicles: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines below the table: early ends, gaps in observability, missing rates, mirrored estimates."""
    for vehicle in vehicles:
        if not math.isnan(vehicle["ended_at_s"]):
            yield f"{vehicle['vehicle']}: {vehicle['outcome']} at {vehicle['ended_at_s']:.2f} s, where its figures end"
    for vehicle in vehicles:
        gaps = vehicle["observability"]["not_observable_s"]
        if gaps:
            times = ", ".join(f"{start:.4g}-{end:.4g}" for start, end in gaps)
            yield f"{vehicle['vehicle']}: not observable at {times} s"
    for vehicle in vehicles:
        if vehicle["rate_remark"] and not vehicle["mirrored"]:
            yield f"{vehicle['vehicle']}: {vehicle['rate_remark']}"
    for vehicle in vehicles:
        if vehicle["mirrored"]:
            yield (
                f"{vehicle['vehicle']}: mirrored solution, the orientation ends "
                f"{vehicle['final_orientation_error_deg']:.4g} deg off"
            )


def figure(value: float) -> str:
    """Return a number with three significant digits; a dash for NaN."""
    if math.isnan(value):
        return "-"
    return f"{value:.1e}" if 0 < abs(value) < 1e-3 or abs(value) >= 1e4 else f"{value:.3g}"


def seconds(value: float) -> str:
    """Return a time to a hundredth of a second; `never` for NaN."""
    return "never" if math.isnan(value) else f"{value:.2f} s"


def percent(share: float) -> str:
    """Return a share in percent, where 100 means all and 0 none."""
    if math.isnan(share):
        return "-"
    return f"{min(max(100 * share, 0.1), 99.9):.1f}" if 0 < share < 1 else f"{100 * share:.0f}"
