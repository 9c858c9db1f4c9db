"""The same seeds on different backends: steady errors side by side, with standard errors."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.table import Table

from coopenv.base.format import seconds
from coopenv.estimation.metrics import live_ticks, summarise
from coopenv.runs.rollouts import Rollout
from coopenv.runs.table import number_table


class Episodes:
    """What the episodes on one backend come to, one after the other."""

    def __init__(self, steady_from: float) -> None:
        """Say when the steady state begins, s."""
        self._steady_from = steady_from
        self._rows: list[list[dict[str, Any]]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, run: Rollout) -> None:
        """Take an episode that is over."""
        trajectory = run.trajectory().of_vehicles(run.vehicles).where_truth_is_known()
        ends = [ending.time for ending in run.endings()]
        static = np.array([k for k in range(len(run.scenario.landmarks)) if not trajectory.target_moving[k]])
        rows = summarise(trajectory, self._steady_from, ends)
        for vehicle, ticks in enumerate(live_ticks(trajectory.t, len(rows), ends)):
            seen = trajectory.visible[1:ticks, vehicle][:, static]
            rows[vehicle]["hidden_share"] = float(1.0 - seen.all(axis=-1).mean()) if len(seen) else np.nan
        self._rows.append(rows)

    def values(self, vehicle: int, name: str) -> np.ndarray:
        """Return (S,) a figure of a vehicle, per episode."""
        return np.array([rows[vehicle][name] for rows in self._rows], dtype=float)


def side_by_side(vehicles: list[str], backends: Mapping[str, Episodes]) -> Table:
    """Return a row per vehicle and backend, of all episodes: the last settling; means with standard errors."""
    headings = ("\nseeds", "settles\nby [s]", "RMSE [m]\nmean±SE", "RMSE [deg]\nmean±SE", "hidden [%]\nmean±SE")
    table = number_table(("\nvehicle", "\non"), headings)
    for i, vehicle in enumerate(vehicles):
        for name, episodes in backends.items():
            table.add_row(
                vehicle,
                name,
                str(len(episodes)),
                *seconds([float(episodes.values(i, "settle_time_s").max())]),
                _mean(episodes.values(i, "steady_position_rmse_m"), 4),
                _mean(episodes.values(i, "steady_orientation_rmse_deg"), 2),
                _mean(100.0 * episodes.values(i, "hidden_share"), 1),
            )
    return table


def _mean(values: np.ndarray, digits: int) -> str:
    """Return mean and standard error in words; the latter needs two values."""
    if len(values) < 2:
        return f"{values.mean():.{digits}f}"
    return f"{values.mean():.{digits}f}±{values.std(ddof=1) / np.sqrt(len(values)):.{digits}f}"
