"""Planar filters side by side: splitting, deciding, merging."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from coopenv.observers.planar.filter import Mixture
from coopenv.observers.planar.model import CALIBRATING, DRIFT, HEADING, TURN_SCALE, X, Y

ONE_KIND = replace(CALIBRATING, drifting=(0.0, 0.0))
DT = 0.05
POSTS = ((3.0, 0.0), (0.0, 3.0), (-2.0, -2.0))


def test_parts_have_nearly_the_mean_and_the_covariance_of_the_whole():
    own = Mixture(ONE_KIND, np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.09, 0.8**2]))
    own.filters[0].covariance[HEADING, TURN_SCALE] = own.filters[0].covariance[TURN_SCALE, HEADING] = 0.15
    state, covariance = own.state.copy(), own.covariance.copy()
    own.split()
    assert len(own.filters) == 3
    np.testing.assert_allclose(own.state, state, atol=1e-9)
    scale = np.sqrt(np.outer(covariance.diagonal(), covariance.diagonal())) + 1e-12
    np.testing.assert_allclose(own.covariance / scale, covariance / scale, atol=0.06)
    scales = [one.state[TURN_SCALE] for one in own.filters]
    assert scales[0] < scales[1] < scales[2]  # each with the wheels that led there


@pytest.mark.parametrize("heading", [-2.0, 0.3, 2.5])
def test_bearings_decide_between_headings(heading):
    """Start with any heading; the odometry tells a path, the camera four landmark bearings a second."""
    rng = np.random.default_rng(5)
    own = Mixture(ONE_KIND, np.zeros(3), np.diag([0.01, 0.01, 2.0**2]))
    x, y = 0.0, 0.0
    for k in range(200):
        own.advance(DT, 0.0, 0.1 * DT)
        own.split()
        if k > 8:  # by then it drives
            x, y = x + 0.1 * DT * math.cos(heading), y + 0.1 * DT * math.sin(heading)
        if k % 5 == 0:
            px, py = POSTS[k // 5 % 3]
            bearing = math.atan2(py - y, px - x) - heading + 0.02 * rng.standard_normal()
            own.landmark((bearing + math.pi) % (2 * math.pi) - math.pi, px, py)
    assert len(own.filters) == 1
    assert abs((own.state[HEADING] - heading + math.pi) % (2 * math.pi) - math.pi) < 0.1
    assert math.hypot(own.state[X] - x, own.state[Y] - y) < 0.15


@pytest.mark.parametrize("drift", [0.0, 0.02])
def test_the_kind_of_odometry_is_found_out(drift):
    rng = np.random.default_rng(6)
    own, heading = Mixture(CALIBRATING, np.zeros(3), np.diag([1e-4, 1e-4, 1e-4])), 0.0
    for k in range(4000):
        own.advance(DT, 0.0, 0.0)
        heading += drift * DT
        if k % 5 == 0:
            own.landmark(
                (1.0 - heading + 0.02 * rng.standard_normal() + math.pi) % (2 * math.pi) - math.pi, 540.0, 841.0
            )
    assert len(own.filters) == 1
    assert own.state[DRIFT] == pytest.approx(drift, abs=0.003)
