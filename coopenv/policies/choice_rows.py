"""Batches whose actions are letters of the alphabet of `Choices`, for learning with any library of discrete actions."""

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import batch_space

from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.base.errors import ActionError, CoopenvError
from coopenv.policies.base import decide, restart
from coopenv.policies.choices import Choices


class ChoiceRows(VectorWrapper):
    """Rows (world, vehicle) that choose a letter for half a second; a driver steers in between.

    A step is as many decisions as a letter is kept for. Reward and `infos["reward_terms"]` are their sums; flags, with
    `infos["alive"]`, are those of any of them. A world that is over stands until the end of the step and is then reset,
    as in Gymnasium's mode SAME_STEP: `infos["final_obs"]` and `infos["final_info"]` hold what the step has led to, for
    a vehicle that has ended the observation at its end.
    """

    def __init__(self, env: CooperativeVectorEnv, driver: Choices | None = None) -> None:
        """Wrap a batch of the autoreset mode `disabled`, with NumPy arrays and flat observations.

        Args:
            env: the batch.
            driver: what steers; None: a `Choices` of the batch's scenario.

        Raises:
            CoopenvError: the batch has another mode, or tensors.
        """
        super().__init__(env)
        if getattr(env, "autoreset_mode", None) != AutoresetMode.DISABLED or env.arrays != "numpy":
            raise CoopenvError("ChoiceRows resets worlds itself: make_vec(autoreset='disabled', arrays='numpy')")
        if not isinstance(env.single_observation_space, spaces.Box):
            raise CoopenvError("ChoiceRows reads flat observations: make_vec(observation='flat')")
        self.driver = driver or Choices(env.scenario)
        """The driver between two choices, with the alphabet."""
        self.single_action_space: Any = spaces.Discrete(len(self.driver.alphabet))
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes in all worlds."""
        observation, infos = self.env.reset(seed=seed, options=options)
        restart(self.driver, np.ones(self.num_envs, dtype=bool))
        return observation, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Follow the letters, (num_envs,) whole numbers of the alphabet, for `driver.kept` decisions.

        Raises:
            CoopenvError: no `reset` came before.
            ActionError: the letters have another shape, or one is none of the alphabet.
        """
        batch = cast(CooperativeVectorEnv, self.env.unwrapped)
        batch.engine.check_begun("ChoiceRows.step")
        letters, most = np.asarray(actions), len(self.driver.alphabet) - 1
        whole = letters.shape == (self.num_envs,) and letters.dtype.kind in "iu"
        if not whole or ((letters < 0) | (letters > most)).any():
            raise ActionError(f"expected ({self.num_envs},) whole numbers from 0 to {most}, one letter per row")
        self.driver.take(letters)
        rewards, terms, last = np.zeros(self.num_envs), dict[str, Any](), np.empty(0)
        observation = batch.engine.view("observation").reshape(self.num_envs, -1).copy()
        acted, terminated, truncated = (np.zeros(self.num_envs, dtype=bool) for _ in range(3))
        for _ in range(self.driver.kept):
            driven = decide(self.driver, observation, batch.scenario.action_size)
            observation, reward, ends, cut, infos = self.env.step(driven.astype(np.float32))
            last = np.where((terminated | truncated)[:, None], last, observation) if last.size else observation
            rewards += reward
            terms = {n: terms.get(n, 0.0) + infos["alive"] * part for n, part in infos["reward_terms"].items()}
            acted |= infos["alive"]
            terminated |= ends
            truncated |= cut & ~terminated
        infos = {**infos, "alive": acted, "reward_terms": terms}
        ended = terminated | truncated
        over = np.repeat(batch.engine.view("over") != 0, batch.vehicles)
        final = {"final_obs": last, "final_info": infos, "_final_obs": ended, "_final_info": ended}
        if over.any():
            observation, infos = self.env.reset(options={"reset_mask": over})
            restart(self.driver, over)
        return observation, rewards, terminated, truncated, {**infos, **(final if ended.any() else {})}
