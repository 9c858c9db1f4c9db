"""Environments by name: `coopenv.parallel_env`, `coopenv.make_vec`, and the entry points of Gymnasium's registry."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from coopenv.api.arguments import RewardFunction
from coopenv.api.parallel_env import RENDER_MODES, CooperativeLocalisationEnv
from coopenv.api.vector_env import ArrayKind, CooperativeVectorEnv
from coopenv.backends.base import Backend
from coopenv.backends.sources import open_backend, open_simulation, simulation_of
from coopenv.base.errors import CoopenvError, ScenarioError, check_one_of
from coopenv.observers.contract import Factory
from coopenv.observers.registry import named
from coopenv.scenario import Scenario, load_scenario


def parallel_env(
    name_or_path: str | Path | Scenario,
    *,
    render_mode: str | None = None,
    observer: str | Factory | None = None,
    backend: str | Backend | None = None,
    observation: Literal["flat", "dict"] = "flat",
    device: str = "cpu",
    dtype: str = "float32",
    overrides: Mapping[str, Any] | None = None,
    data: str | Path | None = None,
    variant: str | None = None,
    topics: str | Path | None = None,
    reward: RewardFunction | None = None,
    deployment: str | Path | None = None,
    car: str | None = None,
    record: str | Path | None = None,
    connect: str | None = None,
) -> CooperativeLocalisationEnv:
    """Return an environment by name (`coopenv.list_envs()`), from a TOML file, or from a recording.

    A recording is replayed unchanged, actions are ignored; see docs/replay.md, and docs/bags.md for ROS bags.

    Args:
        name_or_path: for example "busy_intersection"; "mrclam_6", "drive.mcap" or "drive.bag" replay what was
            recorded. A scenario of `coopenv.load_scenario` is simulated. Where `backend` is an object, any name for
            the environment.
        render_mode: None, "rgb_array" or "human".
        observer: estimator that every vehicle runs, embedded or a plug-in: a name, a class, or an import path
            (`mine.py:Mine`, `package.module:Mine`); None: that of the scenario.
        backend: where measurements come from, "simulated", "highway", "replay" or "svea", or a
            `coopenv.backends.base.Backend`, which has its own scenario; None: by the name.
        observation: "flat" Box or one-level "dict".
        device: "cpu" or a CUDA device.
        dtype: "float32" or "float64" (of the world; observations are float32).
        overrides: dotted scenario keys, for example {"noise.enabled": False}.
        data: folder of recorded data sets; None: COOPENV_DATA.
        variant: of a recorded data set: "landmarks", "landmarks+robots" (the default) or "blind".
        topics: of a ROS bag: the TOML file with the meaning of its topics.
        reward: a function of a `coopenv.api.arguments.Step` that returns the rewards (1, vehicles); None: the weighted
            sum of the scenario's terms.
        deployment: file with the cars; for `backend="svea"`, see docs/cars.md.
        car: name of the car that is estimated and driven here; the other ones only send (None: all cars).
        record: MCAP file for all messages from and to the cars.
        connect: endpoint of the cars' network in place of that of the deployment, for example "tcp/127.0.0.1:7447".

    Raises:
        UnknownEnvironmentError: no such environment.
        ScenarioError: the file or an override is not valid.
        CoopenvError: another argument is not valid.
    """
    changes = _with_observer(overrides, observer)
    if isinstance(name_or_path, Scenario) and backend in (None, name_or_path.backend):
        backend, changes = simulation_of(load_scenario(name_or_path, changes)), {}
    return CooperativeLocalisationEnv(
        open_backend(
            _name_of(name_or_path),
            backend,
            changes,
            data,
            variant,
            {"deployment": deployment, "car": car, "record": record, "connect": connect},
            topics,
        ),
        Path(_name_of(name_or_path)).stem,
        render_mode=render_mode,
        observation=observation,
        device=device,
        dtype=dtype,
        reward=reward,
    )


def make_vec(
    name_or_path: str | Path | Scenario,
    *,
    num_worlds: int,
    device: str = "cpu",
    dtype: str = "float32",
    autoreset: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    overrides: Mapping[str, Any] | None = None,
    arrays: ArrayKind | None = None,
    threads: int | None = None,
    render_mode: str | None = None,
    reward: RewardFunction | None = None,
    observer: str | Factory | None = None,
    observation: Literal["flat", "dict"] = "flat",
) -> CooperativeVectorEnv:
    """Return a batch of worlds as a Gymnasium `VectorEnv` with num_worlds x vehicles rows.

    Args:
        name_or_path: environment, TOML file, or scenario of `coopenv.load_scenario`.
        num_worlds: how many worlds.
        device: "cpu" or a CUDA device.
        dtype: precision of the worlds; observations and rewards are float32.
        autoreset: "next_step", "same_step" or "disabled".
        overrides: dotted scenario keys.
        arrays: "numpy" (default on the CPU) or "torch" (default on CUDA).
        threads: shares of the batch on the CPU; None: by size and cores.
        render_mode: None or "rgb_array".
        reward: a function of a `coopenv.api.arguments.Step` that returns the rewards (num_worlds, vehicles), on the CPU
            only; None: the weighted sum of the scenario's terms.
        observer: estimator that every vehicle runs, as for `coopenv.parallel_env`; None: that of the scenario.
        observation: "flat" rows, or a "dict" of arrays (num_envs, size) by field.

    Raises:
        CoopenvError: any argument is not valid.
    """
    changes = _with_observer(overrides, observer)
    made = isinstance(name_or_path, Scenario)
    return CooperativeVectorEnv(
        load_scenario(name_or_path, changes) if made else open_simulation(str(name_or_path), changes),
        Path(_name_of(name_or_path)).stem,
        num_worlds=num_worlds,
        device=device,
        dtype=dtype,
        autoreset=autoreset,
        arrays=arrays,
        threads=threads,
        render_mode=render_mode,
        reward=reward,
        observation=observation,
    )


def make_rows(
    name_or_path: str,
    num_envs: int = 1,
    vectorization_mode: Literal["vector_entry_point"] | None = None,
    **options: Any,
) -> CooperativeVectorEnv:
    """Entry point of `gymnasium.make_vec("coopenv/...", num_envs=rows)`.

    Raises:
        CoopenvError: `num_envs` is not a multiple of the vehicles.
    """
    if "num_worlds" in options:
        raise CoopenvError("give num_envs, which counts rows (world, vehicle), instead of num_worlds")
    vehicles = len(open_simulation(name_or_path, options.get("overrides")).vehicles)
    if not isinstance(num_envs, int | np.integer) or num_envs < 1 or num_envs % vehicles:
        raise CoopenvError(
            f"num_envs counts rows (world, vehicle): {num_envs} is not a positive multiple of the {vehicles} vehicles "
            f"of {name_or_path}"
        )
    return make_vec(name_or_path, num_worlds=int(num_envs) // vehicles, **options)


def _name_of(name_or_path: str | Path | Scenario) -> str:
    """Return the name of an environment; of a scenario its title."""
    return name_or_path.title if isinstance(name_or_path, Scenario) else str(name_or_path)


def _with_observer(overrides: Mapping[str, Any] | None, observer: str | Factory | None) -> dict[str, Any]:
    """Return dotted keys and the observer's among them.

    Raises:
        ScenarioError: the overrides are no mapping.
    """
    if overrides is not None and not isinstance(overrides, Mapping):
        raise ScenarioError(f"overrides must map dotted keys to values, got {type(overrides).__name__}")
    return {**(overrides or {}), **({} if observer is None else {"observer.name": named(observer)})}


OtherPolicy = Callable[[str, Any], np.ndarray]
"""Maps another vehicle's name and observation to its action."""


