"""Stable-Baselines3 really trains on the batch; what it counts as an episode is one, and nothing else is learnt from.

Runs where the extra `train` is installed.
"""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import coopenv
from coopenv.api.trainers.sb3 import ActingRowsBuffer, make_sb3_vec_env
from coopenv.scenario.terms import REWARD_TERMS
from tests.helpers.env_suite import first_episodes
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)  # small networks: torch's threads and the batch's would only wait for one another


def test_ppo_trains_with_monitor_and_normalisation() -> None:
    env = VecNormalize(VecMonitor(make_sb3_vec_env(FOUR_WAY, num_worlds=8)))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=256, n_epochs=2, seed=0, device="cpu")
    model.learn(4096)
    assert model.num_timesteps >= 4096
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
    model.learn(28_000)
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
    with pytest.raises(coopenv.CoopenvError, match=r"unknown option 'dificulty' \(did you mean 'difficulty'"):
        env.reset()


def test_methods_reach_the_batch() -> None:
    env = make_sb3_vec_env("busy_intersection", num_worlds=2)
    assert env.get_attr("vehicles") == [5] * 10
    assert env.env_is_wrapped(Monitor) == [True] * 10  # its rows tell their episodes themselves
    assert env.env_is_wrapped(VecMonitor) == [False] * 10
    assert len(env.env_method("get_images")) == 10
    with pytest.raises(coopenv.CoopenvError, match="rows share one batch"):
        env.env_method("reset", indices=[0])


WORLDS, SEED, DECISIONS = 16, 3, 120
SHORT = {"horizon": DECISIONS / 10}


class AtSpeeds:
    """Straight on, each row at a speed of its own: some vehicles collide, some arrive, some are too slow for either."""

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        speeds = np.linspace(-1.0, 1.0, len(observation))
        return np.column_stack([speeds, np.zeros_like(speeds)]).astype(np.float32), None


@pytest.fixture(scope="module")
def by_hand() -> dict[str, np.ndarray]:
    """Return what one episode per vehicle comes to, stepped by hand: return, decisions, whether it arrived."""
    env = coopenv.make_vec(FOUR_WAY, num_worlds=WORLDS, autoreset="disabled", overrides=SHORT)
    returned, length, ended = first_episodes(env, SEED, DECISIONS, lambda rows: AtSpeeds().predict(rows)[0])
    assert 0.1 < (ended > 0).mean() < 1.0 and len(set(length)) > 5  # there are parked vehicles to be miscounted
    assert (ended == 1).any()
    return {"return": returned, "length": length, "arrived": ended == 1}


@pytest.mark.parametrize("monitored", [False, True])
@pytest.mark.filterwarnings("ignore:.*already wrapped with a `Monitor`")
def test_evaluate_policy_gives_the_true_return(monitored: bool, by_hand: dict[str, np.ndarray]) -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=WORLDS, overrides=SHORT, seed=SEED)
    returns, lengths = evaluate_policy(
        AtSpeeds(), VecMonitor(env) if monitored else env, env.num_envs, return_episode_rewards=True
    )
    assert sorted(returns) == pytest.approx(sorted(by_hand["return"]), abs=1e-3)
    assert monitored or sorted(lengths) == sorted(by_hand["length"])


def test_infos_at_the_end_of_an_episode() -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=WORLDS, overrides=SHORT, seed=SEED)
    weights = env.scenario.reward.by_name
    observation, seen = env.reset(), []
    for _ in range(DECISIONS):
        observation, _, dones, infos = env.step(AtSpeeds().predict(observation)[0])
        assert [bool(info) for info in infos] == dones.tolist()
        seen += [info for info in infos if info]
    assert len(seen) == env.num_envs  # one end per vehicle, and none for standing parked
    for info in seen:
        weighted = sum(weights[name] * total for name, total in info["reward_terms"].items())
        assert info["episode"]["r"] == pytest.approx(weighted, abs=1e-3)
        assert info["episode"]["l"] == pytest.approx(10 * info["time"], abs=1e-3)
        assert info["TimeLimit.truncated"] == (info["outcome"] == "under way")
        assert info["is_success"] == (info["outcome"] == "arrived")
    assert {"under way", "collided"} <= {info["outcome"] for info in seen}
    assert {"log_determinant", "gramian_min_eigenvalue", "position_error"} <= set(env.batch_infos)


