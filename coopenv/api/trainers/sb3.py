"""Stable-Baselines3: the batch as a native `VecEnv`, rows (world, vehicle). Needs the extra `train`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.api.array_io import Exchange, host_actions
from coopenv.api.engine import Engine
from coopenv.api.pictures import Pictures
from coopenv.api.reward import RewardFunction
from coopenv.api.terms.layout import Layout, action_space, flat_space
from coopenv.errors import CoopenvError, checked_seed
from coopenv.scenario import Scenario, load_scenario

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
    worth nothing, when the world is over. `info["alive"]` is False in those rows at every done.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        num_worlds: int,
        dtype: str = "float32",
        threads: int | None = None,
        reward: RewardFunction | None = None,
    ) -> None:
        """Build the worlds; use `make_sb3_vec_env` to build them by name."""
        self.scenario = scenario
        self.engine = Engine(scenario, num_worlds, dtype, "cpu", threads, reward=reward)
        self.vehicles = len(scenario.vehicles)
        self.render_mode = "rgb_array"
        self.metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": scenario.rates.decision}
        self._actions = np.zeros((num_worlds, self.vehicles, 2), dtype=np.float32)
        self._pictures = Pictures(self.engine, scenario)
        self._rows = Exchange(self.engine, "numpy").rows
        super().__init__(num_worlds * self.vehicles, flat_space(self.engine.layout), action_space())

    @property
    def observation_layout(self) -> Layout:
        """Name, slice, unit and scale of every field of an observation row."""
        return self.engine.layout.copy()

    def reset(self) -> np.ndarray:
        """Start a new episode in every world; seeds given by `seed()` count once."""
        first = self._seeds[0]
        seeds = None if first is None else [checked_seed(first) + w for w in range(self.engine.world.worlds)]
        self.engine.reset(seeds)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        observation: np.ndarray = self._rows("observation")
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions, (num_envs, 2).

        Raises:
            ActionError: wrong shape, or not finite.
        """
        self.engine.check_begun()
        self._actions[...] = host_actions(actions, self._actions.shape)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Drive for one decision period and reset the worlds that are over."""
        self.engine.step(self._actions)
        rewards, terminated, truncated = (self._rows(n) for n in ("reward", "terminated", "truncated"))
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            alive, final = self._rows("alive"), self.engine.view("observation").reshape(self.num_envs, -1)
            for row in np.flatnonzero(dones).tolist():
                infos[row] = {
                    "terminal_observation": final[row].copy(),
                    "TimeLimit.truncated": bool(truncated[row] and alive[row]),
                    "alive": bool(alive[row]),
                }
            self.engine.restart_finished()
        return self._rows("observation"), rewards, dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset: world w gets seed + w.

        Raises:
            CoopenvError: not a whole number, or negative.
        """
        result: Sequence[int | None] = super().seed(None if seed is None else checked_seed(seed))
        return result

    def close(self) -> None:
        """Close the renderer and end the threads."""
        self.engine.world.launch.close()
        self._pictures.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one picture, the top view of world 0."""
        return [self._pictures.of()]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch once per row."""
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


def make_sb3_vec_env(
    name_or_path: str | Path,
    *,
    num_worlds: int,
    dtype: str = "float32",
    overrides: Mapping[str, Any] | None = None,
    threads: int | None = None,
    seed: int | None = None,
    reward: RewardFunction | None = None,
) -> CooperativeSB3VecEnv:
    """Return num_worlds x vehicles rows as an SB3 `VecEnv`.

    Args:
        name_or_path: environment or TOML file.
        num_worlds: how many worlds.
        dtype: precision of the worlds; observations and rewards are float32.
        overrides: dotted scenario keys.
        threads: shares of the batch; None: by size and cores.
        seed: of the first reset; world w gets seed + w.
        reward: in place of the scenario's weighted sum, see `coopenv.make_vec`.

    Raises:
        CoopenvError: any argument is not valid.
    """
    env = CooperativeSB3VecEnv(
        load_scenario(name_or_path, overrides), num_worlds=num_worlds, dtype=dtype, threads=threads, reward=reward
    )
    if seed is not None:
        env.seed(seed)
    return env
