"""Estimators of whole records: the smoother, factor graphs and belief propagation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.base.errors import CoopenvError
from coopenv.observers import Coordinates, Recording, Run, Tick, belief_propagation, run, smoother
from coopenv.observers.belief_propagation import BeliefPropagation
from coopenv.observers.registry import ZOO, available_names, find, list_observers
from coopenv.observers.smoother import FixedLagSmoother, Smoother
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.recordings import completed
from tests.observers.test_filters import assert_most_probable
from tests.oracles.batch import assert_same_covariance, small_record


@pytest.mark.parametrize("name", ["smoother", "fixed_lag_smoother"])
@pytest.mark.parametrize("lag", [0.5, 0.02])
def test_with_small_errors_it_is_the_dense_least_squares(
    name: str, lag: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a lag of one frame all older frames are marginalised, which costs nothing in a linear problem."""
    monkeypatch.setattr(smoother, "LAG", lag)
    monkeypatch.setattr(smoother, "STEP_PERIOD", 1e-3)
    assert_most_probable(name, range(5), 5)


def test_in_a_lane_the_smoother_is_at_least_as_good_as_every_filter() -> None:
    """Range along a lane is weakly determined: `centralised` linearises it once and is overconfident."""
    made = record(load_scenario("lane:5", {"horizon": 5.0}), 3)
    rmse = {
        name: float(np.sqrt(np.mean(run(name, made).position_rmse(2.5) ** 2)))
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


def test_a_missing_module_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ZOO, "factor_graph", replace(ZOO["factor_graph"], needs="no_such_module"))
    assert "factor_graph" in list_observers() and "factor_graph" not in available_names()
    with pytest.raises(CoopenvError, match=r"'factor_graph' needs no_such_module: pip install '.\[bench\]'"):
        find("factor_graph")


def test_with_bearings_at_key_frames_the_graph_is_the_filter() -> None:
    """With small errors, what is most probable at the last frame does not depend on smoothing the others."""
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(12)  # 6 ticks of 60 Hz are one key frame
    visible = made.visible.copy()
    visible[[*range(1, 6), *range(7, 12)]] = False
    expected, result = (completed(name, replace(made, visible=visible)) for name in ("left_invariant", "factor_graph"))
    std = np.sqrt(expected.covariance[-1][:, range(6), range(6)])
    e = Coordinates.LEFT.error(expected.rotation[-1], expected.position[-1], result.rotation[-1], result.position[-1])
    assert_allclose(e / std, 0.0, atol=0.01)
    assert_same_covariance(result.covariance[-1], expected.covariance[-1])


def test_bearings_between_key_frames_count_as_well() -> None:
    """Of six equally good frames the mean has a sixth of the variance, if odometry between them is exact."""
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(6)
    exact = [replace(s, noise=replace(s.noise, velocity=1e-7, angular_velocity=1e-7)) for s in made.setups]
    made = replace(made, setups=tuple(exact))
    expected, result = run("left_invariant", made), run("factor_graph", made)
    assert_allclose(np.diag(result.covariance[-1, 0]), np.diag(expected.covariance[-1, 0]), rtol=0.01)
    std = np.sqrt(np.diag(expected.covariance[-1, 0]))
    e = Coordinates.LEFT.error(
        expected.rotation[-1, 0], expected.position[-1, 0], result.rotation[-1, 0], result.position[-1, 0]
    )
    assert_allclose(e / std, 0.0, atol=0.05)


def test_between_key_frames_it_is_dead_reckoning() -> None:
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(5)
    smoothed, reckoned = run("factor_graph", made), run("dead_reckoning", made)
    assert_allclose(smoothed.position, reckoned.position, atol=1e-12)


def test_nothing_seen_leaves_the_odometry_s_covariance() -> None:
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(20)
    blind = replace(made, visible=np.zeros_like(made.visible))
    smoothed, reckoned = run("factor_graph", blind), run("dead_reckoning", blind)
    assert_allclose(smoothed.position, reckoned.position, atol=1e-6)
    assert_allclose(smoothed.covariance[-1], reckoned.covariance[-1], rtol=1e-3, atol=1e-12)


class Converged(BeliefPropagation):
    """Passes messages through all frames until convergence."""

    def correct(self, ticks: list[Tick]) -> np.ndarray:
        super().correct(ticks)
        for _ in range(8):
            L, _ = self.propagate(0, 4)
        return np.linalg.inv(L[-1])


def deviation(result: Run, exact: Run) -> float:
    """Return the largest deviation of last positions in standard deviations of the exact solution."""
    assert not result.failure
    std = np.sqrt(np.diagonal(exact.covariance[-1], axis1=1, axis2=2)[:, 3:])
    return float(np.abs((result.position[-1] - exact.position[-1]) / std).max())


def tree(made: Recording) -> Recording:
    """Return a recording in which every vehicle measures landmarks, and one vehicle at the last frame alone."""
    L, visible = made.landmarks.shape[1], made.visible.copy()
    visible[:-1, :, L:] = False
    for i in range(visible.shape[1]):
        seen = np.flatnonzero(visible[-1, i])
        visible[-1, i, seen[seen >= L][1:]] = False
    assert visible[-1, :, L:].sum() >= 2
    return replace(made, visible=visible)


def test_on_a_tree_beliefs_are_the_exact_marginals() -> None:
    made = tree(small_record(4))
    exact, result = run("smoother", made), run(Converged, made)
    assert deviation(result, exact) < 1e-3
    assert_same_covariance(result.covariance[-1], exact.covariance[-1])
    assert deviation(run("belief_propagation", made), exact) < 0.02


def test_with_loops_means_are_those_of_least_squares_and_covariances_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(belief_propagation, "STEP_PERIOD", 1e-3)
    made = small_record(5)
    exact, result = run("smoother", made), run(Converged, made)
    assert deviation(result, exact) < 2e-3
    ratio = np.linalg.det(result.covariance[-1]) / np.linalg.det(exact.covariance[-1])
    assert (ratio < 1.0 + 1e-6).all() and ratio.min() < 0.9


def test_messages_are_counted() -> None:
    made = small_record(2)
    L = made.landmarks.shape[1]
    blind = replace(made, visible=made.visible & (np.arange(made.visible.shape[2]) < L))
    alone, together = (run("belief_propagation", m).bytes_per_second for m in (blind, made))
    assert (alone == 56 * 60.0).all()
    assert (together > alone).all()
