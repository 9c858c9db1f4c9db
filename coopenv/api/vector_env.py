"""The batched Gymnasium environment: rows are (world, vehicle), for policies that all vehicles share."""

import warnings
from collections import deque
from collections.abc import Sequence
from functools import cached_property, partial
from importlib.util import find_spec
from typing import Any, Literal

import gymnasium
import numpy as np
import warp as wp
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import batch_space

from coopenv.api.arguments import (
    SETTINGS,
    RewardFunction,
    checked_options,
    host_actions,
    world_parameters,
    world_states,
)
from coopenv.api.engine import Engine
from coopenv.api.saved import NO_PICTURE, RENDER_HINT, Saved
from coopenv.api.terms.layout import action_space, observation_space
from coopenv.base.errors import ActionError, CoopenvError, check_one_of, explained
from coopenv.base.installation import install_command
from coopenv.base.seeds import world_keys
from coopenv.scenario import Scenario

ArrayKind = Literal["numpy", "torch"]
INFO_FIELDS = (
    *("alive", "ended", "position_error", "orientation_error", "nees"),
    *("log_determinant", "gramian_min_eigenvalue", "protection_level"),
)
"""Arrays (num_envs,) in every info, beside `reward_terms`, which holds one by the name of each term, and `time`, s
since the start of the episode. `alive` is false for vehicles that had ended before this step; `ended` is 0 under way,
1 arrived, 2 collided, 3 off route, from 4 on a condition of the scenario's own; errors in m and deg;
`protection_level` is (num_envs, 2), m and rad, see `Step`."""