def test_buffer_gives_rows_under_way_alone() -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=4, overrides=SHORT, seed=SEED)
    model = PPO(
        *("MlpPolicy", env),
        **{"n_steps": 160, "batch_size": 256, "n_epochs": 1, "seed": 0, "device": "cpu"},
        rollout_buffer_class=ActingRowsBuffer,
        rollout_buffer_kwargs={"rows": env},
    )
    model.learn(160 * env.num_envs)
    buffer = model.rollout_buffer
    assert 0 < (~buffer.acted).sum() < buffer.acted.size // 2
    assert not buffer.rewards[~buffer.acted].any()
    parts = list(buffer.get(256))
    assert sum(len(part.actions) for part in parts) == buffer.acted.sum()
    assert max(len(part.actions) for part in parts) - min(len(part.actions) for part in parts) <= 1
    kept = torch.cat([part.old_log_prob for part in parts]).sort().values
    acting = buffer.log_probs[buffer.swap_and_flatten(buffer.acted)]
    assert torch.equal(kept, torch.from_numpy(np.sort(acting)))


def test_with_a_team_reward_vehicles_that_have_ended_do_not_act() -> None:
    """Their episodes go on until the end of the world, but nothing that they do counts."""
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=2, overrides={"reward.team": "mean"}, seed=0)
    env.reset()
    actions = np.column_stack([np.ones(8), np.linspace(0.2, 0.5, 8)]).astype(np.float32)  # walls, one after another
    before, parked = np.zeros(8, dtype=bool), 0
    for _ in range(60):
        _, _, dones, _ = env.step(actions)
        assert np.array_equal(env.acted, ~before)
        ended, over = env.batch_infos["ended"] != 0, dones.reshape(2, 4).all(axis=1).repeat(4)
        parked += (before & env.batch_infos["alive"]).sum()
        before = ended & ~over
    assert parked > 20


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_go_on_alike_and_apart(duplicate: Any) -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=2, overrides={"horizon": 1.0}, seed=SEED)
    env.reset()
    actions = np.full((env.num_envs, 2), 0.3, np.float32)
    for _ in range(4):
        env.step(actions)
    other = duplicate(env)
    ours, theirs = ([each.step(actions) for _ in range(12)] for each in (env, other))
    for (*mine, my_infos), (*yours, your_infos) in zip(ours, theirs, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(mine, yours, strict=True))
        for info, twin in zip(my_infos, your_infos, strict=True):
            assert info.get("episode", {}).get("r") == twin.get("episode", {}).get("r")


@pytest.mark.parametrize("name", [FOUR_WAY, "crossing_path"])  # the second: one vehicle, which receives nothing
def test_dict_observations_drive_a_policy_with_several_inputs(name: str) -> None:
    env = make_sb3_vec_env(name, num_worlds=2, observation="dict", overrides={"horizon": 1.0})
    model = PPO("MultiInputPolicy", env, n_steps=16, batch_size=64, n_epochs=1, device="cpu")
    model.learn(256)
    assert model.num_timesteps >= 256


def test_options_that_it_chooses_itself() -> None:
    with pytest.raises(coopenv.CoopenvError, match="chooses autoreset itself"):
        make_sb3_vec_env(FOUR_WAY, num_worlds=1, autoreset="disabled")
    with pytest.raises(coopenv.CoopenvError, match=r"for a batch: CooperativeSB3VecEnv\(batch\)"):
        make_sb3_vec_env(coopenv.make_vec(FOUR_WAY, num_worlds=1))  # type: ignore[arg-type]
    assert make_sb3_vec_env(FOUR_WAY, num_worlds=1, observer="robust").scenario.observer.name == "robust"
