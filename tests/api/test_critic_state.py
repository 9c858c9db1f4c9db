"""The state for a central critic, against infos, observations and spaces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import coopenv
from tests.helpers.four_way import FOUR_WAY


def drive(env: Any, steps: int) -> Any:
    """Return observations and infos after steps of the same action; vehicles that end are left out."""
    observations, infos = env.reset(seed=4)
    for _ in range(steps):
        actions = {agent: np.full(env.action_space(agent).shape, 0.2, np.float32) for agent in env.agents}
        observations, _, _, _, infos = env.step(actions)
    return observations, infos


@pytest.mark.parametrize("name", ["open_square", FOUR_WAY])
def test_the_state_holds_the_values_of_infos(name: str) -> None:
    env = coopenv.parallel_env(name)
    observations, infos = drive(env, 12)
    scales, state = env.scenario.observation, env.state()
    axes, count = (2, 88) if name == "open_square" else (3, 132)
    width = count + {2: 12, 3: 20}[axes]
    for i, agent in enumerate(env.agents):
        found, info = state[i * width : (i + 1) * width], infos[agent]
        truth, error = info["truth"], info["estimate"]["position"] - info["truth"]["position"]
        expected = [
            truth["position"][:axes] / scales.position_scale,
            *(truth["rotation"][:axes, column] for column in range(axes - 1)),
            truth["velocity"][: 1 if axes == 2 else 3] / scales.velocity_scale,
            error[:axes],
            np.radians([info["orientation_error"]]),
            [(np.log10(info["position_std"]) + 1.25) / 1.5],
        ]
        assert_array_equal(found[:count], observations[agent])
        assert_allclose(found[count:-3], np.concatenate(expected), atol=2e-6)
        assert_array_equal(found[-2:], [1.0, 0.0])
    assert state[-1] == pytest.approx(1.2 / env.scenario.horizon)
    landmarks = len(env.scenario.landmarks) if name == "open_square" else 0  # those of the four-way crossing are fixed
    assert len(state) == 4 * width + 3 * landmarks + 1


@pytest.mark.parametrize("name", ["open_square", "urban_crossing", "take_turns", "busy_intersection"])
def test_worlds_of_a_batch(name: str) -> None:
    """In bounds, and the same as that of single worlds, absent vehicles included."""
    batch = coopenv.make_vec(name, num_worlds=3)
    batch.reset(seed=4)
    for _ in range(12):
        batch.step(np.full((batch.num_envs, *batch.single_action_space.shape), 0.2, np.float32))
    for world, state in enumerate(batch.state()):
        env = coopenv.parallel_env(name)
        env.reset(seed=4, options={"world": world})
        for _ in range(12):
            env.step({agent: np.full(env.action_space(agent).shape, 0.2, np.float32) for agent in env.agents})
        assert env.state_space.contains(env.state())
        assert_array_equal(env.state(), state)


def test_values_beyond_observations_vary() -> None:
    """Over worlds and times: truth, errors and ways of every vehicle, and the positions of drawn landmarks."""
    batch = coopenv.make_vec("open_square", num_worlds=24)
    batch.reset(seed=0)
    rows, random = [batch.state()], np.random.default_rng(0)
    for _ in range(60):
        batch.step(random.uniform(-1, 1, (batch.num_envs, 2)).astype(np.float32))
        rows.append(batch.state())
    states = np.concatenate(rows)
    varies, width = states.std(axis=0) > 1e-3, 88 + 12
    assert np.abs(states).max() < 3.0
    assert varies[: 4 * width].reshape(4, width)[:, 88:-2].all()
    assert varies[4 * width : 4 * width + 2 * 28].all() and varies[-1]


def test_the_rest_of_the_way() -> None:
    env = coopenv.parallel_env("open_square")
    env.reset(seed=1)
    before = env.state()
    for _ in range(5):
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    gained = (before - env.state())[88 + 9] * env.scenario.observation.position_scale
    assert 0.1 < gained < 0.3  # of 0.5 s at 0.4 to 0.5 m/s
