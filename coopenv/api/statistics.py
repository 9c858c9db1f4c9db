"""Statistics of true episodes: from a vehicle's start to its own end, without the time that it then stands parked."""

from collections import deque
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorWrapper

from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.base.errors import CoopenvError


class EpisodeSums:
    """Sums over the episodes under way, one per row (world, vehicle)."""

    def __init__(self, rows: int, terms: tuple[str, ...]) -> None:
        """Begin with nothing.

        Args:
            rows: number of rows.
            terms: names of the reward terms.
        """
        self._names = ("r", "l", *terms)
        self._sums = np.zeros((len(self._names), rows))

    def add(self, rewards: np.ndarray, acted: np.ndarray, infos: dict[str, Any]) -> None:
        """Add a step.

        Args:
            rewards: (rows,).
            acted: (rows,) whether the vehicle was under way in this step.
            infos: of the step, as `CooperativeVectorEnv` gives them.
        """
        step = [rewards, np.ones_like(rewards), *(infos["reward_terms"][name] for name in self._names[2:])]
        self._sums += np.where(acted, step, 0.0)

    def take(self, ended: np.ndarray) -> dict[str, Any]:
        """Return the sums of the rows whose episode has ended, 0 elsewhere, and begin anew there.

        Returns:
            `r`, the undiscounted return, and `l`, decisions, (rows,) each; `reward_terms`, (rows,) by name.
        """
        taken = np.where(ended, self._sums, 0.0)
        self.forget(ended)
        sums: dict[str, Any] = dict(zip(self._names, taken, strict=True))
        terms = {name: sums.pop(name) for name in self._names[2:]}
        return {"r": sums["r"], "l": sums["l"].astype(int), "reward_terms": terms}

    @property
    def under_way(self) -> np.ndarray:
        """The sums so far, (2 + terms, rows), for a checkpoint; what is assigned replaces them."""
        return self._sums.copy()

    @under_way.setter
    def under_way(self, sums: np.ndarray) -> None:
        if sums.shape != self._sums.shape or not np.isfinite(sums).all():
            raise CoopenvError(f"sums of episodes: expected finite numbers of shape {self._sums.shape}")
        self._sums[...] = sums

    def forget(self, rows: np.ndarray) -> None:
        """Begin anew in rows of a mask."""
        self._sums[:, rows] = 0.0


class RecordVehicleEpisodes(VectorWrapper):
    """Adds what a vehicle's episode came to, like Gymnasium's `RecordEpisodeStatistics`, but of true episodes only.

    In a step in which episodes end, `infos["episode"]` holds `r` (undiscounted return), `l` (decisions) and
    `reward_terms` (sums by name), arrays (num_envs,), and `infos["_episode"]` the mask of the rows that they are of. A
    vehicle's episode ends when it arrives or collides, or with its world; the time that it stands parked until then
    counts as no episode. Works in every autoreset mode.
    """

    def __init__(self, env: CooperativeVectorEnv, buffer_length: int = 100) -> None:
        """Wrap a batch.

        Args:
            env: with NumPy arrays.
            buffer_length: episodes of which `return_queue` and `length_queue` keep return and length.

        Raises:
            CoopenvError: its arrays are tensors.
        """
        super().__init__(env)
        self._batch = env.unwrapped
        if self._batch.arrays != "numpy":
            raise CoopenvError("RecordVehicleEpisodes needs NumPy arrays: make_vec(arrays='numpy')")
        self._sums = EpisodeSums(self.num_envs, self._batch.engine.reward_terms)
        self._waiting = np.zeros(self.num_envs, dtype=bool)
        self.episode_count = 0
        self.return_queue: deque[float] = deque(maxlen=buffer_length)
        self.length_queue: deque[int] = deque(maxlen=buffer_length)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the batch, and begin anew where it was reset."""
        result = self.env.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask)
        if chosen.shape != (self.num_envs,):
            chosen = np.repeat(chosen, self._batch.vehicles)
        self._sums.forget(chosen)
        self._waiting[chosen] = False
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the batch, and tell of the episodes that have ended."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        step = infos.get("final_info", infos)
        acted, over = step["alive"] & ~self._waiting, terminated | truncated
        self._sums.add(rewards, acted, step)
        if self._batch.autoreset_mode == AutoresetMode.NEXT_STEP:
            self._waiting = over
        ended = acted & over
        if ended.any():
            infos = {**infos, "episode": self._sums.take(ended), "_episode": ended}
            self.episode_count += int(ended.sum())
            self.return_queue.extend(infos["episode"]["r"][ended].tolist())
            self.length_queue.extend(infos["episode"]["l"][ended].tolist())
        return observations, rewards, terminated, truncated, infos
