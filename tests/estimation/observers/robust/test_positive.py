"""Cholesky solves against NumPy's general ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.estimation.observers.robust.positive import invert_positive, solve_positive


@pytest.mark.parametrize("n", [1, 2, 6, 24])
def test_inverse_and_solution(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    A = A @ A.T + 0.1 * np.eye(n)
    b = rng.normal(size=(n, 3))
    assert_allclose(invert_positive(A), np.linalg.inv(A), rtol=1e-9, atol=1e-9)
    assert_allclose(invert_positive(A), invert_positive(A).T, atol=0.0)
    assert_allclose(solve_positive(A, b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-9)


def test_indefinite_is_refused():
    for f in (invert_positive, lambda A: solve_positive(A, np.ones(2))):
        with pytest.raises(np.linalg.LinAlgError):
            f(np.diag([1.0, -1.0]))
