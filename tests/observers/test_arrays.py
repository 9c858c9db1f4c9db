"""The table of arrays decides what a tick may lack, and which rows are read."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from coopenv import CoopenvError
from coopenv.observers.arrays import ARRAYS
from coopenv.observers.contract import SensorNoise
from coopenv.observers.recording import Recording
from coopenv.observers.sensed import Sensed, check_tick

MEASURED_ITSELF = {
    *("rotation", "translation", "velocity", "angular_velocity", "bearings", "pan"),
    *("odometry_age", "bearing_age"),
}
"""Arrays of numbers that a vehicle measures itself; a row of a missing vehicle is not read."""
NUMBERS = [name for name, spec in ARRAYS.items() if spec.axes.startswith("KN") and spec.kind != "b" and "." not in name]


@pytest.fixture
def recording() -> Recording:
    standing = np.zeros((2, 2, 3))
    return Recording.from_arrays(
        dt=0.1,
        landmarks=np.array([[5.0, 0.0, 0.0]]),
        velocity=standing,
        angular_velocity=standing,
        bearings=np.full((2, 2, 3, 3), np.nan),
        noise=SensorNoise(velocity=0.1, angular_velocity=0.1, odometry_period=0.1, bearing=0.01),
        start_position=np.zeros((2, 3)),
        start_rotation=np.tile(np.eye(3), (2, 1, 1)),
    )


def whole(recording: Recording) -> Sensed:
    """Return a tick that has every array."""
    tick = recording.at(1)
    optional = {name: tick.filled(name) for name, spec in ARRAYS.items() if spec.optional is not None}
    return replace(tick, **optional)


@pytest.mark.parametrize("name", NUMBERS)
def test_the_row_of_a_missing_vehicle_is_not_read_where_it_measures_itself(name: str, recording: Recording) -> None:
    tick: Any = whole(recording)
    wrong = np.array(getattr(tick, name))
    wrong[1] = -7 if wrong.dtype.kind == "i" else -1e300
    if name == "bearings":
        wrong[0] = [1.0, 0.0, 0.0]
        tick = replace(tick, visible=np.ones((2, 3), bool))
    missing = np.array([False, True])
    tick = replace(tick, **{name: wrong, "missing": missing})
    if name in MEASURED_ITSELF:
        check_tick(tick, 1, recording.observer_init)
        tick = replace(tick, missing=~missing)
    with pytest.raises(CoopenvError, match=f"tick 1: {name} of vehicle_2"):
        check_tick(tick, 1, recording.observer_init)


@pytest.mark.parametrize("name", [name for name, spec in ARRAYS.items() if spec.optional is not None])
def test_an_absent_array_reads_as_the_value_that_stands_for_it(name: str, recording: Recording) -> None:
    tick = recording.at(1)
    check_tick(tick, 1, recording.observer_init)
    assert getattr(tick, name) is None and name not in tick.measured()
    filled = tick.filled(name)
    assert_array_equal(filled, np.zeros(2))
    assert filled.dtype.kind == ARRAYS[name].kind
    assert_array_equal(whole(recording).filled(name), filled)
