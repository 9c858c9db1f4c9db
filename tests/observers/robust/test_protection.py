"""Protection levels against errors drawn in NumPy: at their risk, horizontal and angular errors stay below them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.observers.robust.constants import RISK
from coopenv.observers.robust.protection import QUANTILE, fault_variances, levels, own_variances
from tests.helpers.warp_calls import Calls

DRAWS = 400_000
CALLS = Calls(__name__, {}, {levels: "3 2 6 > 2", own_variances: "3 66 > 2", fault_variances: "3 63 33 > 2"})


def levels_of(R: Any, P: Any, mean: Any) -> np.ndarray:
    up = R[None, 2]
    variances = CALLS(own_variances, "float64", up, P[None])
    return np.asarray(CALLS(levels, "float64", up, variances, mean[None]))[0]


def horizontal(R: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return the horizontal length, m, of left errors (n, 6), whose position part is in the body frame."""
    return np.linalg.norm((errors[:, 3:] @ R.T)[:, :2], axis=1)


@pytest.mark.parametrize("seed", range(12))
def test_errors_exceed_them_at_most_at_the_risk(seed: int) -> None:
    """Gaussian errors whose covariance has axes of very different lengths, and whose mean is up to ten of them."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    root = np.linalg.qr(rng.normal(size=(6, 6)))[0] * 10.0 ** rng.uniform(-3.0, 0.0, 6)
    if seed % 3 == 0:  # one dominant axis: the case in which the bound is tight
        root[:, 1:] *= 1e-3
    mean = (seed % 4) * 0.3 * rng.normal(size=6) * np.abs(root).max()
    bound = levels_of(R, root @ root.T, mean)
    errors = mean + rng.normal(size=(DRAWS, 6)) @ root.T
    reached = horizontal(R, errors), np.linalg.norm(errors[:, :3], axis=1)
    limit = RISK + 4.0 * np.sqrt(RISK / DRAWS)
    assert all(np.mean(error > level) <= limit for error, level in zip(reached, bound, strict=True))


def test_an_error_along_one_axis_is_bounded_tightly() -> None:
    R, along = Rotation.from_euler("z", 0.7).as_matrix(), np.array([0.0, 0.0, 0.3, 0.4, 0.0, 0.0])
    rng = np.random.default_rng(1)
    errors = rng.normal(size=(DRAWS, 1)) * along
    bound = levels_of(R, np.outer(along, along), np.zeros(6))
    assert_allclose(bound, QUANTILE * np.array([0.4, 0.3]), rtol=1e-12)
    exceeded = np.mean(horizontal(R, errors) > bound[0])
    assert exceeded == pytest.approx(RISK, abs=4.0 * np.sqrt(RISK / DRAWS))


def test_errors_along_the_vertical_do_not_count() -> None:
    """Whatever the attitude of the vehicle: the vertical is that of the map."""
    R = Rotation.from_rotvec([0.4, -0.9, 2.0]).as_matrix()
    up = np.concatenate([np.zeros(3), R.T @ [0.0, 0.0, 1.0]])
    assert_allclose(levels_of(R, np.outer(up, up), 5.0 * up), 0.0, atol=1e-6)


def test_variances_of_a_fault_are_those_of_its_covariance() -> None:
    rng = np.random.default_rng(3)
    up, Phi, root = Rotation.random(rng=rng).as_matrix()[2], rng.normal(size=(6, 3)), rng.normal(size=(3, 3))
    C = root @ root.T
    expected = CALLS(own_variances, "float64", up[None], (Phi @ C @ Phi.T)[None])
    assert_allclose(CALLS(fault_variances, "float64", up[None], Phi[None], C[None]), expected, rtol=1e-10)
