"""Observations by their running mean and standard deviation, and scaled rewards. Needs the extra `train`."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnvWrapper

from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv

LEAST_VARIANCE = 1e-4
"""Added to variances: what hardly ever changes is not blown up to the size of the rest."""


class NormalisedEnv(VecEnvWrapper):
    """What a policy learns from: normalised observations of vehicles under way, rewards of order one.

    Unlike SB3's `VecNormalize` it leaves parked vehicles out of the statistics and is saved without pickle. Returns in
    `info["episode"]` stay in the units of the scenario.
    """

    venv: CooperativeSB3VecEnv

    def __init__(self, venv: CooperativeSB3VecEnv, clip: float, reward_scale: float) -> None:
        """Wrap a batch; `clip` in standard deviations."""
        shape = venv.observation_space.shape
        super().__init__(venv, observation_space=spaces.Box(-clip, clip, shape=shape, dtype=np.float32))
        self.statistics = RunningMeanStd(shape=shape or ())
        self._clip, self._reward_scale = clip, reward_scale
        self._present: np.ndarray | None = None

    def start(self) -> None:
        """Start episodes already now; the next `reset` goes on from there."""
        self._present = self.reset()

    def go_on_from(self, observations: np.ndarray) -> None:
        """Let the next `reset` go on from raw observations of episodes under way instead of starting new ones."""
        self._present = self.normalise(observations)

    def normalise(self, observations: np.ndarray) -> np.ndarray:
        """Return observations as the policy sees them."""
        scaled = (observations - self.statistics.mean) / self.std
        return np.asarray(np.clip(scaled, -self._clip, self._clip), dtype=np.float32)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations by which observations are divided, (D,)."""
        return np.asarray(np.sqrt(self.statistics.var + LEAST_VARIANCE))

    def reset(self) -> np.ndarray:
        """Start new episodes, or go on where told to."""
        if self._present is not None:
            present, self._present = self._present, None
            return present
        observations = self.venv.reset()
        self.statistics.update(observations)
        return self.normalise(observations)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step, and learn the statistics of what vehicles under way see."""
        observations, rewards, dones, infos = self.venv.step_wait()
        if self.venv.acted.any():
            self.statistics.update(observations[self.venv.acted])
        for row in np.flatnonzero(dones):
            infos[row]["terminal_observation"] = self.normalise(infos[row]["terminal_observation"])
        return self.normalise(observations), rewards * self._reward_scale, dones, infos
