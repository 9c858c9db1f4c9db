"""The guard of the covariance that `robust` states, in kernels."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from coopenv.observers import Recording, Run, guard, run
from coopenv.observers.robust.guard import factor_of, share_without_largest
from coopenv.observers.robust.observer import robust
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.warp_calls import Calls

HORIZON = 8.0  # s
TIME = 1.0  # s, of correlated noise


CALLS = Calls(__name__, {}, {factor_of: "1 1 1 > 1", share_without_largest: "i > 1"})


def test_numbers_are_those_of_the_zoo() -> None:
    totals = np.array([[10.0, 9.0, 8.0], [60.0, 9.0, 8.0], [300.0, 20.0, 0.1], [250.0, 20.0, 0.1], [80.0, 40.0, 40.0]])
    found = np.asarray(CALLS(factor_of, "float64", *totals.T))
    assert found == pytest.approx([guard.factor_of(*row) for row in totals], rel=1e-12)
    assert (found > 1.0).tolist() == [False, True, False, False, False]
    counts = np.arange(1, 9)
    shares = np.asarray(CALLS(share_without_largest, "float64", counts))
    assert shares == pytest.approx([guard.share_without_largest(int(count)) for count in counts], rel=1e-12)


@cache
def recording() -> Recording:
    """Return a nominal record."""
    overrides = {"horizon": HORIZON, "rates.camera": 20.0, "rates.odometry": 20.0}
    return record(load_scenario("busy_intersection_tracking", overrides), 3)


def correlated(made: Recording, std: float) -> Recording:
    """Return a record with bearing noise that is correlated over a second, rad."""
    rng, kept = np.random.default_rng(4), np.exp(-made.dt / TIME)
    error = rng.normal(size=made.bearings.shape) * std
    for k in range(1, len(error)):
        error[k] = kept * error[k - 1] + np.sqrt(1.0 - kept**2) * error[k]
    bearings = made.bearings + error
    return replace(made, bearings=bearings / np.linalg.norm(bearings, axis=-1, keepdims=True))


def with_factors(made: Recording) -> tuple[Run, np.ndarray]:
    """Return a run and the factors of the vehicles at its end."""
    observers = [robust(setup) for setup in made.setups]
    names = [setup.name for setup in made.setups]
    result = run(lambda setup: observers[names.index(setup.name)], made)
    assert not result.failure
    return result, np.array([observer.memory.belief["guard"]["factor"].item() for observer in observers])


def test_the_factor_of_a_nominal_run_is_exactly_one() -> None:
    assert (with_factors(recording())[1] == 1.0).all()


def test_correlated_noise_enlarges_what_is_stated_and_makes_levels_unknown() -> None:
    nominal, _ = with_factors(recording())
    result, factors = with_factors(correlated(recording(), 0.01))
    assert factors[0] > guard.UNKNOWN
    assert np.trace(result.covariance[-1, 0]) > 0.5 * factors[0] * np.trace(nominal.covariance[-1, 0])
    assert np.isinf(result.protection_level[-1, factors > guard.UNKNOWN]).all()
