"""What Stable-Baselines3 counts as an episode is one, and nothing else is learnt from."""

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
from stable_baselines3.common.vec_env import VecMonitor

import coopenv
from coopenv.api.trainers.sb3 import ActingRowsBuffer, make_sb3_vec_env
from tests.helpers.episodes import first_episodes
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)
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


def test_dict_observations_drive_a_policy_with_several_inputs() -> None:
    env = make_sb3_vec_env(FOUR_WAY, num_worlds=2, observation="dict", overrides={"horizon": 1.0})
    model = PPO("MultiInputPolicy", env, n_steps=16, batch_size=64, n_epochs=1, device="cpu")
    model.learn(256)
    assert model.num_timesteps >= 256


def test_options_that_it_chooses_itself() -> None:
    with pytest.raises(coopenv.CoopenvError, match="chooses autoreset itself"):
        make_sb3_vec_env(FOUR_WAY, num_worlds=1, autoreset="disabled")
    assert make_sb3_vec_env(FOUR_WAY, num_worlds=1, observer="robust").scenario.observer.name == "robust"
