"""The batched Gymnasium environment: rows are (world, vehicle), for policies that all vehicles share."""

from collections import deque
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import batch_space

from coopenv.api.arguments import (
    SETTINGS,
    ArrayKind,
    Exchange,
    Pictures,
    check_choice,
    checked_autoreset,
    checked_options,
    world_mask,
    world_parameters,
)
from coopenv.api.engine import Engine
from coopenv.api.reward import RewardFunction
from coopenv.api.terms.layout import Layout, action_space, dict_space, flat_space
from coopenv.base.errors import CoopenvError, world_keys
from coopenv.scenario import Scenario

INFO_FIELDS = (
    *("alive", "ended", "position_error", "orientation_error", "nees"),
    *("log_determinant", "gramian_min_eigenvalue"),
)
"""Arrays (num_envs,) in every info, beside `reward_terms`, which holds one by the name of each term, and `time`, s
since the start of the episode. `alive` is false for vehicles that had ended before this step; `ended` is 0 under way,
1 arrived, 2 collided, from 3 on a condition of the scenario's own; errors in m and deg."""


class CooperativeVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """`num_worlds` worlds; row r is vehicle r % vehicles of world r // vehicles.

    A vehicle that ends (collision, arrival) reports `terminated` once; it stays in its world, parked, with reward 0 and
    `infos["alive"]` false, until the world is over: at the horizon, or when all its vehicles have ended. Then every row
    that has not just terminated reports `truncated`, and the world is reset as the autoreset mode says:

    - NEXT_STEP: the following step ignores the actions of these rows and returns the new episode's first observation,
      reward 0, no flags.
    - SAME_STEP: observation and infos returned are already the new episode's; those of the step stand in
      `infos["final_obs"]` and `infos["final_info"]`, with masks `infos["_final_obs"]` and `infos["_final_info"]`.
    - DISABLED: nothing happens before `reset(options={"reset_mask": mask})`, which takes whole worlds.

    Every reset draws anew. On the CPU results are fresh NumPy arrays; on CUDA they are torch tensors that share the
    environment's memory, valid until the next step, and `step` does not synchronise with the host.
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
        check_choice("render_mode", render_mode, (None, "rgb_array"))
        check_choice("observation", observation, ("flat", "dict"))
        self.engine = Engine(scenario, num_worlds, dtype, device, threads, reward=reward)
        self.scenario = scenario = self.engine.backend.scenario
        self.pictures = Pictures(self.engine, scenario)
        self.num_worlds, self.vehicles = self.engine.world.worlds, len(scenario.vehicles)
        self.num_envs = self.num_worlds * self.vehicles
        self.autoreset_mode = checked_autoreset(autoreset)
        self.render_mode = render_mode
        self.metadata = {
            "name": f"{name}_v0",
            "autoreset_mode": self.autoreset_mode,
            "render_modes": ["rgb_array"],
            "render_fps": scenario.rates.decision,
        }
        self._flat, layout = observation == "flat", self.engine.layout
        self.single_observation_space = flat_space(layout) if self._flat else dict_space(layout)
        self.single_action_space = action_space(self.scenario)
        self._exchange = Exchange(self.engine, arrays)

    @cached_property
    def observation_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The batch of `single_observation_space`, built when first asked for (it is as large as the batch)."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The batch of `single_action_space`."""
        return batch_space(self.single_action_space, self.num_envs)

    @property
    def arrays(self) -> ArrayKind:
        """What arrays are: "numpy" or "torch"."""
        return self._exchange.kind

    @property
    def observation_layout(self) -> Layout:
        """Name, slice, unit and scale of every field of an observation row."""
        return self.engine.layout.copy()

    def world_major(self, rows: Any) -> Any:
        """Return rows (num_envs, ...) as (num_worlds, vehicles, ...), without a copy."""
        return rows.reshape(self.num_worlds, self.vehicles, *rows.shape[1:])

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
        mask = None if given is None else world_mask(given, self.num_worlds, self.vehicles)
        self._exchange.follow_torch()
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
        self.engine.check_begun()
        self._exchange.follow_torch()
        self._exchange.set_actions(actions)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            self.engine.step_or_restart()
        else:
            self.engine.step()
        flags = [self._exchange.rows(name) for name in ("reward", "terminated", "truncated")]
        infos = self._infos()
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            flags, infos = self._restart_at_once(flags, infos)
        return self._observations(), flags[0], flags[1], flags[2], infos

    def _observations(self) -> Any:
        """Return the rows, or a dictionary of their parts by field."""
        rows = self._exchange.rows("observation")
        if self._flat:
            return rows
        return {name: rows[:, field.slice] for name, field in self.engine.layout.items()}

    def _restart_at_once(self, flags: list[Any], infos: dict[str, Any]) -> tuple[list[Any], dict[str, Any]]:
        """Reset what is over; return the flags of the step, and the infos after it with those of the step inside.

        `final_obs` and `final_info` are there when a row has ended; for tensors always, as looking would mean waiting.
        """
        flags = [self._exchange.owned(flag) for flag in flags]
        ended = flags[1] | flags[2]
        if self._exchange.kind == "numpy" and not ended.any():
            return flags, infos
        observation = self._exchange.owned(self._observations())
        final = {"final_obs": observation, "_final_obs": ended, "_final_info": ended}
        final["final_info"] = self._exchange.owned(infos)
        self.engine.restart_finished()
        return flags, {**self._infos(), **final}

    def _infos(self) -> dict[str, Any]:
        terms = dict(zip(self.engine.reward_terms, self._exchange.rows("terms").T, strict=True))
        fields = {name: self._exchange.rows(name) for name in INFO_FIELDS}
        return {**fields, "reward_terms": terms, "time": self._exchange.time()}

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

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return one (H, W, 3) uint8 picture per row; the rows of a world share the top view of their world."""
        if self.render_mode is None:
            return None
        pictures = [self.pictures.of(world) for world in range(self.num_worlds)]
        return tuple(picture for picture in pictures for _ in range(self.vehicles))

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next step depends on, random streams included."""
        return {"scenario": self.scenario, **self.engine.get_state()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`; on states of unknown origin see `CooperativeLocalisationEnv.set_state`.

        Raises:
            CoopenvError: it is of another kind of environment, or not valid; nothing has changed then.
        """
        where = f"this state does not fit {self.metadata['name']}"
        if not isinstance(state, Mapping) or state.get("scenario") != self.scenario:
            raise CoopenvError(f"{where}: it is of another scenario")
        try:
            self.engine.set_state(state)
        except CoopenvError as error:
            raise CoopenvError(f"{where}: {error}") from None

    def __getstate__(self) -> dict[str, Any]:
        return {
            "arguments": self._arguments,
            "state": self.get_state(),
            "random": (self._np_random, self._np_random_seed),
        }

    def __setstate__(self, saved: dict[str, Any]) -> None:
        self.__init__(**saved["arguments"])  # type: ignore[misc]
        self.set_state(saved["state"])
        self._np_random, self._np_random_seed = saved["random"]

    def close_extras(self, **kwargs: Any) -> None:
        """Close the renderer and end the threads."""
        if hasattr(self, "engine"):
            self.engine.close()
            self.pictures.close()


class TrueEnds(VectorWrapper):
    """Reports `terminated` and `truncated` of vehicles under way alone; works in every autoreset mode.

    A vehicle that ended before its world stays parked, and its row is not `truncated` once more when the world is over:
    the time until then reads as the beginning of its next episode, with reward 0 and without effect of its actions. So
    returns summed by wrappers, such as Gymnasium's `RecordEpisodeStatistics`, are those of true episodes; their
    lengths contain the time parked.
    """

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the batch."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        alive = infos.get("final_info", infos)["alive"]
        truncated = truncated & alive
        if "final_info" in infos:
            ended = terminated | truncated
            infos = {**infos, "_final_obs": ended, "_final_info": ended}
        return observations, rewards, terminated, truncated, infos


class EpisodeSums:
    """Sums over the episodes under way, one per row (world, vehicle)."""

    def __init__(self, rows: int, terms: tuple[str, ...]) -> None:
        """Start from zero.

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
        self._sums = EpisodeSums(self.num_envs, self._batch.engine.reward_terms)
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
        self._sums.forget(chosen)
        self._waiting[chosen] = False
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the batch, and report the episodes that have ended."""
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
