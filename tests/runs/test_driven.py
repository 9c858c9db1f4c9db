"""Episodes of single vehicles: what the environment gives when it is stepped world by world, up to each one's end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.policies import load_agent
from coopenv.runs.dataset import drive_vehicles
from tests.helpers.four_way import FOUR_WAY

OVERRIDES: dict[str, Any] = {"horizon": 8.0, "termination.after_arrival": "park"}


def follow(observations: np.ndarray) -> np.ndarray:
    """Full speed, and a turn that hits walls sooner or later."""
    return np.column_stack([np.ones(len(observations)), 0.3 * np.sign(observations[:, 0])])


def test_episodes_are_those_of_the_environment() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY, OVERRIDES)
    episodes = drive_vehicles(scenario, follow, 5, 2)
    assert [(e.world, e.vehicle) for e in episodes] == [(w, f"vehicle_{i + 1}") for w in range(2) for i in range(4)]
    env = coopenv.parallel_env(FOUR_WAY, overrides=OVERRIDES)
    for world in range(2):
        mine = {e.vehicle: e for e in episodes if e.world == world}
        observations, infos = env.reset(seed=5, options={"world": world})
        for name, episode in mine.items():
            assert np.array_equal(episode.observations[0], observations[name])
            assert episode.position_error[0] == pytest.approx(infos[name]["position_error"])
        step = 0
        while env.agents:
            actions = {name: follow(observations[name][None])[0].astype(np.float32) for name in env.agents}
            observations, rewards, terminated, truncated, infos = env.step(actions)
            for name, reward in rewards.items():
                episode = mine[name]
                assert np.array_equal(episode.observations[step + 1], observations[name])
                assert np.array_equal(episode.actions[step], actions[name])
                assert episode.rewards[step] == pytest.approx(reward)
                assert episode.terminations[step] == terminated[name] and episode.truncations[step] == truncated[name]
                assert (len(episode.rewards) == step + 1) == (terminated[name] or truncated[name])
            step += 1
    assert any(e.terminations[-1] for e in episodes) and any(e.truncations[-1] for e in episodes)


def test_lengths_agree_and_agents_drive() -> None:
    scenario = coopenv.load_scenario("facade")
    for episode in drive_vehicles(scenario, load_agent("route_follower", scenario), 0, 3):
        steps = len(episode.rewards)
        assert episode.observations.shape == (steps + 1, coopenv.parallel_env("facade").engine.layout.size)
        assert episode.actions.shape == (steps, 2) and episode.position_error.shape == (steps + 1,)
        assert not (episode.terminations | episode.truncations)[:-1].any()
        assert episode.terminations[-1] or episode.truncations[-1]


def test_prescribed_motion_has_no_episodes() -> None:
    with pytest.raises(CoopenvError, match="nothing to drive"):
        drive_vehicles(coopenv.load_scenario("busy_intersection"), follow, 0, 1)
