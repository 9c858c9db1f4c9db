"""PPO with a memory: a gated recurrent unit whose state stands beside the observation (extra `train`)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import Tensor, nn

from coopenv.api.trainers.sb3 import ActingRowsBuffer, TanhPolicy
from coopenv.training.batches import NormalisedEnv


class RememberingEnv(VecEnvWrapper):
    """Observations (rows, D) with what the policy remembers beside them, (rows, M), as it is while vehicles drive."""

    venv: NormalisedEnv

    def __init__(self, venv: NormalisedEnv, width: int) -> None:
        """Wrap a batch for a memory of M = `width` numbers."""
        size = (venv.observation_space.shape or (0,))[0] + width
        super().__init__(venv, observation_space=spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32))
        self.cell: nn.GRUCell
        self.state = torch.zeros(venv.num_envs, width)
        """State of every row, of its last observation, too."""
        self._restored = False

    def _remembered(self, seen: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            self.state = self.cell(torch.from_numpy(seen), self.state)
        return self._beside(seen)

    def _beside(self, seen: np.ndarray) -> np.ndarray:
        return np.concatenate([seen, self.state.numpy()], axis=1, dtype=np.float32)

    def go_on_from(self, state: np.ndarray) -> None:
        """Let the next `reset` go on with what the rows remember, (rows, M). Raises ValueError: of another shape."""
        if state.shape != tuple(self.state.shape):
            raise ValueError(f"memory: {state.shape}, expected {tuple(self.state.shape)}")
        self.state, self._restored = torch.from_numpy(state.copy()), True

    def reset(self) -> np.ndarray:
        """Start new episodes, or go on."""
        seen = self.venv.reset()
        if self._restored:
            self._restored = False
            return self._beside(seen)
        self.state = torch.zeros_like(self.state)
        return self._remembered(seen)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step, remember, and forget what was before the beginning of an episode."""
        seen, rewards, dones, infos = self.venv.step_wait()
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            with torch.no_grad():
                state = self.cell(torch.from_numpy(last), self.state[row])
            infos[row]["terminal_observation"] = np.concatenate([last, state.numpy()])
        self.state[torch.from_numpy(dones | ~self.venv.venv.acted)] = 0.0
        return self._remembered(seen), rewards, dones, infos


class SequencesBuffer(ActingRowsBuffer):
    """Minibatches of the decisions of whole rows: a memory is learnt along them."""

    present = np.zeros(0, dtype=int)
    """Which sequences the last minibatch is of."""

    def sequences(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return observations (B, T, D + M), and flags (B, T): vehicles under way, and beginnings of episodes."""
        acted, starts = self.acted.T, self.episode_starts.T > 0.0
        starts[:, 1:] |= ~acted[:, :-1]  # nothing of the time parked is remembered
        observations = self.observations.reshape(*acted.shape, -1)
        return observations[self.present], acted[self.present], starts[self.present]

    def parts(self, batch_size: int) -> Iterator[np.ndarray]:
        """Yield the numbers of acting rows, sequence by sequence."""
        acted = self.acted.T
        rows = np.arange(acted.size).reshape(acted.shape)
        count = max(1, min(self.n_envs, round(acted.sum() / batch_size)))
        for chosen in np.array_split(np.random.permutation(self.n_envs), count):
            if acted[chosen].any():
                self.present = chosen
                yield rows[chosen][acted[chosen]]


class RememberingPolicy(TanhPolicy):
    """A tanh network for the mean action, one for the value, and a memory that both read; observations have it."""

    buffer: SequencesBuffer
    """Buffer whose minibatches are evaluated."""

    def __init__(self, *arguments: Any, memory: int, **options: Any) -> None:
        """See SB3's `ActorCriticPolicy`; `memory` is the width M."""
        self._width = memory
        super().__init__(*arguments, **options)

    def _build(self, lr_schedule: Any) -> None:
        self.cell = nn.GRUCell(self.features_dim - self._width, self._width)
        super()._build(lr_schedule)
        with torch.no_grad():
            for layers in self.layers():
                layers[0].weight[:, -self._width :] = 0.0  # it begins as the policy without a memory

    def remember(self, rows: Tensor, starts: Tensor) -> Tensor:
        """Return what sequences of rows (B, T, D + M) remember now, (B, T, M); the first state is that of the rows.

        Where `starts` (B, T), bool, an episode begins, nothing is remembered of the one before.
        """
        seen, first = rows[..., : -self._width], rows[:, 0, -self._width :]
        states, going_on = [first], (~starts).float()[..., None]
        for t in range(1, rows.shape[1]):
            states.append(self.cell(seen[:, t], states[-1] * going_on[:, t]))
        return torch.stack(states, dim=1)

    def evaluate_actions(self, obs: Any, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `TanhPolicy.evaluate_actions`; derivatives pass back along sequences to the memory (Werbos 1990)."""
        every, acted, starts = (torch.from_numpy(values) for values in self.buffer.sequences())
        with torch.set_grad_enabled(not self.critic_alone):
            states = self.remember(every, starts)[acted]
        return super().evaluate_actions(torch.cat([obs[:, : -self._width], states], dim=1), actions)
