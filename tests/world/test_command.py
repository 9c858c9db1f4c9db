"""Commands in SI units: what an action asks for, with the limits of the vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.helpers.builders import command, scenario, start, vehicle

MAX_STEERING = 0.6981317007977318


def asked(actions: list[tuple[float, float]], **sections: Any) -> np.ndarray:
    """Return (speed m/s, steering rad, acceleration m/s^2) that each action asks of a default car."""
    world = start(scenario([vehicle(motion={"kind": "driven"})], **sections))
    rows = []
    for action in actions:
        command(world, action)
        world.decide()
        rows.append(world.view("command")[0, 0].copy())
    return np.array(rows)


def test_the_first_entry_spans_the_speeds() -> None:
    rows = asked([(-1.0, 0.0), (0.0, 0.5), (1.0, -1.0), (7.0, -7.0)])
    assert_allclose(rows[:, 0], [0.0, 0.765, 1.53, 1.53])
    assert_allclose(rows[:, 1], np.array([0.0, 0.5, -1.0, -1.0]) * MAX_STEERING)
    assert_allclose(rows[:, 2], 2.0)
    both_ways = asked([(-1.0, 0.0), (0.0, 0.0), (0.5, 0.0)], dynamics={"reverse": True, "max_speed": 2.0})
    assert_allclose(both_ways[:, 0], [-2.0, 0.0, 1.0])


def test_or_the_acceleration_towards_a_limit() -> None:
    rows = asked([(0.25, 0.0), (-0.5, 0.0), (0.0, 0.0)], action={"longitudinal": "acceleration"})
    assert_allclose(rows[:, 0], [1.53, 0.0, 1.53])
    assert_allclose(rows[:, 2], [0.5, 1.0, 0.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_counts_as_zero(bad: float) -> None:
    assert_allclose(asked([(bad, bad)]), asked([(0.0, 0.0)]))
