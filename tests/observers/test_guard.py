"""The guard of a covariance that is stated and broadcast."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2, norm

from coopenv.observers.correction import judged
from coopenv.observers.guard import Guard, largest_total, share_without_largest
from coopenv.observers.schmidt_kalman import SchmidtKalman
from coopenv.observers.self_calibrating import SelfCalibrating
from tests.helpers.recordings import completed, simulated

PERIOD = 0.05  # s
Innovations = Callable[[int], np.ndarray]


def add(guard: Guard, time: float, normal: np.ndarray, white: float = 1.0, lasting: bool = False) -> None:
    """Add innovations (m, r) over their standard deviations, not measured where NaN."""
    shares = np.where(np.isnan(normal), 0.0, white), np.where(np.isnan(normal), 0.0, np.sqrt(1.0 - white))
    count = len(normal)
    guard.add(time, np.arange(count), np.stack([np.nan_to_num(normal), *shares], axis=1), np.full(count, lasting))


def guarded(innovations: Innovations, ticks: int, white: float = 1.0, lasting: bool = False) -> Guard:
    """Return a guard after innovations by tick."""
    guard = Guard()
    for k in range(ticks):
        add(guard, k * PERIOD, innovations(k), white, lasting)
    return guard


def biased(seed: int, bias: float, sources: int, of: slice = slice(None)) -> Innovations:
    """Return white innovations with a bias in one row of some sources."""
    rng, shift = np.random.default_rng(seed), np.zeros((sources, 2))
    shift[of, 0] = bias
    return lambda k: rng.normal(size=(sources, 2)) + shift


@pytest.mark.parametrize("sources", [1, 2, 3, 12])
def test_white_innovations_have_a_factor_of_exactly_one(sources: int) -> None:
    for seed in range(5):
        innovations = biased(seed, 0.0, sources)
        guard = Guard()
        for k in range(600):
            add(guard, k * PERIOD, innovations(k))
            assert guard.factor == 1.0


def test_a_bias_of_a_deviation_grows_with_the_length_of_a_block() -> None:
    """The squared sum of n innovations with a bias b has the expectation n (1 + n b^2 / 2) per row of two."""
    factor = guarded(biased(0, 1.0, 8), 400).factor
    n = 4.0 / PERIOD
    assert factor == pytest.approx(1.0 + n / 2.0, rel=0.6)
    assert factor > 2.0 * guarded(biased(0, 0.5, 8), 400).factor > 2.0


def test_the_factor_returns_to_one_after_the_bias() -> None:
    both = biased(0, 1.0, 4), biased(1, 0.0, 4)
    assert guarded(lambda k: both[k >= 200](k), 200).factor > 5.0
    assert guarded(lambda k: both[k >= 200](k), 1600).factor == 1.0


def test_an_error_of_another_vehicle_may_last() -> None:
    """Its share of the variance makes the frames of a block one, and the blocks."""
    constant = lambda k: np.full((3, 2), 2.0)  # noqa: E731
    assert guarded(constant, 400, white=0.01, lasting=True).factor == 1.0
    assert guarded(constant, 400, white=0.01).factor > 10.0
    assert guarded(constant, 400, white=0.95, lasting=True).factor > 10.0


def test_one_source_of_several_may_be_wrong() -> None:
    assert guarded(biased(0, 3.0, 3, slice(0, 1)), 400).factor == 1.0
    assert guarded(biased(0, 3.0, 3, slice(0, 2)), 400).factor > 10.0


def test_innovations_are_limited_to_one_of_a_thousand() -> None:
    """A measurement that its gate refuses counts as one at the gate."""
    every, S = np.ones((2, 2), bool), np.tile(1e-4 * np.eye(2), (2, 1, 1))
    *_, innovations = judged(np.array([[1.0, -1.0], [1e-3, 0.0]]), S, np.full((2, 2), 4e-5), every, every, every[0])
    limit = norm.isf(5e-4)
    assert_allclose(innovations[:, 0], [[limit, -limit], [0.1, 0.0]], rtol=1e-3)
    assert_allclose(innovations[:, 1], 0.4, rtol=1e-3)
    assert_allclose(innovations[:, 2] ** 2, 0.6, rtol=1e-3)


def test_what_was_not_measured_counts_nothing() -> None:
    rng = np.random.default_rng(3)
    whole = [rng.normal(1.0, 1.0, size=(3, 2)) for _ in range(400)]
    wider = guarded(lambda k: np.pad(whole[k], ((0, 0), (0, 1)), constant_values=np.nan), 400)
    assert wider.factor == guarded(lambda k: whole[k], 400).factor > 1.0


@pytest.mark.parametrize("freedom", [2, 5, 20, 200])
def test_the_quantile_is_the_one_of_chi_square(freedom: int) -> None:
    assert largest_total(freedom) == pytest.approx(chi2.isf(1e-6, freedom), rel=0.1)


def test_the_share_without_the_largest() -> None:
    squared = np.random.default_rng(0).chisquare(2, size=(200_000, 3))
    expected = 1.0 - squared.max(axis=1).mean() / squared.sum(axis=1).mean()
    assert share_without_largest(3) == pytest.approx(expected, abs=0.005)
    assert share_without_largest(1) == 1.0


class Doubted(SchmidtKalman):
    """A filter whose guard has a factor."""

    def reset(self, *start: np.ndarray) -> None:
        super().reset(*start)
        self.guard.factor, self.guard.end_block = 9.0, lambda length, time: None


class Trusting(SchmidtKalman):
    """A filter without a guard, of which `Doubted` differs in what it states."""

    guarded = False


def test_the_factor_multiplies_what_is_stated_and_not_the_gain() -> None:
    made = simulated()
    trusting, doubted = completed(Trusting, made), completed(Doubted, made)
    assert_allclose(doubted.covariance[1:, 0], 9.0 * trusting.covariance[1:, 0], rtol=1e-12)
    assert (doubted.position[:, 0] == trusting.position[:, 0]).all()  # it measures landmarks alone
    assert np.trace(doubted.covariance[-1, 1]) > np.trace(9.0 * trusting.covariance[-1, 1])  # of what it receives


def test_a_neighbour_corrects_no_estimate_whose_covariance_has_a_factor() -> None:
    made = simulated()
    observer = SelfCalibrating(made.setups[0])
    observer.reset((made.start_rotation[0], made.start_position[0]), 1e-4 * np.eye(6))
    numbers = []
    for factor in (1.0, 9.0, 1.0):
        observer.guard.factor = factor
        numbers.append(int(observer.message().extra["number"][0]))
    assert [*observer.since] == [numbers[0], numbers[2]]
