"""Basins: the draws are counted, and the same ones come again."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from coopenv.base.errors import CoopenvError
from coopenv.bench.executors import Local
from coopenv.bench.observers import find_source
from coopenv.bench.observers.basin import (
    BasinTask,
    Draw,
    basin_failures,
    basin_table,
    basins_of,
    by_angle,
    draw_starts,
    study_basin,
)
from coopenv.observers import Estimate, Tick, find
from coopenv.observers.single_frame import DeadReckoning


def draws_of(number: int, angles: list[float], ends: list[float], time: float) -> list[Draw]:
    return [
        Draw(number, "made_up", f"vehicle_{i}", angle, 3.0, end < 0.1, time, end, 0.5, "")
        for i, (angle, end) in enumerate(zip(angles, ends, strict=True))
    ]


def test_a_draw_converges_when_every_vehicle_does() -> None:
    draws = [*draws_of(0, [10, 100], [0.01, 0.02], 4.0), *draws_of(1, [20, 179], [0.01, 0.2], np.nan)]
    (basin,) = basins_of("here", draws)
    assert (basin.converged_fraction, basin.by_vehicle, basin.convergence_time_s) == (0.5, (1.0, 0.5), 4.0)
    assert basin.interval.low < 0.5 < basin.interval.high and basin.draws == 2
    assert by_angle(draws) == [(2, 2), (0, 0), (0, 0), (1, 1), (0, 0), (0, 1)]


def test_a_failed_run_does_not_converge() -> None:
    (basin,) = basins_of("here", draws_of(0, [10, 10], [np.nan, np.nan], np.nan))
    assert basin.converged_fraction == 0.0 and np.isnan(basin.convergence_time_s)


class RaisesUpsideDown(DeadReckoning):
    """Fails from wide starts only."""

    def update(self, tick: Tick) -> Estimate:
        estimate = super().update(tick)
        return 1 / 0 if estimate.rotation[2, 2] < 0 else estimate  # type: ignore[return-value]


def test_failures_are_counted_and_told() -> None:
    factories = {"raises": RaisesUpsideDown, "mekf": find("mekf")}
    draws = draw_starts(BasinTask(find_source("overtaking", {"horizon": 0.1}), range(6), factories))
    raises, mekf = basins_of("here", draws)
    failures = [draw.failure for draw in draws if draw.failure]
    assert 0 < 2 * raises.failed == len(failures) < 12 and raises.failure == failures[0]
    assert (mekf.failed, mekf.failure) == (0, "")
    (line,) = basin_failures([raises, mekf])
    assert line.startswith(f"raises (basin): failed in {raises.failed} of 6 draws, first of vehicle_")
    assert "ZeroDivisionError" in line
    assert {draw.failure for draw in draws if draw.observer == "mekf"} == {""}
    printed = StringIO()
    Console(file=printed, width=80).print(basin_table([raises, mekf]))
    assert printed.getvalue().splitlines()[3].split()[:3] == ["raises", "6", str(raises.failed)]


def test_draws_are_reproducible() -> None:
    source = find_source("overtaking", {"horizon": 1.0})
    one, two = (study_basin(source, ["riccati"], 3, Local(1)) for _ in range(2))
    assert [d.draw for d in one] == [0, 0, 1, 1, 2, 2]
    assert str(one) == str(two) and all(d.initial_position_error_m <= 15.0 for d in one)


def test_recorded_robots_have_no_basin() -> None:
    with pytest.raises(CoopenvError, match="recorded"):
        study_basin(find_source("mrclam_6"), ["riccati"], 1, Local(1))
