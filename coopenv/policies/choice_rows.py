"""Batches whose actions are letters of the alphabet of `Choices`, for learning with any library of discrete actions."""

from typing import Any

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

    A step is as many decisions as a letter is kept for. Its reward is their sum; `terminated` and `truncated` are those
    of any of them. A world that is over stands until the end of the step and is then reset, as in Gymnasium's mode
    SAME_STEP: `infos["final_obs"]` and `infos["final_info"]` hold what the step has led to.
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
        if env.autoreset_mode != AutoresetMode.DISABLED or env.arrays != "numpy":
            raise CoopenvError("ChoiceRows resets worlds itself: make_vec(autoreset='disabled', arrays='numpy')")
        self.driver = driver or Choices(env.scenario)
        """The driver between two choices, with the alphabet."""
        self.single_action_space: Any = spaces.Discrete(len(self.driver.alphabet))
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self._observation = np.empty(0)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes in all worlds."""
        self._observation, infos = self.env.reset(seed=seed, options=options)
        restart(self.driver, np.ones(self.num_envs, dtype=bool))
        return self._observation, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Follow the letters, (num_envs,) whole numbers of the alphabet, for `driver.kept` decisions.

        Raises:
            ActionError: the letters have another shape, or one is none of the alphabet.
        """
        letters, most = np.asarray(actions), len(self.driver.alphabet)
        if letters.shape != (self.num_envs,) or letters.dtype.kind not in "iu" or not self._are_letters(letters):
            raise ActionError(f"expected ({self.num_envs},) whole numbers from 0 to {most - 1}, one letter per row")
        self.driver.take(letters)
        rewards = np.zeros(self.num_envs)
        terminated, truncated = (np.zeros(self.num_envs, dtype=bool) for _ in range(2))
        for _ in range(self.driver.kept):
            driven = decide(self.driver, self._observation, self.env.single_action_space.shape[0])  # type: ignore[index]
            self._observation, reward, ends, cut, infos = self.env.step(driven.astype(np.float32))
            rewards += reward
            terminated |= ends
            truncated |= cut & ~terminated
        if (over := self._over()).any():
            final = {"final_obs": self._observation, "final_info": infos, "_final_obs": over, "_final_info": over}
            self._observation, infos = self.env.reset(options={"reset_mask": over})
            restart(self.driver, over)
            infos = {**infos, **final}
        return self._observation, rewards, terminated, truncated, infos

    def _are_letters(self, letters: np.ndarray) -> bool:
        return bool(((letters >= 0) & (letters < len(self.driver.alphabet))).all())

    def _over(self) -> np.ndarray:
        """Return flags (num_envs,) of the rows whose world is over."""
        batch: Any = self.env.unwrapped
        return np.repeat(batch.engine.view("over") != 0, batch.vehicles)
