"""The Gymnasium environment: one vehicle is the agent, the others follow a fixed rule."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from coopenv.api.make import parallel_env
from coopenv.api.parallel_env import RENDER_MODES, CooperativeLocalisationEnv
from coopenv.base.errors import CoopenvError, suggest

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
        if vehicle not in names:
            raise CoopenvError(f"unknown vehicle '{vehicle}'{suggest(str(vehicle), names)}; known: {', '.join(names)}")
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
