"""Scenarios of any size, and exponents."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.speed.growth import WORLDS, Sweep, fit_power_law, growth_scenario, summarise, sweeps
from benchmarks.speed.measure import Result
from coopenv.scenario.schema import neighbour_sets


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.37])
def test_the_exponent_of_a_power_law_is_found(exponent: float) -> None:
    sizes = [1, 4, 16, 64]
    law = fit_power_law(sizes, [3e-4 * n**exponent for n in sizes])
    assert law.exponent == pytest.approx(exponent, abs=1e-9)
    assert law.factor == pytest.approx(3e-4)


def test_noise_moves_the_exponent_little() -> None:
    sizes = [2**i for i in range(1, 9)]
    noise = np.exp(np.random.default_rng(0).normal(0, 0.05, len(sizes)))
    assert fit_power_law(sizes, [n**1.5 * e for n, e in zip(sizes, noise, strict=True)]).exponent == pytest.approx(
        1.5, abs=0.05
    )


def costs(sweep: Sweep, *seconds: float | None) -> list[Result]:
    return [
        Result(case, problem="failed")
        if cost is None
        else Result(case, rounds=[{"steps": 1, "ticks": 1, "wall_s": cost, "cpu_s": cost}])
        for case, cost in zip(sweep.cases(), seconds, strict=True)
    ]


def test_constant_costs_do_not_hide_the_growth_of_large_sizes() -> None:
    sweep = Sweep("worlds", True, (1, 10, 100, 1000, 10000))
    growth = summarise(sweep, costs(sweep, *(1e-3 + 1e-5 * n for n in sweep.sizes)))
    assert growth is not None
    assert growth.overall.exponent < 0.7
    assert growth.large.exponent == pytest.approx(0.86, abs=0.02)
    assert growth.row()["label"] == "worlds, sensed"


def test_sizes_that_failed_are_left_out() -> None:
    sweep = Sweep("vehicles", False, (2, 4, 8))
    growth = summarise(sweep, costs(sweep, 1.0, 2.0, None))
    assert growth is not None
    assert growth.sizes == [2, 4]
    assert growth.overall.exponent == pytest.approx(1.0)
    assert summarise(sweep, costs(sweep, 1.0, None, None)) is None


@pytest.mark.parametrize(("vehicles", "landmarks"), [(2, 3), (64, 3), (5, 64)])
def test_scenarios_of_any_size_are_possible(vehicles: int, landmarks: int) -> None:
    fixed = growth_scenario(vehicles, landmarks, sensed=False)
    assert (len(fixed.vehicles), len(fixed.landmarks)) == (vehicles, landmarks)
    assert {len(targets) for targets in neighbour_sets(fixed)} == {3}
    sensed = growth_scenario(vehicles, landmarks, sensed=True)
    assert [len(targets) for targets in neighbour_sets(sensed)] == [landmarks + i for i in range(vehicles)]


def test_sweeps_hold_everything_but_one_quantity() -> None:
    by_quantity = {(s.quantity, s.sensed): s.cases() for s in sweeps()}
    assert [c.vehicles for c in by_quantity["vehicles", True]] == [2, 4, 8, 16, 32, 64]
    assert {c.worlds for c in by_quantity["vehicles", True]} == {WORLDS}
    assert {c.vehicles for c in by_quantity["landmarks", True]} == {5}
    assert [c.options["growth"]["landmarks"] for c in by_quantity["landmarks", True]] == [3, 6, 12, 24, 48, 64]
    assert by_quantity["worlds", True][-1].worlds == 65536
