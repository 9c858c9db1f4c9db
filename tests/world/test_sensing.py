"""The key `sensing`: measurements change, all else stays."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv.estimation.outcomes import Sight
from tests.helpers.builders import same_bits, simulate
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES

WORLDS, DECISIONS = 6, 60
OF_TRUTH_AND_RADIO = (
    *("rotation", "position", "velocity", "speed", "steering", "ended", "collided", "odometry_scale", "gyro_bias"),
    *("increment_rotation", "increment_translation", "odometry_velocity", "inbox_tick", "outbox_tick"),
)
ERRORS = {"noise.odometry_scale": 0.03, "noise.gyro_bias": 0.01}


@cache
def driven(sensing: str, dtype: str = "float64") -> list[dict[str, np.ndarray]]:
    """Return the state after each decision under the same actions; the camera misses, and is bounded by its image."""
    scenario = coopenv.load_scenario(FOUR_WAY, {"sensing": sensing, "camera.miss_probability": 0.3, **ERRORS})
    world = simulate(scenario, WORLDS, dtype)
    world.reset(range(WORLDS))
    generator = np.random.default_rng(2)
    states = [world.get_state()]
    for _ in range(DECISIONS):
        world.actions.assign(generator.uniform(-0.5, 1.0, (WORLDS, 4, 2)).astype(world.precision.numpy))
        world.advance(scenario.ticks_per_decision)
        states.append(world.get_state())
    return states


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sensing", ["ideal", "blind"])
def test_truth_odometry_and_radio_stay_bit_for_bit(sensing: str, dtype: str) -> None:
    for sensed, other in zip(driven("sensed", dtype), driven(sensing, dtype), strict=True):
        for name in OF_TRUTH_AND_RADIO:
            assert same_bits(sensed[name], other[name]), name
    last = driven("sensed", dtype)[-1]
    assert (last["ended"] != 0).any() and (last["inbox_tick"] > 0).any()
    assert not same_bits(last["estimate_position"], driven(sensing, dtype)[-1]["estimate_position"])


def test_ideal_measures_every_neighbour_and_blind_none() -> None:
    neighbours = np.array([[n < 12 + i for n in range(16)] for i in range(4)])
    seen = {s: np.array([state["sight"] == Sight.VISIBLE for state in driven(s)]) for s in ("sensed", "ideal", "blind")}
    assert (seen["ideal"] == neighbours).all()
    assert not seen["blind"].any()
    assert 0.02 < seen["sensed"].mean() / seen["ideal"].mean() < 0.5
    assert (driven("blind")[-1]["bearing_tick"] == -1).all()


def test_what_is_sensed_anyway_has_the_same_noise() -> None:
    """Bearings that both measure are equal, noise and all; the others have noise of the same size."""
    misfit = []
    for sensed, ideal in zip(driven("sensed"), driven("ideal"), strict=True):
        both = sensed["sight"] == Sight.VISIBLE
        assert_allclose(ideal["bearing"][both], sensed["bearing"][both], atol=1e-12)
        misfit.append(_deviations(ideal)[(ideal["sight"] == Sight.VISIBLE) & ~both])
    angle = np.concatenate(misfit)
    assert np.sqrt(np.mean(angle**2) / 2) == pytest.approx(0.003, rel=4 / np.sqrt(2 * len(angle)))


def _deviations(state: dict[str, np.ndarray]) -> np.ndarray:
    """Return the angles (W, N, A) between measured and true bearings, rad."""
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    scenario = coopenv.load_scenario(FOUR_WAY)
    markers = np.array([agent.marker for agent in (*scenario.landmarks, *scenario.vehicles)])
    R, position = state["rotation"], state["position"]
    point = position + np.einsum("waij,aj->wai", R, markers)
    eye = position[:, 12:] + R[:, 12:] @ np.array(scenario.camera.position)
    line = point[:, None] - eye[:, :, None]
    ray = np.einsum("wnji,wnaj->wnai", R[:, 12:] @ forward, line)
    ray /= np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9)
    return np.arcsin(np.minimum(np.linalg.norm(np.cross(ray, state["bearing"]), axis=-1), 1.0))
