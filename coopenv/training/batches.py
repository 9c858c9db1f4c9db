"""Batches of worlds for learning: mixed draws and sensors, normalised observations and rewards (extra `train`)."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnvWrapper

from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv
from coopenv.policies.network import RightOfWay
from coopenv.training.settings import Ppo

Arrays = dict[str, np.ndarray]
SEEN = 256
"""Last decisions whose observations are kept, for the range of each field."""
APART = 1_000_003
"""Between the seeds of parts of a batch."""
LEAST_VARIANCE = 1e-4
"""Addition to variances, so that nearly constant entries are not scaled up to the size of the rest."""


class MixedWorlds(CooperativeSB3VecEnv):
    """Batches of worlds with different draws or sensors, stacked as one batch."""

    def __init__(self, parts: Sequence[CooperativeSB3VecEnv]) -> None:
        super().__init__(parts[0].envs)
        self.parts = parts
        self.num_envs = sum(part.num_envs for part in parts)
        self._ends = np.cumsum([part.num_envs for part in parts])[:-1]
        self.acted = np.zeros(self.num_envs, dtype=bool)

    def reset(self) -> np.ndarray:
        """Start a new episode in every world; parts draw other worlds than one another."""
        for place, part in enumerate(self.parts):
            if (seed := self._seeds[0]) is not None:
                part.seed((seed + APART * place) % 2**31)
        self._reset_seeds()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return np.concatenate([part.reset() for part in self.parts])

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Drive for one decision period in all parts."""
        for part, actions in zip(self.parts, np.split(self._actions, self._ends), strict=True):
            part.step_async(actions)
        observations, rewards, dones, infos = zip(*(part.step_wait() for part in self.parts), strict=True)
        self.acted = np.concatenate([part.acted for part in self.parts])
        self.batch_infos = {
            name: np.concatenate([part.batch_infos[name] for part in self.parts]) for name in ("time", "position_error")
        }
        together = [info for own in infos for info in own]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(dones), together

    def get_state(self) -> dict[str, np.ndarray]:
        """Return the states of all parts."""
        states = enumerate(part.get_state() for part in self.parts)
        return {f"{place}/{name}": values for place, state in states for name, values in state.items()}

    def set_state(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
        """Continue from a state of `get_state`. Raises CoopenvError: it does not fit."""
        states: list[dict[str, np.ndarray]] = [{} for _ in self.parts]
        for name, values in state.items():
            place, _, own = name.partition("/")
            states[int(place)][own] = values
        return np.concatenate([part.set_state(own) for part, own in zip(self.parts, states, strict=True)])

    def close(self) -> None:
        """Close all parts."""
        for part in self.parts:
            part.close()


class NormalisedEnv(VecEnvWrapper):
    """Wrapper for learning: normalised observations of vehicles under way, rewards of order one.

    Unlike SB3's `VecNormalize` it leaves parked vehicles out of the statistics and is saved without pickle. Returns in
    `info["episode"]` stay in the units of the scenario.
    """

    venv: CooperativeSB3VecEnv

    def __init__(self, venv: CooperativeSB3VecEnv, ppo: Ppo, rule: RightOfWay | None = None) -> None:
        """Wrap a batch; a rule is below the actions of the policy."""
        shape = venv.observation_space.shape
        super().__init__(
            venv,
            observation_space=spaces.Box(-ppo.observation_clip, ppo.observation_clip, shape=shape, dtype=np.float32),
        )
        self.statistics = RunningMeanStd(shape=shape or ())
        self._clip, self._scale = ppo.observation_clip, ppo.reward_scale
        self._gamma = ppo.discount(venv.scenario) ** venv.kept
        self.spread = RunningMeanStd(shape=())
        """Running mean and variance of discounted returns, in the units of the scenario."""
        self.returns = np.zeros(venv.num_envs)
        self.looked_at: deque[np.ndarray] = deque(maxlen=SEEN)
        self.settled = False
        """Whether the statistics of observations stay as they are: a policy has been fitted to them."""
        self._present: np.ndarray | None = None
        self._rule, self._raw = rule, np.empty(0)

    def start(self) -> None:
        """Start episodes already now; the next `reset` goes on from there."""
        self._present = self.reset()

    def go_on_from(self, observations: np.ndarray) -> None:
        """Let the next `reset` go on from raw observations of episodes under way instead of starting new ones."""
        self._present, self._raw = self.normalise(observations), observations

    def normalise(self, observations: np.ndarray) -> np.ndarray:
        """Return observations as the policy sees them."""
        scaled = (observations - self.statistics.mean) / self.std
        return np.asarray(np.clip(scaled, -self._clip, self._clip), dtype=np.float32)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations by which observations are divided, (D,)."""
        return np.asarray(np.sqrt(self.statistics.var + LEAST_VARIANCE))

    @property
    def reward_scale(self) -> float:
        """Current factor of the rewards."""
        return float(1.0 / np.sqrt(self.spread.var + 1e-8)) if self._scale == "spread" else self._scale

    def seen(self, columns: slice) -> tuple[float, float]:
        """Return between which values nearly all of some entries of the last observations lay."""
        known = self.looked_at or [
            self.statistics.mean + 3.0 * self.std * np.array([[-1.0], [1.0]])
        ]  # none: just resumed
        low, high = np.percentile(np.concatenate(known)[:, columns], (0.1, 99.9))
        return round(float(low), 4), round(float(high), 4)

    def reset(self) -> np.ndarray:
        """Start new episodes, or continue with given observations."""
        if self._present is not None:
            present, self._present = self._present, None
            return present
        self._raw = observations = self.venv.reset()
        if not self.settled:
            self.statistics.update(observations)
        return self.normalise(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions, (num_envs, A)."""
        self.venv.step_async(self._rule(self._raw, actions) if self._rule else actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step, and update the statistics of the observations of vehicles under way."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._raw = observations
        if self.venv.acted.any():
            if not self.settled:
                self.statistics.update(observations[self.venv.acted])
            self.looked_at.append(observations[self.venv.acted])
        for row in np.flatnonzero(dones):
            infos[row]["terminal_observation"] = self.normalise(infos[row]["terminal_observation"])
        self.returns = self._gamma * self.returns + rewards
        if self.venv.acted.any():
            self.spread.update(self.returns[self.venv.acted])
        self.returns[dones] = 0.0
        return self.normalise(observations), rewards * self.reward_scale, dones, infos
