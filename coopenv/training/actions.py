"""What a policy in training chooses: steering, once a decision, or letters of an alphabet, each kept for a while."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.base.errors import CoopenvError
from coopenv.policies import Policy, decide, load_agent
from coopenv.policies.choice_rows import ChoiceRows
from coopenv.policies.choices import STEERING, Choices, choices_of, load_choices
from coopenv.scenario import Scenario

DRIVER = "driver."
"""Beginning of the names of a driver's arrays in the state of a batch."""


class Steering:
    """The actions of the environment, (rows, A) in [-1, 1]."""

    kept = 1
    """Decisions for which an action is kept."""

    def driver(self, scenario: Scenario) -> Choices | None:
        """Return the driver that follows what a policy chooses; None: the environment does."""
        return None

    def teacher(self, agent: str, scenario: Scenario) -> Policy:
        """Load an agent to learn from. Raises CoopenvError: it cannot drive there, or does not choose such actions."""
        return load_agent(agent, scenario)

    def rows(self, teacher: Policy, scenario: Scenario, worlds: int, threads: int | None) -> Any:
        """Return a batch to watch a teacher in."""
        return CooperativeVectorEnv(scenario, "clone", num_worlds=worlds, autoreset="disabled", threads=threads)

    def batch(self, scenario: Scenario, name: str, worlds: int, threads: int | None) -> CooperativeSB3VecEnv:
        """Return a batch to learn in."""
        options: dict[str, Any] = {"autoreset": "same_step", "arrays": "numpy", "threads": threads}
        return CooperativeSB3VecEnv(CooperativeVectorEnv(scenario, name, num_worlds=worlds, **options))

    def chosen(self, policy: Policy, observations: np.ndarray, scenario: Scenario) -> np.ndarray:
        """Return the actions that a policy chooses for observations (rows, D)."""
        return decide(policy, observations, scenario.action_size)

    def perturbed(self, actions: np.ndarray, noise: float, generator: np.random.Generator) -> np.ndarray:
        """Return actions with added noise of a standard deviation."""
        drawn = generator.standard_normal(actions.shape)
        return np.clip(actions + noise * drawn, -1.0, 1.0).astype(np.float32)

    def aims(self, actions: np.ndarray, smoothing: float) -> np.ndarray:
        """Return the targets of a clone."""
        return actions


class Letters(Steering):
    """Letters of the alphabet of a `Choices`, (rows,); the driver steers in between."""

    def __init__(self, name: str, scenario: Scenario) -> None:
        """Take the alphabet by its name. Raises CoopenvError: see `load_choices`."""
        self._name = name
        self._own = load_choices(name, scenario)
        self.kept = self._own.kept

    def driver(self, scenario: Scenario) -> Choices:
        """See `Steering.driver`."""
        return load_choices(self._name, scenario)

    def teacher(self, agent: str, scenario: Scenario) -> Policy:
        """See `Steering.teacher`."""
        policy = super().teacher(agent, scenario)
        choices = choices_of(policy)
        if choices is None or not choices.matches(self._own):
            raise CoopenvError(f"clone.agent: {agent} does not choose letters of actions = '{self._name}'")
        return policy

    def rows(self, teacher: Policy, scenario: Scenario, worlds: int, threads: int | None) -> ChoiceRows:
        """See `Steering.rows`; the teacher knows by it which letters are taken."""
        return ChoiceRows(super().rows(teacher, scenario, worlds, threads), choices_of(teacher))

    def batch(self, scenario: Scenario, name: str, worlds: int, threads: int | None) -> CooperativeSB3VecEnv:
        """See `Steering.batch`."""
        env = CooperativeVectorEnv(scenario, name, num_worlds=worlds, autoreset="disabled", threads=threads)
        return LetterRows(ChoiceRows(env, self.driver(scenario)))  # type: ignore[arg-type]

    def chosen(self, policy: Policy, observations: np.ndarray, scenario: Scenario) -> np.ndarray:
        """See `Steering.chosen`."""
        choices = choices_of(policy)
        assert choices is not None
        return choices.letters(observations)

    def perturbed(self, actions: np.ndarray, noise: float, generator: np.random.Generator) -> np.ndarray:
        """Return letters of which a share is drawn uniformly."""
        drawn = generator.integers(len(self._own.alphabet), size=len(actions))
        return np.where(generator.random(len(actions)) < noise, drawn, actions)

    def aims(self, actions: np.ndarray, smoothing: float) -> np.ndarray:
        """Return smoothed shares of all letters, (rows, K) (Szegedy et al. 2016)."""
        count = len(self._own.alphabet)
        return np.asarray(smoothing / count + (1.0 - smoothing) * np.eye(count)[actions])


class LetterRows(CooperativeSB3VecEnv):
    """Rows that choose letters; what their driver remembers is part of their state."""

    envs: Any

    def get_state(self) -> dict[str, np.ndarray]:
        """See `CooperativeSB3VecEnv.get_state`."""
        remembered = {f"{DRIVER}{i}": values for i, values in enumerate(self.envs.driver.state)}
        return {**super().get_state(), **remembered}

    def set_state(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
        """See `CooperativeSB3VecEnv.set_state`."""
        rest = dict(state)
        self.envs.driver.state = [rest.pop(f"{DRIVER}{i}").copy() for i in range(len(self.envs.driver.state))]
        return super().set_state(rest)


def actions_of(name: str, scenario: Scenario) -> Steering:
    """Return the kind of actions of settings. Raises CoopenvError: see `load_choices`."""
    return Steering() if name == STEERING else Letters(name, scenario)