class CooperativeVectorEnv(Saved, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """`num_worlds` worlds; row r is vehicle r % vehicles of world r // vehicles.

    A vehicle that ends (collision, arrival) reports `terminated` once; it stays in its world, parked, with reward 0 and
    `infos["alive"]` false, until the world is over: at the horizon, or when all its vehicles have ended. Then every row
    that has not just terminated reports `truncated`, and the world is reset as the autoreset mode says:

    - NEXT_STEP: the following step ignores the actions of these rows and returns the new episode's first observation,
      reward 0, no flags.
    - SAME_STEP: observation and infos returned are already the new episode's; those of the step stand in
      `infos["final_obs"]` and `infos["final_info"]`, with masks `infos["_final_obs"]` and `infos["_final_info"]`.
    - DISABLED: nothing happens before `reset(options={"reset_mask": mask})`, which takes whole worlds.

    `acting` marks the rows whose actions count: a vehicle with a driver or a prescribed motion ignores those of its
    row. `ActingRows` shows the marked rows alone. Every reset draws anew. On the CPU results are fresh NumPy arrays; on
    CUDA they are torch tensors that share the environment's memory, valid until the next step, and `step` does not
    synchronise with the host.
    """

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        *,
        num_worlds: int,
        device: str = "cpu",
        dtype: str = "float32",
        autoreset: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        arrays: ArrayKind | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
        reward: RewardFunction | None = None,
        observation: Literal["flat", "dict"] = "flat",
    ) -> None:
        """Build the worlds; use `coopenv.make_vec` to build them by name."""
        self._arguments = {key: value for key, value in locals().items() if key != "self"}
        check_one_of("unknown render_mode", render_mode, (None, "rgb_array"))
        self.engine = Engine(scenario, num_worlds, dtype, device, threads, reward=reward)
        self.scenario = scenario = self.engine.backend.scenario
        self.num_worlds, self.vehicles = self.engine.world.worlds, len(scenario.vehicles)
        self.num_envs = self.num_worlds * self.vehicles
        self.acting = np.tile(scenario.acting, self.num_worlds)
        """(num_envs,) bool: whether actions drive the row's vehicle."""
        modes = {word.lower(): mode for mode in AutoresetMode for word in (mode.name, mode.value)}
        word = str(getattr(autoreset, "name", autoreset)).lower().replace("-", "_")
        check_one_of("unknown autoreset", word, modes)
        self.autoreset_mode = modes[word]
        self.render_mode = render_mode
        self.metadata = {
            "name": f"{name}_v0",
            "autoreset_mode": self.autoreset_mode,
            "render_modes": ["rgb_array"],
            "render_fps": scenario.rates.decision,
        }
        self._flat = observation == "flat"
        self.single_observation_space = observation_space(self.engine.layout, observation)
        self.single_action_space = action_space(self.scenario)
        self._on_cpu = self.engine.world.device == "cpu"
        self.arrays: ArrayKind = arrays if arrays is not None else ("numpy" if self._on_cpu else "torch")
        """Kind of arrays: fresh host arrays, or tensors on the device that share memory with the engine."""
        check_one_of("unknown arrays", self.arrays, ("numpy", "torch"))
        if self.arrays == "torch" and find_spec("torch") is None:
            raise CoopenvError(f"arrays='torch' needs torch: {install_command('train')}")
        self._tensors: dict[str, Any] = {}
        self._stream: Any = None

    @cached_property
    def observation_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The batch of `single_observation_space`, built when first asked for (it is as large as the batch)."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The batch of `single_action_space`."""
        return batch_space(self.single_action_space, self.num_envs)

    def world_major(self, rows: Any) -> Any:
        """Return rows (num_envs, ...) as (num_worlds, vehicles, ...), without a copy."""
        return rows.reshape(self.num_worlds, self.vehicles, *rows.shape[1:])

    @explained
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: that of the batch, of which no other seed below 2^32 has a world; or a sequence of one per world (one
                per row: that of the world's first row counts), whose worlds are then those of `parallel_env` with
                these seeds. None, for all or for one, goes on from the last (at first one for training is drawn).
                `coopenv.EVALUATION_SEEDS` are reserved for evaluation.
            options: `{"reset_mask": bool array}` of one per row or per world restricts the reset to whole worlds (not
                the first one); `{"parameters": {name: factors}}` and `{"difficulty": d}`, numbers or arrays of one per
                world, hold for all episodes of the worlds that are reset, automatic ones too, until they are given
                again (None: drawn again, and the scenario's level), see docs/draws.md.

        Raises:
            CoopenvError: a mask that splits a world, or a sequence of the wrong length.
        """
        wanted = checked_options(options, ("reset_mask", *SETTINGS))
        parameters = world_parameters(wanted, self.num_worlds, self.scenario)
        given = wanted.get("reset_mask")
        mask = None if given is None else self._world_mask(given)
        self._follow_torch()
        seeds = self.engine.reset(self._world_seeds(seed), mask, parameters=parameters)
        if seeds is not None and seeds[0] is not None:
            self._np_random, self._np_random_seed = seeding.np_random(int(seeds[0]))
        return self._observations(), self._infos()

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Drive all worlds for one decision period.

        Args:
            actions: (num_envs, A) in [-1, 1], A as in the action space; values beyond are clipped.

        Raises:
            ActionError: wrong shape or dtype, or (host arrays) not finite.
            CoopenvError: `reset` has not been called.
        """
        self.engine.check_begun("step")
        self._follow_torch()
        self._set_actions(actions)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            self.engine.step_or_restart()
        else:
            self.engine.step()
        flags = [self._rows(name) for name in ("reward", "terminated", "truncated")]
        infos = self._infos()
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            flags, infos = self._restart_at_once(flags, infos)
        return self._observations(), flags[0], flags[1], flags[2], infos

    def state(self) -> np.ndarray:
        """Return the states of the worlds for a central critic, (num_worlds, S); see `world_states`."""
        self.engine.check_begun("state")
        return world_states(self.engine.view, self.scenario)

    def _observations(self) -> Any:
        """Return the rows, or a dictionary of their parts by field."""
        rows = self._rows("observation")
        if self._flat:
            return rows
        return {name: rows[:, place] for name, place in self.engine.layout.parts.items()}

    def _restart_at_once(self, flags: list[Any], infos: dict[str, Any]) -> tuple[list[Any], dict[str, Any]]:
        """Reset what is over; return the flags of the step, and the infos after it with those of the step inside.

        `final_obs` and `final_info` are there when a row has ended; for tensors always, as looking would mean waiting.
        """
        flags = [self._owned(flag) for flag in flags]
        ended = flags[1] | flags[2]
        if self.arrays == "numpy" and not ended.any():
            return flags, infos
        observation = self._owned(self._observations())
        final = {"final_obs": observation, "_final_obs": ended, "_final_info": ended, "final_info": self._owned(infos)}
        self.engine.restart_finished()
        return flags, {**self._infos(), **final}

    def _infos(self) -> dict[str, Any]:
        terms = dict(zip(self.engine.reward_terms, self._rows("terms").T, strict=True))
        fields = {name: self._rows(name) for name in INFO_FIELDS}
        return {**fields, "reward_terms": terms, "time": self._time()}

    def _follow_torch(self) -> None:
        """Queue the kernels on torch's current CUDA stream, so that neither overtakes the other."""
        if self._on_cpu or self.arrays != "torch":
            return
        import torch

        device = self.engine.world.device
        current = torch.cuda.current_stream(wp.device_to_torch(device))
        if self._stream is None or self._stream.cuda_stream != current.cuda_stream:
            self._stream = wp.stream_from_torch(current)
        # The first time, wait for what was queued on the stream so far, such as the building of the world.
        wp.set_stream(self._stream, device, sync=wp.get_stream(device) != self._stream)

    def _rows(self, name: str) -> Any:
        """Return a field of the engine: a copy on the host, or a tensor that shares memory, but for a GPU's state."""
        if self.arrays == "numpy":
            view = self.engine.view(name)
            return view.reshape(self.num_envs, *view.shape[2:]).copy()
        tensor = self._tensors.get(name)
        if tensor is None:
            tensor = self._tensors[name] = wp.to_torch(self.engine.array(name))
        return tensor.reshape(self.num_envs, *tensor.shape[2:])

    def _time(self) -> Any:
        """Return (num_envs,) s since the start of each row's episode."""
        period = float(self.engine.world.model.camera_period)
        if self.arrays == "numpy":
            return np.repeat(self.engine.view("tick") * period, self.vehicles)
        return (wp.to_torch(self.engine.array("tick")) * period).repeat_interleave(self.vehicles)

    def _owned(self, rows: Any) -> Any:
        """Return rows, or dictionaries of them, as what the next step does not touch."""
        if isinstance(rows, dict):
            return {name: self._owned(values) for name, values in rows.items()}
        return rows if self.arrays == "numpy" else rows.clone()

    def _set_actions(self, actions: Any) -> None:
        """Take actions (W N, A), or (W, N, A), clipped to [-1, 1] by the actuators.

        A tensor that is on the device already is copied there; whether it is finite is not checked, as that would
        wait for the device: an action that is not finite counts as zero.

        Raises:
            ActionError: wrong shape or dtype; a host array that is not finite.
        """
        shape = tuple(self.engine.array("actions").shape)
        if self.arrays != "torch" or type(actions).__module__.split(".")[0] != "torch":
            self.engine.set_actions(host_actions(actions, shape))
            return
        import torch

        if tuple(actions.shape) not in ((self.num_envs, shape[-1]), shape):
            raise ActionError(f"actions have shape {tuple(actions.shape)}, expected ({self.num_envs}, {shape[-1]})")
        if not torch.is_floating_point(actions) or actions.device.type == "meta":
            raise ActionError(f"actions have dtype {actions.dtype} on {actions.device}, expected a float with data")
        if actions.device.type == "cpu" and not torch.isfinite(actions).all():
            host_actions(actions.detach().numpy(), shape)  # says which row
        wp.to_torch(self.engine.array("actions")).copy_(actions.detach().reshape(shape))

    def _world_mask(self, value: object) -> np.ndarray:
        """Return the option `reset_mask`, one bool per row or per world, as (num_worlds,).

        Raises:
            CoopenvError: it is something else, or splits a world.
        """
        try:
            chosen = np.asarray(value)
        except (TypeError, ValueError, RuntimeError):
            chosen = np.empty(0)
        if chosen.dtype != bool or not chosen.any():
            raise CoopenvError("reset_mask must be an array of bool with at least one True")
        if chosen.shape == (self.num_envs,):
            by_world = self.world_major(chosen)
            split = np.flatnonzero(by_world.any(axis=1) != by_world.all(axis=1))
            if split.size:
                raise CoopenvError(f"reset_mask splits world {split[0]}: its {self.vehicles} rows are reset together")
            chosen = by_world[:, 0]
        if chosen.shape != (self.num_worlds,):
            expected = f"({self.num_envs},) rows or ({self.num_worlds},) worlds"
            raise CoopenvError(f"reset_mask has shape {chosen.shape}, expected {expected}")
        return chosen

    def _world_seeds(self, seed: Any) -> list[int | None] | None:
        """Return the keys of the worlds, None where one goes on from its last."""
        if seed is None:
            return None
        if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str) or np.ndim(seed) == 0:
            return [*world_keys(seed, self.num_worlds)]
        keys = [None if s is None else world_keys(s)[0] for s in seed]
        if len(keys) == self.num_envs:
            keys = keys[:: self.vehicles]
        if len(keys) != self.num_worlds:
            raise CoopenvError(f"{len(keys)} seeds for {self.num_worlds} worlds")
        return keys

    @partial(explained, hint=RENDER_HINT)
    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return one (H, W, 3) uint8 picture per row; the rows of a world share the top view of their world."""
        if self.render_mode is None:
            warnings.warn(NO_PICTURE, stacklevel=2)
            return None
        pictures = [self.engine.picture(world) for world in range(self.num_worlds)]
        return tuple(picture for picture in pictures for _ in range(self.vehicles))

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "random": (self._np_random, self._np_random_seed)}

    def __setstate__(self, saved: dict[str, Any]) -> None:
        super().__setstate__(saved)
        self._np_random, self._np_random_seed = saved["random"]

    def close_extras(self, **kwargs: Any) -> None:
        """Close the renderer and end the threads."""
        if hasattr(self, "engine"):
            self.engine.close()


class ActingRows(VectorWrapper):
    """Shows the rows of vehicles that actions drive alone, with infos; flat observations only."""

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        """Wrap a batch with NumPy arrays, or one wrapped already. Raises CoopenvError: no vehicle acts."""
        super().__init__(env)
        self._acting: np.ndarray = env.unwrapped.acting  # type: ignore[attr-defined]
        if not self._acting.any():
            raise CoopenvError("all motion is prescribed or has a driver, there is nothing to drive")
        self.observation_space = batch_space(env.single_observation_space, self.num_envs)
        self.action_space = batch_space(env.single_action_space, self.num_envs)

    @property
    def num_envs(self) -> int:  # type: ignore[override]
        """Number of rows, one per acting vehicle of every world."""
        return int(self._acting.sum())

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the batch."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._own(observations), self._own(infos)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the batch under actions (num_envs, A)."""
        size = self.action_space.shape[-1]  # type: ignore[index]
        whole = np.zeros((len(self._acting), size), dtype=np.float32)
        whole[self._acting] = host_actions(actions, (self.num_envs, 1, size))[:, 0]
        observations, rewards, terminated, truncated, infos = self.env.step(whole)
        return *map(self._own, (observations, rewards, terminated, truncated)), self._own(infos)

    def _own(self, rows: Any) -> Any:
        return {name: self._own(each) for name, each in rows.items()} if isinstance(rows, dict) else rows[self._acting]


class RecordVehicleEpisodes(VectorWrapper):
    """Adds return and length of vehicles' true episodes, in place of Gymnasium's `RecordEpisodeStatistics`.

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
        self._names = self._batch.engine.reward_terms
        self.sums = np.zeros((2 + len(self._names), self.num_envs))
        """Return, decisions and reward terms of the episodes under way, (2 + terms, num_envs)."""
        self._waiting = np.zeros(self.num_envs, dtype=bool)
        self.episode_count = 0
        self.return_queue: deque[float] = deque(maxlen=buffer_length)
        self.length_queue: deque[int] = deque(maxlen=buffer_length)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the batch, and the sums of the rows that were reset."""
        result = self.env.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask)
        if chosen.shape != (self.num_envs,):
            chosen = np.repeat(chosen, self._batch.vehicles)
        self.sums[:, chosen] = 0.0
        self._waiting[chosen] = False
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the batch, and report the episodes that have ended."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        step = infos.get("final_info", infos)
        acted, over = step["alive"] & ~self._waiting, terminated | truncated
        terms = (step["reward_terms"][name] for name in self._names)
        self.sums += np.where(acted, [rewards, np.ones_like(rewards), *terms], 0.0)
        if self._batch.autoreset_mode == AutoresetMode.NEXT_STEP:
            self._waiting = over
        ended = acted & over
        if ended.any():
            returned, length, *sums = np.where(ended, self.sums, 0.0)
            self.sums[:, ended] = 0.0
            by_name = dict(zip(self._names, sums, strict=True))
            episode = {"r": returned, "l": length.astype(int), "reward_terms": by_name}
            infos = {**infos, "episode": episode, "_episode": ended}
            self.episode_count += int(ended.sum())
            self.return_queue.extend(episode["r"][ended].tolist())
            self.length_queue.extend(episode["l"][ended].tolist())
        return observations, rewards, terminated, truncated, infos
