"""Basins: the draws are counted, and the same ones come again."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.bench.leaderboard import find_source
from coopenv.bench.leaderboard.basin import Draw, basins_of, by_angle, plain_draws, study_basin
from coopenv.bench.leaderboard.engines import Local
from coopenv.errors import CoopenvError


def draw(number: int, angles: list[float], ends: list[float], settled: float) -> Draw:
    n = len(angles)
    return Draw(
        draw=number,
        observer="made_up",
        vehicles=tuple(f"vehicle_{i + 1}" for i in range(n)),
        initial_angle=np.array(angles),
        initial_distance=np.full(n, 3.0),
        settle_time=np.full(n, settled),
        end_position=np.array(ends),
        end_orientation=np.full(n, 0.5),
        failure="",
    )


def test_a_draw_converges_when_every_vehicle_does() -> None:
    draws = [draw(0, [10, 100], [0.01, 0.02], 4.0), draw(1, [20, 179], [0.01, 0.2], np.nan)]
    (basin,) = basins_of("here", draws)
    assert (basin.converged_fraction, basin.by_vehicle, basin.settle_time_s) == (0.5, (1.0, 0.5), 4.0)
    assert basin.interval.low < 0.5 < basin.interval.high
    assert by_angle(draws) == [(2, 2), (0, 0), (0, 0), (1, 1), (0, 0), (0, 1)]
    assert [line["converged"] for line in plain_draws(draws)] == [True, True, True, False]


def test_a_failed_run_does_not_converge() -> None:
    (basin,) = basins_of("here", [draw(0, [10, 10], [np.nan, np.nan], np.nan)])
    assert basin.converged_fraction == 0.0 and np.isnan(basin.settle_time_s)


def test_draws_are_reproducible() -> None:
    source = find_source("overtaking", {"horizon": 1.0})
    one, two = (study_basin(source, ["riccati"], 3, Local(1)) for _ in range(2))
    assert [d.draw for d in one] == [0, 1, 2]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.end_position, b.end_position)
        np.testing.assert_array_equal(a.initial_angle, b.initial_angle)
        assert (a.initial_distance <= 15.0).all()


def test_recorded_robots_have_no_basin() -> None:
    with pytest.raises(CoopenvError, match="recorded"):
        study_basin(find_source("mrclam_6"), ["riccati"], 1, Local(1))
