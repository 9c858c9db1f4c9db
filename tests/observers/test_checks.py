"""Invalid estimates and messages are refused in one line that names the field."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coopenv import CoopenvError
from coopenv.observers import Estimate, Message
from coopenv.observers.contract import check_estimate, check_message

POSE: dict[str, Any] = {"rotation": np.eye(3), "position": np.zeros(3)}
NO_LEVELS: list[Any] = [(np.nan, 1.0), (1.0, np.nan), (-1e-9, 1.0), (1.0, -np.inf), (1.0,), np.ones(3), "ab", (1j, 1.0)]
LOPSIDED = np.eye(6) + np.eye(6, k=1) * 1e-3


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"rotation": np.zeros((3, 3))}, "rotation is not orthogonal"),
        ({"rotation": np.eye(3) * (1 + 1e-5)}, "rotation is not orthogonal"),
        ({"rotation": np.eye(3) + np.eye(3, k=1) * 1e-5}, "rotation is not orthogonal"),
        ({"rotation": -np.eye(3)}, "rotation is a reflection"),
        ({"rotation": np.eye(3).astype(str)}, "rotation is not a finite array"),
        ({"position": [1.0, 2.0]}, r"position is not a finite array of shape \(3,\)"),
        ({"position": np.zeros(3, complex)}, "position is complex"),
        ({"covariance": -np.eye(6)}, "covariance is not positive semidefinite"),
        ({"covariance": np.diag([1.0, 1, 1, 1, 1, -1e-6])}, "covariance is not positive semidefinite"),
        ({"covariance": LOPSIDED}, "covariance is not symmetric"),
        ({"covariance": LOPSIDED.T}, "covariance is not symmetric"),
        ({"covariance": np.full((6, 6), np.nan)}, "covariance is not a finite array"),
        ({"covariance": np.eye(3)}, r"covariance is not a finite array of shape \(6, 6\)"),
        ({"coordinates": "left"}, "coordinates are 'left', not a member of Coordinates"),
        ({"covariance": 1e300 * np.eye(6)}, "covariance is not a finite array"),
        ({"position": np.full(3, 2**62)}, "with numbers up to"),
        ({"nis": float("nan"), "nis_dof": 2}, "nis is not finite"),
        ({"nis": 1.0, "nis_dof": -2}, "nis_dof negative"),
        *(({"protection_level": level}, "protection_level is not two numbers") for level in NO_LEVELS),
    ],
)
def test_invalid_estimates_are_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(CoopenvError, match=said):
        check_estimate(Estimate(**{**POSE, **fields}))


@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.floats(-8.0, 8.0))
def test_rotations_and_covariances_of_any_rank_and_size_are_estimates(seed: int, rank: int, size: float) -> None:
    generator = np.random.default_rng(seed)
    root = 10.0**size * generator.standard_normal((6, rank))
    R = Rotation.random(None, generator).as_matrix()
    check_estimate(Estimate(R, generator.standard_normal(3), root @ root.T))
    check_estimate(Estimate(R, np.zeros(3), protection_level=(np.inf, 10.0**size)))
    check_estimate(Estimate(R.astype(np.float32), [1, 2, 3]))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"position": np.array([0.0, np.nan, 0.0])}, "message: position is not a finite array"),
        ({"position": np.zeros(2)}, r"message: position .* of shape \(3,\)"),
        ({"position": np.zeros(3, complex)}, "message: position is complex"),
        ({"rotation": np.zeros(4)}, r"message: rotation .* of shape \(3, 3\)"),
        ({"covariance": np.eye(4)}, r"message: covariance .* of shape \(3, 3\) or \(6, 6\)"),
        ({"extra": {"me": np.array([object()])}}, "message: extra 'me' is no array of numbers"),
    ],
)
def test_invalid_messages_are_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(CoopenvError, match=said):
        check_message(Message(**fields))


def test_messages_of_both_sizes_and_any_numbers() -> None:
    check_message(Message())
    check_message(Message(np.zeros(3), np.eye(3), np.eye(3), {"ids": np.array([1, 2]), "late": np.array(np.nan)}))
    check_message(Message(np.zeros(3, np.float32), covariance=np.eye(6)))


@pytest.mark.parametrize("dtype", [float, np.float32, int])
def test_quantities_have_a_bound(dtype: type) -> None:
    """Beyond it products would overflow single precision; sums of squares of numbers within it may be large, too."""
    check_estimate(Estimate(np.eye(3), np.full(3, 1e9).astype(dtype), 1e18 * np.eye(6)))
    with pytest.raises(CoopenvError, match=r"position .* with numbers up to 1e\+09"):
        check_estimate(Estimate(np.eye(3), np.full(3, 2e9).astype(dtype)))
    with pytest.raises(CoopenvError, match=r"covariance .* with numbers up to 1e\+18"):
        check_message(Message(np.zeros(3), covariance=(np.eye(3) * 2e18).astype(dtype)))