MOST_EPISODES = 1000


def keep_going(agent: str, observation: Any) -> np.ndarray:
    """Return the neutral action: straight on, at half of the speed range (or without acceleration)."""
    return np.zeros(2, dtype=np.float32)


class SingleVehicleEnv(gymnasium.Env[Any, np.ndarray]):
    """One vehicle of a `CooperativeLocalisationEnv` as a single-agent environment."""

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012  (Gymnasium's convention)

    def __init__(
        self,
        name_or_path: str | Path,
        *,
        vehicle: str = "vehicle_1",
        others: OtherPolicy = keep_going,
        **options: Any,
    ) -> None:
        """Build the environment.

        Args:
            name_or_path: as for `coopenv.parallel_env`.
            vehicle: the one that the action drives.
            others: the rule of the other vehicles.
            **options: the other arguments of `coopenv.parallel_env`.

        Raises:
            CoopenvError: no such vehicle.
        """
        self._spec: EnvSpec | None = None
        self.world: CooperativeLocalisationEnv = parallel_env(name_or_path, **options)
        names = self.world.possible_agents
        check_one_of("unknown vehicle", vehicle, names)
        self.vehicle, self._others = vehicle, others
        self.render_mode = self.world.render_mode
        self.metadata = dict(self.world.metadata)
        self.observation_space = self.world.observation_space(vehicle)
        self.action_space = self.world.action_space(vehicle)
        self._observations: dict[str, Any] = {}

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium registered, with the horizon in decisions as `max_episode_steps`."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            scenario = self.world.scenario
            spec = replace(spec, max_episode_steps=round(scenario.horizon * scenario.rates.decision))
        self._spec = spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, see `CooperativeLocalisationEnv.reset`."""
        super().reset(seed=seed)
        self._observations, infos = self.world.reset(seed=seed, options=options)
        for _ in range(MOST_EPISODES):
            if self.vehicle in infos:
                break
            self._observations, infos = self.world.reset()  # an episode without it
        else:
            raise CoopenvError(f"{self.vehicle} was absent in {MOST_EPISODES} episodes running")
        return self._observations[self.vehicle], infos[self.vehicle]

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive the vehicle for one decision period.

        Raises:
            ActionError: the action has the wrong shape or is not finite.
        """
        actions = {
            agent: action if agent == self.vehicle else self._others(agent, self._observations[agent])
            for agent in self.world.agents
        }
        self._observations, rewards, terminated, truncated, infos = self.world.step(actions)
        v = self.vehicle
        if v not in rewards:
            raise CoopenvError(f"step() called although {v} has ended; call reset()")
        return self._observations[v], rewards[v], terminated[v], truncated[v], infos[v]

    def render(self) -> Any:
        """Draw the top view."""
        return self.world.render()

    def close(self) -> None:
        """Close the window, if any."""
        self.world.close()
