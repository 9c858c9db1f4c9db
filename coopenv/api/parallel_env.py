"""The PettingZoo environment: one world, dictionaries keyed by agent."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv

from coopenv.api.arguments import (
    SETTINGS,
    ActionReader,
    InfoWriter,
    Pictures,
    check_choice,
    checked_options,
    state_space,
    state_vector,
    world_number,
    world_parameters,
)
from coopenv.api.engine import Engine
from coopenv.api.reward import RewardFunction
from coopenv.api.terms.layout import Layout, action_space, dict_space, flat_space
from coopenv.backends.base import EPISODE_OVER, IGNORED_OPTIONS, Backend, Health
from coopenv.backends.sources import simulation_of
from coopenv.base.errors import CoopenvError, shown, suggest, world_keys
from coopenv.scenario import Scenario
from coopenv.world.reset import ABSENT

Observations = dict[str, Any]
Infos = dict[str, dict[str, Any]]

RENDER_MODES = ("rgb_array", "human")


class CooperativeLocalisationEnv(ParallelEnv[str, Any, np.ndarray]):
    """Connected vehicles at an intersection, each estimating its own pose.

    Observation (per agent): a flat float32 Box whose entries `observation_layout` names, or a one-level Dict of the
    same fields. It holds only the vehicle's own measurements, received messages and estimates.

    Action (per agent): Box(-1, 1, (2,), float32): speed or acceleration, and steering (positive: left); with
    `[action.pan]` a third entry, the angle of the camera. Values beyond
    are clipped. Vehicles with prescribed motion ignore it.

    Reward: the weighted sum of the named terms in `info["reward_terms"]`, or what a function in Python returns.

    `terminated` on collision or arrival, `truncated` at the horizon, or where the backend has no more ticks. A vehicle
    that has ended leaves `agents` and goes on observing and sending, so that its followers keep their neighbour; a
    driven one parks where it is, a prescribed motion goes on.

    Info: `truth`, `estimate`, `position_error` (m), `orientation_error` (deg), `visible` (target names), `nees`,
    `log_determinant`, `position_std` (m), `gramian_min_eigenvalue`, `reward_terms`, `time` (s), `outcome`, and of the
    camera ticks of this step `late_ticks`, which came late, and `missing_ticks`, in which nothing came from the
    vehicle: it has gone on with its last odometry. Truth that the backend does not know is NaN, and so is what follows
    from it.
    """

    def __init__(
        self,
        source: Scenario | Backend,
        name: str,
        *,
        render_mode: str | None = None,
        observation: Literal["flat", "dict"] = "flat",
        device: str = "cpu",
        dtype: str = "float32",
        reward: RewardFunction | None = None,
    ) -> None:
        """Build the world; use `coopenv.parallel_env` to build one by name."""
        self._arguments = {key: value for key, value in locals().items() if key != "self"}
        check_choice("render_mode", render_mode, (None, *RENDER_MODES))
        check_choice("observation", observation, ("flat", "dict"))
        backend = simulation_of(source) if isinstance(source, Scenario) else source
        self.scenario = scenario = backend.scenario
        self.render_mode = render_mode
        self.metadata = {
            "name": f"{name}_v0",
            "render_modes": list(RENDER_MODES),
            "render_fps": scenario.rates.decision,
            "is_parallelizable": True,
        }
        self.engine = Engine(scenario, 1, dtype, device, backend=backend, reward=reward)
        here = backend.capabilities.estimated
        names = scenario.vehicle_names
        self.possible_agents = [name for i, name in enumerate(names) if here is None or i in here]
        self._agents: list[str] = []
        self._np_random: np.random.Generator | None = None
        self._index = {agent: names.index(agent) for agent in self.possible_agents}
        self._flat = observation == "flat"
        layout = self.engine.layout
        space: spaces.Space[Any] = flat_space(layout) if self._flat else dict_space(layout)
        self.observation_spaces = {agent: space for agent in self.possible_agents}
        self.action_spaces = {agent: action_space(scenario) for agent in self.possible_agents}
        self.state_space = state_space(scenario)
        self._read_actions = ActionReader(self._index, self.engine)
        self._infos = InfoWriter(self.engine, scenario)
        self._pictures = Pictures(self.engine, scenario)

    @property
    def agents(self) -> list[str]:
        """Names of the vehicles that are under way."""
        return list(self._agents)

    @property
    def np_random(self) -> np.random.Generator:
        """A generator for wrappers, of the last seed given to `reset`; the world does not draw from it."""
        if self._np_random is None:
            self._np_random = seeding.np_random(None)[0]
        return self._np_random

    @property
    def observation_layout(self) -> Layout:
        """Name, slice, unit and scale of every field of the flat observation."""
        return self.engine.layout.copy()

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the agent's observation space, the same object at every call."""
        self._check_agent(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the agent's action space, the same object at every call."""
        self._check_agent(agent)
        return self.action_spaces[agent]

    def _check_agent(self, agent: str) -> None:
        if agent not in self._index:
            known = ", ".join(self.possible_agents)
            raise CoopenvError(f"unknown agent {shown(agent)}{suggest(str(agent), self._index)}; known: {known}")

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Start an episode.

        Args:
            seed: fixes the episode; None goes on with a new episode of the last seed (at first one for training is
                drawn). `coopenv.EVALUATION_SEEDS` are reserved for evaluation.
            options: `{"world": w}`: with a seed, be world w of a batch with that seed; `{"parameters": {name: factor}}`
                and `{"difficulty": d}` hold for all episodes from this one on, until they are given again (None: drawn
                again, and the scenario's level), see docs/draws.md. A backend that takes options of its own is given
                all of them instead.

        Raises:
            CoopenvError: the seed or an option is not what it must be.
        """
        first, own, parameters = 0, options or {}, None
        if self.engine.backend.capabilities.batched:
            wanted, own = checked_options(options, ("world", *SETTINGS), IGNORED_OPTIONS), {}
            first, parameters = world_number(wanted.get("world", 0)), world_parameters(wanted, 1, self.scenario)
        keys = None if seed is None else world_keys(seed, 1, first)
        if keys is not None:
            self._np_random = seeding.np_random(keys[0])[0]
        with self.engine.stopping():
            self.engine.reset(keys, options=own, parameters=parameters)
        ended = self.engine.view("ended")[0]
        self._agents = [agent for agent, i in self._index.items() if ended[i] != ABSENT]
        if self.render_mode == "human":
            self.render()
        return self._observations(self._agents), self._infos(self._agents)

    def step(
        self, actions: Mapping[str, np.ndarray]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Drive for one decision period.

        Raises:
            ActionError: an action is missing, unknown, of the wrong shape, or not finite.
            CoopenvError: `reset` has not been called.
        """
        self.engine.check_begun()
        alive = self._agents
        if not alive:
            return {}, {}, {}, {}, {}
        with self.engine.stopping():
            self.engine.step(self._read_actions(actions, alive))
        indices = [self._index[agent] for agent in alive]
        values = (self.engine.view(name)[0].tolist() for name in ("reward", "terminated", "truncated"))
        rewards, terminated, truncated = (dict(zip(alive, [of[i] for i in indices], strict=True)) for of in values)
        result = self._observations(alive), rewards, terminated, truncated, self._infos(alive)
        self._agents = [agent for agent in alive if not (terminated[agent] or truncated[agent])]
        if not self._agents and self.engine.backend.capabilities.real_time:
            self.engine.backend.stop(EPISODE_OVER)
        if self.render_mode == "human":
            self.render()
        return result

    def _observations(self, agents: list[str]) -> Observations:
        rows = self.engine.view("observation")[0].copy()
        if self._flat:
            return {agent: rows[self._index[agent]] for agent in agents}
        layout = self.engine.layout
        return {
            agent: {name: rows[self._index[agent], field.slice] for name, field in layout.items()} for agent in agents
        }

    @property
    def health(self) -> Health:
        """Counts of data that the backend has delivered, and of data that is missing."""
        return self.engine.backend.health

    def state(self) -> np.ndarray:
        """Return the truth and the estimates of all vehicles as one vector, see `state_vector`."""
        return state_vector(self.engine)

    def render(self) -> np.ndarray | None:
        """Draw the top view: an (H, W, 3) uint8 picture for `rgb_array`, a window for `human`."""
        if self.render_mode is None:
            return None
        if self.render_mode == "human":
            self._pictures.show()
            return None
        return self._pictures.of()

    def close(self) -> None:
        """Stop the backend's vehicles, let go of it, and close the window, if any."""
        self.engine.close()
        self._pictures.close()

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next step depends on, random streams included; see `set_state`."""
        own = {"agents": list(self._agents), "scenario": self.scenario}
        return {**own, **self.engine.get_state()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`, of this or an equal environment.

        A state is data except for plug-in observers, which are objects: a pickled state of unknown origin is as
        dangerous as any pickle.

        Raises:
            CoopenvError: it is of another kind of environment, or not valid; nothing has changed then.
        """
        where = f"this state does not fit {self.metadata['name']}"
        if not isinstance(state, Mapping):
            raise CoopenvError(f"{where}: not a mapping, but {type(state).__name__}")
        if state.get("scenario") != self.scenario:
            raise CoopenvError(f"{where}: it is of another scenario")
        agents: Any = state.get("agents")
        plain = isinstance(agents, list) and all(isinstance(agent, str) for agent in agents)
        if not plain or agents != [agent for agent in self.possible_agents if agent in agents]:
            raise CoopenvError(f"{where}: its agents are {shown(agents)}, not some of {shown(self.possible_agents)}")
        try:
            self.engine.set_state(state)
        except CoopenvError as error:
            raise CoopenvError(f"{where}: {error}") from None
        self._agents = list(agents)

    def __getstate__(self) -> dict[str, Any]:
        return {"arguments": self._arguments, "state": self.get_state()}

    def __setstate__(self, saved: dict[str, Any]) -> None:
        self.__init__(**saved["arguments"])  # type: ignore[misc]
        self.set_state(saved["state"])
