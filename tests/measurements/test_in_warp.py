"""Kinds of measurements in kernels compute what the same kinds in NumPy compute."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose

from coopenv import CoopenvError
from coopenv.measurements.in_warp import excess, plus_noise
from coopenv.measurements.kinds import Kind, Placed, WarpFunctions, exponential
from coopenv.measurements.sensor import kind_of, number_of
from coopenv.measurements.table import KINDS
from tests.helpers.doppler import derive_doppler, predict_doppler
from tests.helpers.warp_calls import DTYPES, Calls

OWN = "tests.helpers.doppler:DopplerInWarp"
MADE: dict[str, Kind] = {name: kind_of(name) for name in (*KINDS, OWN)}
IN_WARP = {name: kind.in_warp for name, kind in MADE.items() if kind.in_warp is not None}
call = Calls(
    __name__,
    {
        **{functions.predict: "33 3 3 33 3 3 6 > 6" for functions in IN_WARP.values()},
        **{functions.sample: "6 6 3 > 6" for functions in IN_WARP.values()},
        **{functions.residual: "6 6 3 > 6" for functions in IN_WARP.values()},
        **{functions.jacobian: "33 3 3 33 3 3 > 66 66" for functions in IN_WARP.values()},
    },
)
TOLERANCE = {"float64": 1e-12, "float32": 1e-4}
PLACES = 200


def placed(seed: int) -> Placed:
    """Return places (PLACES,) some metres apart, in motion; every fourth has turned by almost half a turn."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(PLACES, 3))
    turn[::4] *= (np.pi - 1e-3) / np.linalg.norm(turn[::4], axis=-1, keepdims=True)
    velocity, angular_velocity = rng.normal(size=(2, PLACES, 3))
    return Placed(rng.uniform(-10.0, 10.0, (PLACES, 3)), exponential(turn), velocity, angular_velocity)


def padded(values: np.ndarray) -> np.ndarray:
    """Return values (..., size) as six numbers each."""
    return np.pad(values, [(0, 0), (0, 6 - values.shape[-1])])


def difference(kind: Kind, found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return the residual of values in the rows of their kind: near half a turn two vectors are one rotation."""
    return kind.residual(found[:, : kind.size], expected)


def test_every_shipped_kind_has_warp_functions() -> None:
    assert IN_WARP.keys() == {*KINDS, OWN}


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("dtype", DTYPES)
def test_prediction_in_warp_equals_the_kind_in_numpy(name: str, dtype: str) -> None:
    kind, own, target = MADE[name], placed(1), placed(2)
    poses = [part for of in (own, target) for part in (of.rotation, of.position, of.velocity)]
    found = call(IN_WARP[name].predict, dtype, *poses, np.zeros((1, 6)))
    assert_allclose(difference(kind, found, kind.predict(own, target)), 0.0, atol=TOLERANCE[dtype])
    assert not found[:, kind.size :].any()


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("dtype", DTYPES)
def test_noise_in_warp_acts_as_in_numpy(name: str, dtype: str) -> None:
    kind = MADE[name]
    predicted = kind.predict(placed(1), placed(2))
    noise = 0.1 * np.random.default_rng(3).normal(size=(PLACES, kind.rows))
    found = call(IN_WARP[name].sample, dtype, padded(predicted), padded(noise), np.zeros((1, 3)))
    assert_allclose(difference(kind, found, kind.sample(predicted, noise)), 0.0, atol=TOLERANCE[dtype])
    assert not found[:, kind.size :].any()


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("dtype", DTYPES)
def test_residual_in_warp_equals_the_kind_in_numpy(name: str, dtype: str) -> None:
    kind = MADE[name]
    predicted = kind.predict(placed(1), placed(2))
    value = kind.sample(predicted, 0.1 * np.random.default_rng(4).normal(size=(PLACES, kind.rows)))
    found = call(IN_WARP[name].residual, dtype, padded(value), padded(predicted), np.zeros((1, 3)))
    assert_allclose(found[:, : kind.rows], kind.residual(value, predicted), atol=TOLERANCE[dtype])
    assert not found[:, kind.rows :].any()


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_in_warp_equal_the_kind_in_numpy(name: str, dtype: str) -> None:
    kind, own, target = MADE[name], placed(1), placed(2)
    poses = [part for of in (own, target) for part in (of.rotation, of.position, of.velocity)]
    for found, expected in zip(call(IN_WARP[name].jacobian, dtype, *poses), kind.jacobian(own, target), strict=True):
        tolerance = max(TOLERANCE[dtype], 1e-8) if name == OWN else TOLERANCE[dtype]  # by differences
        assert_allclose(found[:, : kind.rows], expected, atol=tolerance)
        assert not found[:, kind.rows :].any()


@wp.func
def approaching(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the speed at which the distance shrinks, which is not what the class predicts."""
    return -predict_doppler(R, p, v, target_R, target_p, target_v, empty)


@wp.func
def without_turns(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return derivatives that forget that a turn turns the velocity."""
    own, target = derive_doppler(R, p, v, target_R, target_p, target_v)
    for column in range(3):
        own[0, column] = own.dtype(0.0)
    return own, target


@pytest.mark.parametrize(
    ("functions", "problem"),
    [
        (WarpFunctions(approaching, plus_noise, excess, derive_doppler), r"predict: entry \[0\] is -?\d.*, in NumPy"),
        (
            WarpFunctions(predict_doppler, plus_noise, excess, without_turns),
            r"jacobian: entry \[0, [012]\] is 0, in Num",
        ),
        (WarpFunctions(predict_doppler, plus_noise, excess, plus_noise), r"jacobian: TypeError: "),
        (WarpFunctions(predict_doppler, excess, excess, derive_doppler), r"sample: entry \[0\] is"),
    ],
)
def test_functions_in_warp_that_differ_from_the_class_are_named(functions: WarpFunctions, problem: str) -> None:
    kind = kind_of("tests.helpers.doppler:Doppler")
    kind.in_warp = functions
    with pytest.raises(CoopenvError, match=rf"^sensor 'tests\.helpers\.doppler:Doppler': in_warp: {problem}"):
        number_of("tests.helpers.doppler:Doppler", kind)


def test_a_class_with_functions_in_warp_that_agree_is_used() -> None:
    number = number_of(OWN, MADE[OWN])
    assert number >= len(KINDS) and number == number_of(OWN, MADE[OWN])
