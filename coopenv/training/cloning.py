"""A start from another driver: its actions and its returns, learnt by regression. Needs the extra `train`."""

from collections.abc import Callable

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from coopenv.api.terms.layout import action_fields
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.policies import decide, load_agent, restart
from coopenv.training.normalised import NormalisedEnv
from coopenv.training.settings import Clone

BATCH = 512  # rows per gradient step


def clone(
    policy: ActorCriticPolicy,
    env: NormalisedEnv,
    settings: Clone,
    gamma: float,
    reward_scale: float,
    seed: int,
    tell: Callable[[str], None] = lambda line: None,
) -> None:
    """Fit the mean action to what a driver does, and the value to the discounted rewards that follow.

    What it saw also becomes the first of the statistics by which observations are normalised. The noise that is added
    to its actions shows how it mends deviations (Laskey et al. 2017).

    Args:
        policy: to be fitted.
        env: whose statistics are to be filled.
        settings: whom to watch, and for how long.
        gamma: discount per decision.
        reward_scale: of the rewards that the value is to predict.
        seed: of the worlds, the noise and the order of rows.
        tell: called with what is being done, and how far it is.
    """
    raw, actions, returns = watch(env.venv.envs, settings, gamma, seed, tell)
    env.statistics.update(raw)
    observations = torch.from_numpy(env.normalise(raw))
    targets = torch.from_numpy(actions.astype(np.float32))
    values = torch.from_numpy((reward_scale * returns).astype(np.float32))
    optimiser = torch.optim.Adam(policy.parameters(), settings.learning_rate)
    shuffle = torch.Generator().manual_seed(seed)
    for epoch in range(settings.epochs):
        tell(f"learning from {settings.agent}: pass {epoch + 1} of {settings.epochs}")
        for rows in torch.randperm(len(observations), generator=shuffle).split(BATCH):
            latent_policy, latent_value = policy.mlp_extractor(observations[rows])
            action_error = policy.action_net(latent_policy) - targets[rows]
            value_error = policy.value_net(latent_value).squeeze(-1) - values[rows]
            loss = (action_error**2).mean() + (value_error**2).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


def watch(
    like: CooperativeVectorEnv, settings: Clone, gamma: float, seed: int, tell: Callable[[str], None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations (rows, D), the driver's actions (rows, A), and the discounted returns from there (rows,)."""
    scenario = like.scenario
    env = CooperativeVectorEnv(
        scenario, "clone", num_worlds=settings.episodes, autoreset="disabled", threads=like.engine.world.threads
    )
    driver, noise = load_agent(settings.agent, scenario), np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    restart(driver, np.ones(env.num_envs, dtype=bool))
    under_way = np.ones(env.num_envs, dtype=bool)
    steps: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    while under_way.any():
        tell(f"watching {settings.agent}: {len(steps) / scenario.rates.decision:.0f} of {scenario.horizon:g} s")
        action = decide(driver, observation, len(action_fields(scenario)))
        tried = np.clip(action + settings.noise * noise.standard_normal(action.shape), -1.0, 1.0)
        before, acted = observation, under_way
        observation, reward, terminated, truncated, _ = env.step(tried.astype(np.float32))
        steps.append((before, action, np.where(acted, reward, 0.0), acted))
        under_way = acted & ~(terminated | truncated)
    env.close()
    observations, actions, rewards, acted = (np.stack(column) for column in zip(*steps, strict=True))
    returns, following = np.zeros_like(rewards), np.zeros(env.num_envs)
    for t in reversed(range(len(rewards))):
        returns[t] = following = rewards[t] + gamma * following
    return observations[acted], actions[acted], returns[acted]
