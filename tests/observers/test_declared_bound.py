"""The bound with errors of latency, mountings and maps: against an information filter over all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.observers.bound import cramer_rao, cramer_rao_ancestors
from tests.oracles.batch import small_record
from tests.oracles.declared_errors import MAP, declaring, recursion


def relative_difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the largest difference of covariances (..., 6, 6) over the product of standard deviations."""
    std = np.sqrt(np.diagonal(theirs, axis1=-2, axis2=-1))
    return float((np.abs(ours - theirs) / (std[..., :, None] * std[..., None, :])).max())


def test_the_bound_of_all_declared_errors_is_that_of_a_recursion_over_them() -> None:
    made = declaring(small_record(12))
    theirs = recursion(made, [*range(len(made.setups))])
    assert relative_difference(cramer_rao(made).covariance, theirs) < 1e-9


def test_a_vehicle_without_ancestors_has_the_bound_of_its_own_measurements() -> None:
    made = declaring(small_record(12))
    theirs = recursion(made, [0])[:, 0]
    assert relative_difference(cramer_rao_ancestors(made).covariance[:, 0], theirs) < 1e-9


@pytest.mark.parametrize("error", ["latency", "latency_jitter", "camera_orientation_walk", "landmark_std"])
def test_every_declared_error_raises_the_bound(error: str) -> None:
    made = small_record(8)
    if error == "landmark_std":
        setups = tuple(replace(s, landmark_std=(MAP,) * made.landmarks.shape[1]) for s in made.setups)
    else:
        setups = tuple(replace(s, noise=replace(s.noise, **{error: 0.05})) for s in made.setups)
    plain, more = cramer_rao(made), cramer_rao(replace(made, setups=setups))
    assert (more.position[2:] > plain.position[2:]).all()
    assert_allclose(more.position[0], plain.position[0])
