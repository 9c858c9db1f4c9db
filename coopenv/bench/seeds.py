"""The same scenario over many seeds: settling, and the accuracy of the steady state with its spread."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table

from coopenv.api.engine import Engine
from coopenv.estimation.metrics import SETTLED, settling_time
from coopenv.runs.console import number_table
from coopenv.runs.rollouts import Views, play
from coopenv.scenario import Scenario


@dataclass(frozen=True)
class SeedStudy:
    """Results per seed (S) and vehicle (N)."""

    vehicles: list[str]
    seeds: list[int]
    steady_from: float
    """s"""
    position_rmse_m: np.ndarray
    """Over t > steady_from."""
    orientation_rmse_deg: np.ndarray
    settle_time_s: np.ndarray
    """After which the errors stay within SETTLED; NaN: never."""
    final_position_error_m: np.ndarray
    final_orientation_error_deg: np.ndarray

    def document(self, environment: str) -> dict[str, Any]:
        """Return what `bench seeds --json` prints: per vehicle, one figure per seed."""
        figures = {name: values for name, values in vars(self).items() if isinstance(values, np.ndarray)}
        return {
            "environment": environment,
            "seeds": self.seeds,
            "steady_from_s": self.steady_from,
            "settled_below": SETTLED._asdict(),
            "vehicles": [
                {"vehicle": vehicle, **{name: values[:, i] for name, values in figures.items()}}
                for i, vehicle in enumerate(self.vehicles)
            ],
        }


def study_seeds(
    scenario: Scenario, seeds: range, steady_from: float, on_progress: Callable[[float], None] = lambda share: None
) -> SeedStudy:
    """Run one world per seed, all at once, with action zero, and judge every camera tick; `steady_from` in s."""
    engine, ticks = Engine(scenario, len(seeds), "float64"), scenario.horizon_ticks
    views = Views(engine, ("position_error", "orientation_error"))
    for tick in play(engine, seeds, ticks):
        views.take()
        if tick % 100 == 0:
            on_progress(tick / ticks)
    position, orientation = views["position_error"], views["orientation_error"]
    t = np.arange(ticks + 1) / scenario.rates.camera
    steady = t > steady_from
    return SeedStudy(
        vehicles=scenario.vehicle_names,
        seeds=list(seeds),
        steady_from=steady_from,
        position_rmse_m=np.sqrt((position[steady] ** 2).mean(axis=0)),
        orientation_rmse_deg=np.sqrt((orientation[steady] ** 2).mean(axis=0)),
        settle_time_s=settling_time(t, position, orientation, SETTLED),
        final_position_error_m=position[-1],
        final_orientation_error_deg=orientation[-1],
    )


def seed_table(study: SeedStudy) -> Table:
    """Return one row per vehicle: settled seeds, settling time, steady RMSE as mean, spread and worst."""
    rmse = ("position RMSE [m]\nmean±std (worst)", "orientation [deg]\nmean±std (worst)")
    table = number_table(("vehicle",), ("settled\nseeds", "settles at [s]\nmedian (last)", *rmse))
    for i, vehicle in enumerate(study.vehicles):
        times = study.settle_time_s[:, i]
        settled = times[np.isfinite(times)]
        table.add_row(
            vehicle,
            f"{len(settled)}/{len(times)}",
            f"{np.median(settled):.1f} ({settled.max():.1f})" if len(settled) else "-",
            _spread(study.position_rmse_m[:, i], 4),
            _spread(study.orientation_rmse_deg[:, i], 2),
        )
    return table


def _spread(values: np.ndarray, digits: int) -> str:
    return f"{values.mean():.{digits}f}±{values.std():.{digits}f} ({values.max():.{digits}f})"
