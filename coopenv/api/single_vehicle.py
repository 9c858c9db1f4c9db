"""One vehicle of an environment as an environment of Gymnasium, in which an agent drives the others."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from coopenv.api.make import parallel_env
from coopenv.api.parallel_env import RENDER_MODES, AgentInfo, CooperativeLocalisationEnv
from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.base.installation import load_reference
from coopenv.policies.base import Policy, decide, restart
from coopenv.scenario import ScenarioLike

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

MOST_EPISODES = 1000


class SingleVehicleEnv(gymnasium.Env[Any, np.ndarray]):
    """One vehicle of a `CooperativeLocalisationEnv` as a single-agent environment."""

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012  (Gymnasium's convention)

    def __init__(
        self,
        name_or_path: ScenarioLike,
        *,
        vehicle: str | None = None,
        others: str | Policy | None = None,
        details: bool = False,
        **options: Any,
    ) -> None:
        """Build the environment.

        Args:
            name_or_path: as for `coopenv.parallel_env`.
            vehicle: the one that the action drives (None: the last driven one, which receives from most others).
            others: drives the other vehicles: what `find_agent` takes (None: `route_follower`, or where it cannot
                drive, straight on).
            details: let infos of Gymnasium's vectors hold estimate, truth and reward terms as well; infos of a single
                environment have them under their names anyway.
            **options: the other arguments of `coopenv.parallel_env`.

        Raises:
            CoopenvError: no such vehicle, or no such agent.
        """
        self._spec: EnvSpec | None = None
        self._info_kind = dict if details else AgentInfo
        self.world: CooperativeLocalisationEnv = parallel_env(name_or_path, **options)
        names, scenario = self.world.possible_agents, self.world.scenario
        self.vehicle = names[-1] if vehicle is None else vehicle
        check_one_of("unknown vehicle", self.vehicle, names)
        driver_of = load_reference("coopenv.policies.loader:driver_of")  # policies stand on environments
        self._others: Policy = driver_of(others, scenario)
        self.render_mode, self.scenario = self.world.render_mode, scenario
        self.metadata = dict(self.world.metadata)
        self.observation_space = self.world.observation_space(self.vehicle)
        self.action_space = self.world.action_space(self.vehicle)

    @property
    def spec(self) -> EnvSpec | None:
        """The specification in Gymnasium's registry, with the horizon in decisions as `max_episode_steps`."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = replace(spec, max_episode_steps=self.scenario.decisions)
        self._spec = spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, see `CooperativeLocalisationEnv.reset`."""
        super().reset(seed=seed)
        observations, infos = self.world.reset(seed=seed, options=options)
        for _ in range(MOST_EPISODES):
            if self.vehicle in infos:
                break
            observations, infos = self.world.reset()  # an episode without it
        else:
            raise CoopenvError(f"{self.vehicle} was absent in {MOST_EPISODES} episodes running")
        restart(self._others, np.ones(len(self.scenario.vehicles), dtype=bool))
        return observations[self.vehicle], self._info_kind(infos[self.vehicle])

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive the vehicle for one decision period.

        Raises:
            ActionError: the action has the wrong shape or is not finite.
        """
        actions = {agent: action for agent in self.world.agents if agent == self.vehicle}
        if others := [agent for agent in self.world.agents if agent != self.vehicle]:
            observed, width = self.world.engine.view("observation")[0], self.scenario.action_size
            chosen = dict(zip(self.scenario.vehicle_names, decide(self._others, observed, width), strict=True))
            actions.update({agent: chosen[agent] for agent in others})
        observations, rewards, terminated, truncated, infos = self.world.step(actions)
        v = self.vehicle
        if v not in rewards:
            raise CoopenvError(f"step() called although {v} has ended; call reset()")
        return observations[v], rewards[v], terminated[v], truncated[v], self._info_kind(infos[v])

    def render(self) -> Any:
        """Draw the top view."""
        return self.world.render()

    def close(self) -> None:
        """Close the window, if any."""
        self.world.close()
