"""The comparison of observers: same ticks for all, any number of processes, failures that stop nobody else."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

import coopenv
from coopenv.bench.observers import compare
from coopenv.bench.observers.faults import VARIANTS
from coopenv.bench.observers.tables import failures
from coopenv.observers import registry, run
from coopenv.observers.bound import cramer_rao, cramer_rao_ancestors
from coopenv.observers.contract import Estimate, Tick
from coopenv.observers.single_frame import DeadReckoning
from coopenv.runs.recorder import record

SHORT = {"horizon": 1.5}


def test_rows_are_root_means_over_seeds() -> None:
    scenario = coopenv.load_scenario("overtaking", SHORT)
    rows = compare(["riccati", "dead_reckoning"], "overtaking", 2, overrides=SHORT, steady_from=0.5).rows
    assert [(row.observer, row.vehicle) for row in rows] == [
        (name, f"vehicle_{i}") for name in ("riccati", "dead_reckoning") for i in (1, 2)
    ]
    records = [record(scenario, seed) for seed in (0, 1)]
    late = records[0].t > 0.5
    errors = np.array([run("riccati", made).position_error[late] for made in records])
    each = np.sqrt(np.mean(errors**2, axis=1))
    assert [row.position_rmse_m for row in rows[:2]] == pytest.approx(np.sqrt(np.mean(each**2, axis=0)), rel=1e-12)
    assert [row.position_rmse_median_m for row in rows[:2]] == pytest.approx(each.mean(axis=0), rel=1e-12)
    for column, bound in (("bound_m", cramer_rao), ("bound_ancestors_m", cramer_rao_ancestors)):
        squares = [np.mean(bound(made).position[late] ** 2, axis=0) for made in records]
        assert [getattr(row, column) for row in rows[:2]] == pytest.approx(np.sqrt(np.mean(squares, axis=0)), rel=1e-12)
    for row in rows:
        assert row.ratio_to_bound == pytest.approx(row.position_rmse_m / row.bound_m)
        assert max(row.bound_m, row.bound_single_m) <= row.bound_ancestors_m * (1 + 1e-9)
        assert row.degradation == pytest.approx(1.0) and row.gramian_min_eigenvalue >= 0.0


def test_every_fault_has_its_rows() -> None:
    short = {"horizon": 2.0}
    found = compare(["mekf_covariance"], "busy_intersection", 1, variants="all", overrides=short, steady_from=1.0)
    rows = found.rows
    assert list(dict.fromkeys(row.variant for row in rows)) == list(VARIANTS)
    rmse = {name: [row.position_rmse_m for row in rows if row.variant == name] for name in VARIANTS}
    for name in set(VARIANTS) - {"nominal"}:
        assert rmse[name] != pytest.approx(rmse["nominal"], rel=1e-3)
        ratios = [row.degradation for row in rows if row.variant == name]
        assert ratios == pytest.approx(np.divide(rmse[name], rmse["nominal"]))
        total = found.totals[name, "mekf_covariance"]
        assert total.degradation.value == pytest.approx(sum(rmse[name]) / sum(rmse["nominal"]))
    assert rmse["lying_neighbour"][:2] == pytest.approx(rmse["nominal"][:2], rel=1e-9)  # the liar and its leader


class Raises(DeadReckoning):
    """Fails at its first update."""

    def update(self, tick: Tick) -> Estimate:
        raise ZeroDivisionError("by design")


class Tells(DeadReckoning):
    """Tells an innovation of 3 in 2 degrees of freedom."""

    def update(self, tick: Tick) -> Estimate:
        found = super().update(tick)
        return Estimate(found.rotation, found.position, found.covariance, found.coordinates, 3.0, 2)


def test_observers_registered_here_travel_to_other_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """One fails, which stops nobody else; another tells its NIS."""
    monkeypatch.setattr(registry, "_registered", {})
    registry.register("raises", Raises)
    registry.register("tells", Tells)
    names = ["raises", "tells", "dead_reckoning"]
    rows = compare(names, "overtaking", 2, overrides=SHORT, steady_from=0.5, jobs=2).rows
    assert len(failures(rows)) == 1 and "by design" in failures(rows)[0]
    assert np.isnan(rows[0].position_rmse_m) and rows[0].settled_fraction == 0.0 and rows[0].diverged_fraction == 1.0
    assert [row.nis for row in rows[2:4]] == pytest.approx([1.5, 1.5]) and np.isnan(rows[-1].nis)
    assert [row.position_rmse_m for row in rows[2:4]] == pytest.approx([row.position_rmse_m for row in rows[4:]])
    dof = 2 * 2 * 60  # of two seeds, 1 s at 60 Hz
    assert [rows[2].nis_low, rows[2].nis_high] == pytest.approx(chi2.ppf([0.025, 0.975], dof) / dof)
    assert [rows[2].anees_low, rows[2].anees_high] == pytest.approx(chi2.ppf([0.025, 0.975], 12) / 12)
    assert np.isnan([rows[0].anees_low, rows[-1].nis_low]).all()
