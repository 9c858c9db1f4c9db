"""Actions of a policy in training: steering, once a decision, or letters of an alphabet, each kept for a while."""

from typing import Any

import numpy as np
from torch import Tensor, nn

from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.base.errors import CoopenvError
from coopenv.policies import Policy, decide, load_agent
from coopenv.policies.choice_rows import ChoiceRows
from coopenv.policies.choices import Choices, choices_of
from coopenv.scenario import Scenario


class Steering:
    """The actions of the environment, (rows, A) in [-1, 1]."""

    choices: Choices | None = None
    """A driver that follows what a policy chooses; None: the environment does."""

    def teacher(self, agent: str, scenario: Scenario) -> Policy:
        """Load an agent to learn from. Raises CoopenvError: it cannot drive there, or does not choose such actions."""
        return load_agent(agent, scenario)

    def batch(
        self, scenario: Scenario, name: str, worlds: int, threads: int | None, teacher: Policy | None = None
    ) -> Any:
        """Return a batch with these actions to learn in, or to watch a teacher in."""
        mode = "disabled" if teacher or self.choices else "same_step"
        env = CooperativeVectorEnv(scenario, name, num_worlds=worlds, autoreset=mode, arrays="numpy", threads=threads)
        return env

    def chosen(self, policy: Policy, observations: np.ndarray, scenario: Scenario) -> np.ndarray:
        """Return the actions that a policy chooses for observations (rows, D)."""
        return decide(policy, observations, scenario.action_size)

    def perturbed(self, actions: np.ndarray, noise: float, generator: np.random.Generator) -> np.ndarray:
        """Return actions with added noise of a standard deviation."""
        drawn = generator.standard_normal(actions.shape)
        return np.clip(actions + noise * drawn, -1.0, 1.0).astype(np.float32)

    def loss(self, output: Tensor, actions: Tensor, smoothing: float) -> Tensor:
        """Return the loss of a clone for a network's output (rows, A): the mean squared error."""
        return nn.functional.mse_loss(output, actions)


class Letters(Steering):
    """Letters of an alphabet, (rows,); a driver steers in between."""

    choices: Choices

    def __init__(self, scenario: Scenario) -> None:
        """Build the driver. Raises CoopenvError: the observation lacks what it reads."""
        try:
            self.choices = Choices(scenario)
        except ValueError as error:
            raise CoopenvError(f"actions: choices: {error}") from None

    def teacher(self, agent: str, scenario: Scenario) -> Policy:
        """See `Steering.teacher`."""
        policy = super().teacher(agent, scenario)
        if not self.choices.matches(choices_of(policy)):
            raise CoopenvError(f"clone.agent: {agent} does not choose letters of actions = 'choices'")
        return policy

    def batch(self, scenario: Scenario, *options: Any) -> Any:
        """See `Steering.batch`; a teacher drives, and so knows which letters are taken."""
        driver = choices_of(options[-1]) or Choices(scenario)
        return ChoiceRows(super().batch(scenario, *options), driver)

    def chosen(self, policy: Any, observations: np.ndarray, scenario: Scenario) -> np.ndarray:
        """See `Steering.chosen`."""
        choices: Any = choices_of(policy)
        return np.asarray(choices.letters(observations))

    def perturbed(self, actions: np.ndarray, noise: float, generator: np.random.Generator) -> np.ndarray:
        """Return letters of which a share is drawn uniformly."""
        drawn = generator.integers(len(self.choices.alphabet), size=len(actions))
        return np.where(generator.random(len(actions)) < noise, drawn, actions)

    def loss(self, output: Tensor, actions: Tensor, smoothing: float) -> Tensor:
        """Return the cross entropy of logits (rows, K), a share of it by all letters alike (Szegedy et al. 2016)."""
        return nn.functional.cross_entropy(output, actions.long(), label_smoothing=smoothing)


def actions_of(name: str, scenario: Scenario) -> Steering:
    """Return the actions of settings. Raises CoopenvError: see `Letters`."""
    return Letters(scenario) if name == "choices" else Steering()
