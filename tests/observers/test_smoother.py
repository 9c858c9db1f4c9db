"""The smoothers against a dense least squares, and against every filter on one recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.base.errors import CoopenvError
from coopenv.observers import Coordinates, run, smoother
from coopenv.observers.smoother import FixedLagSmoother, Smoother
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.oracles.batch import assert_same_covariance, small_record, small_solution


@pytest.mark.parametrize("name", ["smoother", "fixed_lag_smoother"])
@pytest.mark.parametrize("lag", [0.5, 0.02])
def test_with_small_errors_it_is_the_dense_least_squares(
    name: str, lag: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a lag of one frame all older frames are marginalised, which costs nothing in a linear problem."""
    monkeypatch.setattr(smoother, "LAG", lag)
    monkeypatch.setattr(smoother, "STEP_PERIOD", 1e-3)
    made = small_record(5)
    R, p, covariance = small_solution(5)
    result = run(name, made)
    assert not result.failure
    for i in range(5):
        std = np.sqrt(np.diag(covariance[i]))
        e = Coordinates.LEFT.error(R[i], p[i], result.rotation[-1, i], result.position[-1, i])
        assert np.abs(e / std).max() < 0.01
        assert_same_covariance(result.covariance[-1, i], covariance[i])


def test_in_a_lane_it_is_at_least_as_good_as_every_filter() -> None:
    """Range along a lane is weakly determined: `centralised` linearises it once and is overconfident."""
    made = record(load_scenario("lane:5", {"horizon": 8.0}), 3)
    rmse = {
        name: float(np.sqrt(np.mean(run(name, made).position_rmse(4.0) ** 2)))
        for name in ("smoother", "fixed_lag_smoother", "centralised", "schmidt_kalman", "robust", "mekf_covariance")
    }
    for name in ("smoother", "fixed_lag_smoother"):
        assert rmse[name] <= 1.05 * min(rmse.values()), rmse


def test_random_bearings_do_not_count() -> None:
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 5.0}), 1)
    bearings, rng = made.bearings.copy(), np.random.default_rng(0)
    random = made.visible & (rng.random(made.visible.shape) < 0.1)
    directions = rng.normal(size=(int(random.sum()), 3))
    bearings[random] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    clean, faulty = (run("fixed_lag_smoother", m).position_rmse(2.0) for m in (made, replace(made, bearings=bearings)))
    assert (faulty < 1.5 * clean + 0.02).all()


def test_the_smoothed_trajectory_is_better_than_the_estimates_on_the_way() -> None:
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 4.0}), 2)
    errors = {}
    for kind in (FixedLagSmoother, Smoother):
        built = kind(made.setups)
        built.reset(list(zip(made.start_rotation, made.start_position, strict=True)), list(made.start_covariance))
        for k in range(1, made.ticks):
            built.update([made.tick(k, i, {}) for i in range(5)])
        R, p = built.trajectory()
        errors[kind] = np.sqrt(np.mean((p - made.truth.position) ** 2))
        assert_allclose(R.swapaxes(-1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    filtered = np.sqrt(np.mean((run("smoother", made).position_error) ** 2) / 3.0)
    assert errors[Smoother] < 0.9 * errors[FixedLagSmoother] < 0.9 * filtered


def test_without_information_it_ends_in_one_line() -> None:
    made = small_record(1)
    lost = FixedLagSmoother(made.setups)
    lost.reset(list(zip(made.start_rotation, made.start_position, strict=True)), list(made.start_covariance))
    lost.last = lost.last._replace(information=-1e12 * lost.last.information)
    with pytest.raises(CoopenvError, match="not positive definite"):
        lost.update([made.tick(1, i, {}) for i in range(5)])
