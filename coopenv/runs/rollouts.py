"""Run one world by decisions of a policy and record it at every camera tick."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from coopenv.api.arguments import outcome_words
from coopenv.api.engine import Engine
from coopenv.backends.base import EPISODE_OVER, Backend
from coopenv.base.errors import CoopenvError
from coopenv.estimation.outcomes import Sight
from coopenv.estimation.trajectory import Trajectory
from coopenv.policies import Policy, load_policy
from coopenv.runs.episode import Views, estimated_here, play
from coopenv.scenario import Scenario, load_scenario

RECORDED = (
    *("position", "rotation", "velocity", "angular_velocity", "estimate_rotation", "estimate_position"),
    *("covariance", "position_error", "orientation_error", "nees", "sight", "terms", "ended"),
)
"""Views of the engine that are kept of every camera tick."""


class Ending(NamedTuple):
    """How a vehicle's run ended: in the words of infos, and when, s (`under way`: the end of the record)."""

    outcome: str
    time: float


class Rollout:
    """One world, its policy, and all that has been recorded so far."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int = 0,
        steps: int | None = None,
        dtype: str = "float64",
        device: str = "cpu",
        policy: str | Policy = "zero",
        backend: Backend | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Build the world; arguments as for `rollout`, but for those of its ticks.

        `backend` is where they come from (None: simulated), and `options` what it is told at the reset.
        """
        if steps is not None and steps < 1:
            raise CoopenvError(f"steps must be at least 1, got {steps}")
        self.engine = Engine(scenario, 1, dtype, device, backend=backend)
        self.scenario, self.seed = self.engine.backend.scenario, seed
        self.policy = load_policy(policy, scenario, seed) if isinstance(policy, str) else policy
        self.policy_name = policy if isinstance(policy, str) else getattr(policy, "__name__", "custom")
        if self.engine.backend.capabilities.recorded:  # whoever drove then
            self.policy_name = "recorded"
        self.ticks_planned = scenario.horizon_ticks
        if steps is not None:
            self.ticks_planned = min(self.ticks_planned, steps * scenario.ticks_per_decision)
        self.wall_time = 0.0
        self._options = options
        self._views = Views(self.engine, RECORDED)

    @property
    def vehicles(self) -> tuple[int, ...]:
        """The vehicles that are estimated here, which tables and figures of errors are about."""
        return estimated_here(self.engine)

    @property
    def ticks_recorded(self) -> int:
        """Camera ticks since t = 0 that have been recorded."""
        return max(0, self._views.taken - 1)

    def play(self) -> Iterator[int]:
        """Start the episode and yield the number of each camera tick, from 0, once it is recorded.

        The run ends at the horizon, after `steps` decisions, or with the decision in which the last vehicle that is
        estimated here ended.
        `wall_time` (s) counts what is spent in here, not what the caller does between two ticks.
        """
        start = perf_counter()
        self._views = Views(self.engine, RECORDED)
        self.wall_time = 0.0
        moments = play(self.engine, [self.seed], self.ticks_planned, self.policy, False, self._options)
        for tick in moments:
            self._views.take()
            self.wall_time += perf_counter() - start
            yield tick
            start = perf_counter()
        if self.engine.backend.capabilities.real_time:
            self.engine.backend.stop(EPISODE_OVER)

    def _recorded(self, name: str) -> np.ndarray:
        """Return (K, ...) of one view."""
        return self._views[name][:, 0]

    def trajectory(self) -> Trajectory:
        """Return what has been recorded so far; `play` must have yielded at least once."""
        L, recorded = len(self.scenario.landmarks), self._recorded
        rotation_estimate, sight = recorded("estimate_rotation"), recorded("sight")
        moving = [landmark.motion.kind != "static" for landmark in self.scenario.landmarks]
        return Trajectory(
            t=np.arange(len(sight)) / self.scenario.rates.camera,
            position_estimate=(rotation_estimate @ recorded("estimate_position")[..., None])[..., 0],
            rotation_estimate=rotation_estimate,
            target_position=recorded("position"),
            visible=sight == Sight.VISIBLE,
            sight=sight,
            reward_terms=recorded("terms"),
            terms=np.array(self.engine.reward_terms),
            vehicles=np.array(self.scenario.vehicle_names),
            targets=np.array(self.scenario.target_names),
            target_moving=np.array([*moving, *(True for _ in self.scenario.vehicles)]),
            **{name: recorded(name) for name in ("position_error", "orientation_error", "covariance", "nees")},
            **{name: recorded(name)[:, L:] for name in ("position", "rotation", "velocity", "angular_velocity")},
        )

    def endings(self) -> list[Ending]:
        """Return how the run of each vehicle that is estimated here has ended so far."""
        ended = self._recorded("ended")[:, [*self.vehicles]]
        first = np.where(ended.any(axis=0), np.argmax(ended != 0, axis=0), len(ended) - 1)
        words, times = outcome_words(self.scenario), (first / self.scenario.rates.camera).tolist()
        return [Ending(words[outcome], time) for outcome, time in zip(ended[-1].tolist(), times, strict=True)]


def rollout(
    scenario: Scenario | str | Path,
    seed: int = 0,
    steps: int | None = None,
    dtype: str = "float64",
    device: str = "cpu",
    policy: str | Policy = "zero",
    on_tick: Callable[[Engine, int], None] | None = None,
) -> Trajectory:
    """Run one episode and return its record, every camera tick from t = 0.

        trajectory = rollout(coopenv.load_scenario("busy_intersection"), seed=3)

    Args:
        scenario: the world, or the name or the TOML file of one.
        seed: of all that is drawn: starts, noise, losses, and the actions of the policy "random".
        steps: decisions (None: up to the horizon, where a run ends in any case).
        dtype: "float32" or "float64".
        device: "cpu" or a CUDA device.
        policy: "zero", "random", an agent's name, or a function of the observations (N, D) that returns actions
            (N, A); vehicles with prescribed motion ignore their actions.
        on_tick: called with the engine and the tick's number after every tick, 0 included.

    Raises:
        CoopenvError: an argument is not valid.
    """
    run = Rollout(load_scenario(scenario), seed, steps, dtype, device, policy)
    for tick in run.play():
        if on_tick is not None:
            on_tick(run.engine, tick)
    return run.trajectory()
