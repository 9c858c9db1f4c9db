"""The PettingZoo environment: one world, dictionaries keyed by agent; and a wrapper that keeps numeric infos."""

import warnings
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv

from coopenv.api.arguments import (
    QUALITIES,
    SETTINGS,
    STATE_LIMIT,
    Info,
    RewardFunction,
    Step,
    checked_options,
    outcome_words,
    world_parameters,
    world_states,
)
from coopenv.api.engine import Engine
from coopenv.api.saved import NO_PICTURE, RENDER_HINT, Saved
from coopenv.api.terms.layout import action_space, observation_space
from coopenv.base.errors import ActionError, CoopenvError, check_one_of, explained, shown, suggest
from coopenv.base.seeds import world_keys
from coopenv.scenario import Scenario
from coopenv.sources.base import EPISODE_OVER, IGNORED_OPTIONS, Backend, Broadcasting, Health
from coopenv.sources.sources import simulation_of
from coopenv.world.reset import ABSENT
from coopenv.world.state import FAULTS, LASTING_ERRORS

Observations = dict[str, Any]
Infos = dict[str, Info]

DETAILS = ("truth", "estimate", "visible", "reward_terms", "outcome", "car")
"""Entries of an info that are no numbers, but tables and words."""


class AgentInfo(dict[str, Any]):
    """An `Info` with all of its entries, whose `items()` are the numbers alone: trainers make tensors of them."""

    def items(self) -> Any:
        """Return the entries that are numbers, the same ones at every step."""
        return {name: self[name] for name in self if name not in DETAILS}.items()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy all entries."""
        return AgentInfo, (dict(self),)


RENDER_MODES = ("rgb_array", "human")


class CooperativeLocalisationEnv(Saved, ParallelEnv[str, Any, np.ndarray]):
    """Connected vehicles at an intersection, each estimating its own pose.

    Observation (per agent): a flat float32 Box whose entries `observation_layout` names, or a one-level Dict of the
    same fields. It holds only the vehicle's own measurements, received messages and estimates.

    Action (per agent): Box(-1, 1, (2,), float32): columns of its drive, such as speed or acceleration, and
    steering (positive: left); with `[action.pan]` a further entry, the angle of the camera. Values beyond are clipped.

    Agents are the vehicles that actions drive. Where all motion is prescribed, every vehicle is an agent whose actions
    have no effect.

    Reward: the weighted sum of the named terms in `info["reward_terms"]`, or what a function in Python returns.

    `terminated` on collision or arrival, `truncated` at the horizon, or where the backend has no more ticks. A vehicle
    that has ended leaves `agents` and goes on observing and sending, so that its followers keep their neighbour; a
    driven one parks where it is, a prescribed motion goes on.

    Info (per agent): see `coopenv.api.arguments.Info`. Truth that the backend does not know is NaN, and so is what
    follows from it.
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
        check_one_of("unknown render_mode", render_mode, (None, *RENDER_MODES))
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
        names = scenario.vehicle_names
        self.possible_agents = [names[i] for i in scenario.agents(backend.capabilities.estimated)]
        if not self.possible_agents:
            raise CoopenvError("vehicles.*.motion.driver: every vehicle has a driver, no agent is left")
        self._agents: list[str] = []
        self._np_random: np.random.Generator | None = None
        self._index = {agent: names.index(agent) for agent in self.possible_agents}
        self._flat = observation == "flat"
        space = observation_space(self.engine.layout, observation)
        self.observation_spaces = {agent: space for agent in self.possible_agents}
        self.action_spaces = {agent: action_space(scenario) for agent in self.possible_agents}
        state = world_states(self.engine.view, self.scenario)[0]
        self.state_space = spaces.Box(-STATE_LIMIT, STATE_LIMIT, shape=state.shape, dtype=np.float32)
        self._step, self._outcomes = Step(self.engine.view, scenario), outcome_words(scenario)
        self._targets = scenario.target_names  # made once, as every step needs both
        self._notes = backend.notes if isinstance(backend, Broadcasting) else None
        errors = {
            (*LASTING_ERRORS, "camera_focal"): scenario.has_lasting_errors,
            ("camera_delay",): any(camera.is_late for camera in scenario.cameras),
            FAULTS: any(faults.any for faults in scenario.all_faults),
        }
        self._lasting = [name for names, there in errors.items() if there for name in names]

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

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the agent's observation space, the same object at every call."""
        check_one_of("unknown agent", agent, self._index)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the agent's action space, the same object at every call."""
        check_one_of("unknown agent", agent, self._index)
        return self.action_spaces[agent]

    @explained
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
            first, parameters = wanted.get("world", 0), world_parameters(wanted, 1, self.scenario)
            if isinstance(first, bool) or not isinstance(first, int | np.integer) or not 0 <= first < 2**32:
                raise CoopenvError(f"option 'world' must be a whole number from 0 to 2^32 - 1, got {shown(first)}")
        keys = None if seed is None else world_keys(seed, 1, int(first))
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
        self.engine.check_begun("step")
        alive = self._agents
        if not alive:
            return {}, {}, {}, {}, {}
        with self.engine.stopping():
            self.engine.step(self._checked_actions(actions, alive))
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
        parts = self.engine.layout.parts
        return {agent: {name: rows[self._index[agent], place] for name, place in parts.items()} for agent in agents}

    def _infos(self, agents: list[str]) -> Infos:
        """Return one info per agent, always with the same keys."""
        engine, view, step = self.engine, self.engine.view, self._step
        truth = {name: values[0].copy() for name, values in step["truth"].items()}
        truth |= {name: view(name)[0].copy() for name in self._lasting}
        estimate = {name: values[0].copy() for name, values in step["estimate"].items()}
        numbers = {name: view(name)[0].tolist() for name in QUALITIES}
        ended, terms = view("ended")[0].tolist(), view("terms")[0].tolist()
        seen: list[list[str]] = [[] for _ in ended]
        for i, target in zip(*(each.tolist() for each in np.nonzero(step["visible"][0])), strict=True):
            seen[i].append(self._targets[target])
        late, missing = engine.world.late.tolist(), engine.world.missing.tolist()
        time = float(step["time"][0, 0])
        infos: Any = {}
        for agent in agents:
            i = self._index[agent]
            infos[agent] = AgentInfo(
                truth={name: values[i] for name, values in truth.items()},
                estimate={name: values[i] for name, values in estimate.items()},
                visible=tuple(seen[i]),
                **{name: values[i] for name, values in numbers.items()},
                reward_terms=dict(zip(engine.reward_terms, terms[i], strict=True)),
                time=time,
                outcome=self._outcomes[ended[i]],
                late_ticks=late[i],
                missing_ticks=missing[i],
                **({"car": self._notes(i)} if self._notes else {}),
            )
        return dict(infos)

    def _checked_actions(self, actions: Mapping[str, np.ndarray], alive: list[str]) -> np.ndarray:
        """Return the actions (1, N, A); vehicles that have ended keep their last one, whatever is given.

        Raises:
            ActionError: an action is missing, unknown, of the wrong shape, or not finite.
        """
        if not isinstance(actions, Mapping):
            raise ActionError(f"actions must be a dict of agent to array, got {type(actions).__name__}")
        whole = self.engine.view("actions").copy()
        size = whole.shape[-1]
        try:
            values = np.array([actions[agent] for agent in alive])
        except (IndexError, KeyError, TypeError, ValueError, RuntimeError):
            values = np.empty(0)
        numeric = values.dtype.kind in "fiu" and values.shape == (len(alive), size)
        unknown = len(actions) != len(alive) and not set(actions) <= set(self._index)
        if not numeric or unknown or not np.isfinite(values).all():
            self._complain(actions, alive, size)
        whole[0, [self._index[agent] for agent in alive]] = np.clip(values, -1.0, 1.0)
        return whole

    def _complain(self, actions: Mapping[str, np.ndarray], alive: list[str], size: int) -> None:
        """Raise an error for the first agent or action that is wrong."""
        for agent in actions:
            if agent not in self._index:
                near = suggest(str(agent), self._index)
                raise ActionError(f"action for unknown agent '{agent}'{near}; agents: {', '.join(alive)}")
        for agent in alive:
            if agent not in actions:
                raise ActionError(f"no action for '{agent}'; agents: {', '.join(alive)}")
            try:
                value = np.asarray(actions[agent])
            except (TypeError, ValueError):
                value = np.array("?")
            if value.dtype.kind not in "fiu":
                raise ActionError(f"action of '{agent}' is not numeric: {actions[agent]!r}")
            if value.shape != (size,):
                raise ActionError(f"action of '{agent}' has shape {value.shape}, expected ({size},)")
            if not np.isfinite(value).all():
                raise ActionError(f"action of '{agent}' is not finite: {value.tolist()}")

    @property
    def health(self) -> Health:
        """Counts of data that the backend has delivered, and of data that is missing."""
        return self.engine.backend.health

    def state(self) -> np.ndarray:
        """Return the state for a central critic, (S,), with the truth; see `coopenv.api.arguments.world_states`."""
        self.engine.check_begun("state")
        return np.asarray(world_states(self.engine.view, self.scenario)[0])

    @partial(explained, hint=RENDER_HINT)
    def render(self) -> np.ndarray | None:
        """Draw the top view: an (H, W, 3) uint8 picture for `rgb_array`, a window for `human`."""
        if self.render_mode is None:
            warnings.warn(NO_PICTURE, stacklevel=2)
            return None
        self.engine.check_begun("render")
        picture = self.engine.picture()
        if self.render_mode == "human":
            self.engine.top_view.show(picture)
            return None
        return picture

    def close(self) -> None:
        """Stop the backend's vehicles, let go of it, and close the window, if any."""
        self.engine.close()

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next step depends on, random streams included; see `set_state`."""
        return {"agents": list(self._agents), **super().get_state()}

    def _restore(self, state: Mapping[str, Any]) -> None:
        agents: Any = state.get("agents")
        plain = isinstance(agents, list) and all(isinstance(agent, str) for agent in agents)
        if not plain or agents != [agent for agent in self.possible_agents if agent in agents]:
            raise CoopenvError(f"its agents are {shown(agents)}, not some of {shown(self.possible_agents)}")
        super()._restore(state)
        self._agents = list(agents)
