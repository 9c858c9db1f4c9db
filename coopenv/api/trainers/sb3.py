"""Stable-Baselines3: the batch as a native `VecEnv`, rows (world, vehicle). Needs the extra `train`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.api.terms.layout import Layout
from coopenv.api.vector_env import CooperativeVectorEnv, make_vec
from coopenv.errors import CoopenvError, checked_seed

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
except ImportError as error:
    raise ImportError("coopenv.api.trainers.sb3 needs stable-baselines3: pip install '.[train]'") from error


class CooperativeSB3VecEnv(VecEnv):
    """All vehicles of all worlds as rows of one batch, for a policy that they share.

    A world that is over is reset in the same step, as SB3 expects: `infos[row]["terminal_observation"]` holds the
    last observation, and `infos[row]["TimeLimit.truncated"]` says that the value beyond it counts.

    A vehicle that ended before its world stays parked with reward 0; its row starts a new "episode" there, which ends,
    with return 0, when the world is over. `info["alive"]` is False in those rows at every done.
    """

    def __init__(self, envs: CooperativeVectorEnv) -> None:
        """Show a batch with the autoreset mode SAME_STEP and NumPy arrays; `make_sb3_vec_env` builds one by name."""
        self.envs = envs
        self.scenario, self.engine, self.vehicles = envs.scenario, envs.engine, envs.vehicles
        self.render_mode, self.metadata = "rgb_array", envs.metadata
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    @property
    def observation_layout(self) -> Layout:
        """Name, slice, unit and scale of every field of an observation row."""
        return self.envs.observation_layout

    def reset(self) -> np.ndarray:
        """Start a new episode in every world; seeds given by `seed()` count once."""
        observation: np.ndarray = self.envs.reset(seed=self._seeds[0])[0]
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions, (num_envs, 2)."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Drive for one decision period and reset the worlds that are over.

        Raises:
            ActionError: actions of a wrong shape, or not finite.
        """
        observation, rewards, terminated, truncated, after = self.envs.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            final, alive = after["final_obs"], after["final_info"]["alive"]
            for row in np.flatnonzero(dones).tolist():
                infos[row] = {
                    "terminal_observation": final[row].copy(),
                    "TimeLimit.truncated": bool(truncated[row] and alive[row]),
                    "alive": bool(alive[row]),
                }
        return observation, rewards, dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset: world w gets seed + w.

        Raises:
            CoopenvError: not a whole number, or negative.
        """
        return list(super().seed(None if seed is None else checked_seed(seed)))

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one picture, the top view of world 0."""
        return [self.envs.pictures.of()]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch, which all rows share.

        Raises:
            CoopenvError: only some rows are named.
        """
        self._all(indices, f"set_attr('{attr_name}')")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once and return its result once per row.

        Raises:
            CoopenvError: only some rows are named.
        """
        self._all(indices, f"env_method('{method_name}')")
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return False per row: the batch has no wrappers inside."""
        return [False] * len(self._chosen(indices))

    def _chosen(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))

    def _all(self, indices: VecEnvIndices, what: str) -> None:
        if len(self._chosen(indices)) != self.num_envs:
            raise CoopenvError(f"{what}: rows share one batch, so it cannot be done for some rows only")


def make_sb3_vec_env(name_or_path: str | Path, *, seed: int | None = None, **options: Any) -> CooperativeSB3VecEnv:
    """Return num_worlds x vehicles rows as an SB3 `VecEnv`.

    Args:
        name_or_path: environment or TOML file.
        seed: of the first reset; world w gets seed + w.
        options: `num_worlds` and whatever else `coopenv.make_vec` takes but `autoreset`, `arrays` and `device`.

    Raises:
        CoopenvError: any argument is not valid.
    """
    env = CooperativeSB3VecEnv(make_vec(name_or_path, **options, autoreset="same_step", arrays="numpy", device="cpu"))
    if seed is not None:
        env.seed(seed)
    return env
