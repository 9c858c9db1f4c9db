"""Statistics of vehicles' episodes in a batch."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import coopenv
from coopenv.api.vector_env import RecordVehicleEpisodes, TrueEnds
from tests.helpers.episodes import first_episodes
from tests.helpers.four_way import FOUR_WAY

DECISIONS = 60
OPTIONS = {"num_worlds": 6, "overrides": {"horizon": DECISIONS / 10}}


def actions_of(env: coopenv.CooperativeVectorEnv) -> np.ndarray:
    """Return wide turns, which end against a wall or at the horizon."""
    return np.column_stack([np.ones(env.num_envs), np.linspace(0.0, 0.5, env.num_envs)]).astype(np.float32)


@pytest.mark.parametrize("autoreset", ["next_step", "same_step", "disabled"])
def test_true_episodes_only(autoreset: str) -> None:
    plain = coopenv.make_vec(FOUR_WAY, autoreset="disabled", **OPTIONS)
    returned, length, _ = first_episodes(plain, 5, DECISIONS, lambda observation: actions_of(plain))
    assert length.min() < DECISIONS and length.max() == DECISIONS
    env = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, autoreset=autoreset, **OPTIONS), buffer_length=1000)
    env.reset(seed=5)
    weights = env.unwrapped.scenario.reward.by_name
    first_return, first_length = np.full(env.num_envs, np.nan), np.zeros(env.num_envs)
    for _ in range(2 * DECISIONS + 2):
        _, _, terminated, truncated, infos = env.step(actions_of(env.unwrapped))
        if "episode" in infos:
            of, told = infos["_episode"], infos["episode"]
            fresh = of & np.isnan(first_return)
            first_return[fresh], first_length[fresh] = told["r"][fresh], told["l"][fresh]
            weighted = sum(weights[name] * total for name, total in told["reward_terms"].items())
            assert weighted[of] == pytest.approx(told["r"][of], abs=1e-3)
            assert not told["r"][~of].any()
        over = env.unwrapped.world_major(terminated | truncated).all(axis=1)
        if autoreset == "disabled" and over.any():
            env.reset(options={"reset_mask": over})
    assert first_return == pytest.approx(returned, abs=1e-3)
    assert np.array_equal(first_length, length)
    assert env.episode_count == len(env.return_queue) >= 2 * env.num_envs
    assert max(env.length_queue) == DECISIONS and min(env.length_queue) > 0


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_statistics_of_gymnasium_are_true_over_true_ends(autoreset: str) -> None:
    if autoreset == "same_step" and tuple(map(int, gymnasium.__version__.split(".")[:2])) < (1, 4):
        pytest.skip("the wrapper of older Gymnasium loses the first reward after a reset in this mode")
    own = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, autoreset=autoreset, **OPTIONS), buffer_length=1000)
    env = RecordEpisodeStatistics(TrueEnds(own), buffer_length=1000, stats_key="gymnasium")
    env.reset(seed=5)
    for _ in range(2 * DECISIONS + 2):
        _, _, terminated, truncated, infos = env.step(actions_of(env.unwrapped))
        if "final_obs" in infos:
            assert np.array_equal(infos["_final_obs"], terminated | truncated)
    assert env.episode_count == own.episode_count >= 2 * env.num_envs
    assert list(env.return_queue) == pytest.approx(list(own.return_queue), abs=1e-3)


def test_a_reset_begins_anew() -> None:
    env = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, **OPTIONS))
    env.reset(seed=5)
    for _ in range(7):
        env.step(np.zeros((env.num_envs, 2), np.float32))
    env.reset()
    for _ in range(DECISIONS):
        *_, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
    assert set(infos["episode"]["l"][infos["_episode"]]) == {DECISIONS}


def test_tensors_are_refused() -> None:
    pytest.importorskip("torch", reason="needs the extra 'train'")
    with pytest.raises(coopenv.CoopenvError, match=r"needs NumPy arrays: make_vec\(arrays='numpy'\)"):
        RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, arrays="torch", **OPTIONS))
