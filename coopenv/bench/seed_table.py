"""A study over seeds as a table that fits a terminal."""

from __future__ import annotations

import numpy as np
from rich import box
from rich.table import Table

from coopenv.bench.seeds import SeedStudy


def seed_table(study: SeedStudy) -> Table:
    """Return one row per vehicle: settled seeds, settling time, steady RMSE as mean, spread and worst."""
    table = Table(box=box.HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    table.add_column("vehicle", no_wrap=True)
    for heading in ("settled\nseeds", "settles at [s]\nmedian (last)", "position RMSE [m]\nmean±std (worst)"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("orientation [deg]\nmean±std (worst)", justify="right", no_wrap=True)
    for i, vehicle in enumerate(study.vehicles):
        times = study.settle_time[:, i]
        settled = times[np.isfinite(times)]
        table.add_row(
            vehicle,
            f"{len(settled)}/{len(times)}",
            f"{np.median(settled):.1f} ({settled.max():.1f})" if len(settled) else "-",
            _spread(study.position_rmse[:, i], 4),
            _spread(study.orientation_rmse[:, i], 2),
        )
    return table


def _spread(values: np.ndarray, digits: int) -> str:
    return f"{values.mean():.{digits}f}±{values.std():.{digits}f} ({values.max():.{digits}f})"
