"""LAPACK called directly against NumPy's general routines."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.estimation.poses import cholesky, solve


@pytest.mark.parametrize("n", [1, 2, 6, 24])
def test_factor_and_solutions(n):
    rng = np.random.default_rng(n)
    B, b = rng.normal(size=(n, n)), rng.normal(size=(n, 3))
    A = B @ B.T + 0.1 * np.eye(n)
    assert_allclose(solve(B, b), np.linalg.solve(B, b), rtol=1e-9, atol=1e-9)
    assert_allclose(cholesky(A), np.linalg.cholesky(A), rtol=1e-9, atol=1e-12)


def test_arguments_stay_as_they_are():
    A, b = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([1.0, 2.0])
    for argument in (A, b):
        argument.setflags(write=False)
    solve(A, b)
    cholesky(A)
    assert_allclose(A, [[4.0, 1.0], [1.0, 3.0]])
    assert_allclose(b, [1.0, 2.0])


def test_what_has_no_answer_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(np.diag([1.0, -1.0]))
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 2)), np.ones(2))
