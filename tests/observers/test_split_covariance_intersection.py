"""Split covariance intersection covers every correlation of the dependent parts, and is exact where there is none."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from coopenv.observers import run
from coopenv.observers.covariance_intersection import best_split_weight
from tests.observers.test_filters import kalman, spd
from tests.oracles.batch import small_record


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_it_is_consistent_for_any_correlation_of_the_dependent_parts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale = np.diag(10.0 ** rng.uniform(-1, 1, 9))
    joint = scale @ spd(rng, 9) @ scale  # of both dependent parts, correlated in any way
    P_d, C, X = joint[:6, :6], joint[6:, 6:], joint[:6, 6:]
    P_i, variance = 10.0 ** rng.uniform(-2, 2) * spd(rng, 6), 10.0 ** rng.uniform(-1, 1)
    own = variance * np.eye(2)
    H, G = rng.normal(size=(2, 6)), rng.normal(size=(2, 3))
    R_d = G @ C @ G.T
    w = best_split_weight(P_d, P_i, H, R_d + own, variance)
    if w == 1.0:
        return
    P_1, P_2 = P_d / w + P_i, R_d / (1 - w) + own
    _, claimed, _ = kalman(P_1, H, P_2, np.zeros(2))
    K = P_1 @ H.T @ np.linalg.inv(H @ P_1 @ H.T + P_2)
    A, B = np.eye(6) - K @ H, K @ G
    true = A @ (P_d + P_i) @ A.T + B @ C @ B.T - A @ X @ B.T - B @ X.T @ A.T + K @ own @ K.T
    assert np.linalg.eigvalsh(claimed - true).min() > -1e-9 * np.trace(claimed)
    assert np.linalg.slogdet(claimed)[1] < np.linalg.slogdet(P_d + P_i)[1]


def test_without_dependent_parts_it_is_the_kalman_filter() -> None:
    """The first time that a follower hears its leader, nothing of its own is shared: w goes to its least."""
    rng = np.random.default_rng(0)
    P, H, R_d = spd(rng, 6), rng.normal(size=(2, 6)), spd(rng, 2)
    w = best_split_weight(np.zeros((6, 6)), P, H, R_d + np.eye(2), 1.0)
    assert_allclose(R_d / (1 - w), R_d, rtol=0.03)
    made = small_record(1)
    split, plain = run("split_covariance_intersection", made), run("mekf_covariance", made)
    assert_allclose(split.covariance[-1, 1], plain.covariance[-1, 1], rtol=0.03, atol=1e-12)


def test_it_knows_no_less_than_where_all_is_dependent() -> None:
    """After some frames of the same leader it claims more than plain intersection and less than what counts twice."""
    made = small_record(6)
    split, plain, naive = (
        np.linalg.slogdet(run(name, made).covariance[-1, 1])[1]
        for name in ("split_covariance_intersection", "covariance_intersection", "mekf_covariance")
    )
    assert naive < split < plain + 0.05
