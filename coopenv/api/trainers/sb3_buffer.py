"""A rollout buffer for Stable-Baselines3 that leaves out the rows of vehicles that stood parked. Needs `train`."""

from collections.abc import Generator
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv


class ActingRowsBuffer(RolloutBuffer):
    """Gives PPO minibatches of those rows alone whose vehicle was under way; flat observations only.

        model = PPO("MlpPolicy", env, rollout_buffer_class=ActingRowsBuffer, rollout_buffer_kwargs={"rows": env})

    Advantages need no correction: a row is done when its vehicle's episode ends, so nothing of the time parked reaches
    back to before it.
    """

    def __init__(self, *arguments: Any, rows: CooperativeSB3VecEnv, **options: Any) -> None:
        """Build the buffer.

        Args:
            *arguments: those of SB3's `RolloutBuffer`.
            rows: the environment that the rollouts come from, without its wrappers.
            **options: those of SB3's `RolloutBuffer`.
        """
        self._rows = rows
        super().__init__(*arguments, **options)

    def reset(self) -> None:
        """Forget what was collected."""
        self.generator_ready = False
        self.acted = np.zeros((self.buffer_size, self.n_envs), dtype=bool)
        super().reset()

    def add(self, *step: Any, **named: Any) -> None:
        """Take a step, and whose vehicles were under way in it."""
        self.acted[self.pos] = self._rows.acted
        super().add(*step, **named)

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """Yield shuffled minibatches of about `batch_size` rows each, all as large as one another."""
        if not self.generator_ready:
            for name in ("observations", "actions", "values", "log_probs", "advantages", "returns"):
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
            self.generator_ready = True
        chosen = np.random.permutation(np.flatnonzero(self.swap_and_flatten(self.acted)))
        for part in np.array_split(chosen, max(1, round(len(chosen) / (batch_size or max(1, len(chosen)))))):
            if len(part):
                yield self._get_samples(part)
