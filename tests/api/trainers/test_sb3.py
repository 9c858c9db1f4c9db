"""Stable-Baselines3 really trains on the batch. Runs where the extra `train` is installed."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import coopenv
from coopenv import CoopenvError
from coopenv.api.trainers.sb3 import make_sb3_vec_env
from coopenv.scenario.terms import REWARD_TERMS
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)  # small networks: torch's threads and the batch's would only wait for one another


def test_ppo_trains_with_monitor_and_normalisation() -> None:
    env = VecNormalize(VecMonitor(make_sb3_vec_env(FOUR_WAY, num_worlds=8)))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=256, n_epochs=2, seed=0, device="cpu")
    model.learn(8192)
    assert model.num_timesteps >= 8192
    assert len(model.ep_info_buffer) > 0
    assert np.isfinite(env.obs_rms.mean).all()


def test_time_limit_is_not_learnt_as_a_death() -> None:
    """Reward 1 per step for ever, cut off after 10 steps: the value is that of going on, 1 / (1 - gamma) = 20."""
    overrides = {
        "horizon": 1.0,
        "reward.weights": {**dict.fromkeys(REWARD_TERMS.built_in, 0.0), "time": -10.0},
        "reward.privileged": False,
        "observation.include": ["odometry"],  # nothing that tells the time left
        "termination": {"collision": False, "arrival": False},
    }
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=16, overrides=overrides)
    model = PPO(
        "MlpPolicy", env, gamma=0.95, n_steps=40, batch_size=640, n_epochs=10, learning_rate=3e-3, seed=1, device="cpu"
    )
    model.learn(40_000)
    observation = env.reset()
    values = model.policy.predict_values(model.policy.obs_to_tensor(observation)[0]).detach().numpy()
    # learnt as a death the value would be the mean of the returns to come within 10 steps, below 6
    assert 15.0 < values.mean() < 25.0


def test_terminal_observations_and_flags() -> None:
    env = make_sb3_vec_env("busy_intersection", num_worlds=2, overrides={"horizon": 0.5}, seed=3)
    twin = coopenv.make_vec("busy_intersection", num_worlds=2, overrides={"horizon": 0.5}, autoreset="disabled")
    assert np.array_equal(env.reset(), twin.reset(seed=3)[0])
    zero = np.zeros((env.num_envs, 2), dtype=np.float32)
    for step in range(1, 12):
        observation, reward, done, infos = env.step(zero)
        expected = twin.step(zero)
        assert np.array_equal(reward, expected[1])
        assert done.all() == (step % 5 == 0)
        if done.all():
            assert all(info["TimeLimit.truncated"] for info in infos)
            assert np.array_equal([info["terminal_observation"] for info in infos], expected[0])
            assert np.array_equal(observation, twin.reset()[0])
        else:
            assert np.array_equal(observation, expected[0])
            assert infos == [{}] * env.num_envs


def test_seeding() -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=3)
    env.seed(7)
    first = env.reset()
    second = env.reset()
    env.seed(7)
    assert np.array_equal(env.reset(), first)
    assert not np.array_equal(first, second)


def test_options_of_a_reset_count_once_and_its_settings_hold() -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=2, overrides={"difficulty.v2x_loss": [0.0, 2.0]})
    env.set_options({"difficulty": "hard", "parameters": {"camera_range": np.array([0.5, 0.75])}})
    for _ in range(2):
        env.reset()
        np.testing.assert_allclose(env.envs.engine.view("parameter")[:, 0], [0.5, 0.75])
        np.testing.assert_allclose(env.envs.engine.view("difficulty"), 1.0)
    env.set_options({"dificulty": 1})
    with pytest.raises(CoopenvError, match=r"unknown option 'dificulty' \(did you mean 'difficulty'"):
        env.reset()


def test_methods_reach_the_batch() -> None:
    env = make_sb3_vec_env("busy_intersection", num_worlds=2)
    assert env.get_attr("vehicles") == [5] * 10
    assert env.env_is_wrapped(Monitor) == [True] * 10  # its rows tell their episodes themselves
    assert env.env_is_wrapped(VecMonitor) == [False] * 10
    assert len(env.env_method("get_images")) == 10
    with pytest.raises(coopenv.CoopenvError, match="rows share one batch"):
        env.env_method("reset", indices=[0])
