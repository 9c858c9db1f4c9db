"""One training: the batch, Stable-Baselines3's PPO on it, and how far it is. Needs the extra `train`."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic, process_time
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger, configure

from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv
from coopenv.api.trainers.sb3_buffer import ActingRowsBuffer
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.base.errors import CoopenvError
from coopenv.evaluation.episodes import driven_vehicles
from coopenv.scenario import Scenario
from coopenv.training.cloning import clone
from coopenv.training.environment_file import environment_file
from coopenv.training.normalised import NormalisedEnv
from coopenv.training.settings import Plan
from coopenv.training.watch import Status, Watch

TORCH_REFUSES = "Expected parameter"
"""So begins what torch says of a distribution whose parameters are not finite."""


class DivergedError(CoopenvError):
    """What was learnt is not finite."""


class Trainer:
    """A policy that all vehicles share, and everything that its next update depends on."""

    def __init__(self, plan: Plan, scenario: Scenario, threads: int | None = None) -> None:
        """Build worlds and networks.

        Args:
            plan: what to train.
            scenario: of the environment, the plan's overrides applied.
            threads: shares of the batch on the CPU.
        """
        torch.set_num_threads(1)  # small matrices: more threads mostly wait for one another and for the worlds'
        self.plan, self.scenario = plan, scenario
        self.environment = environment_file(plan.environment)
        ppo = plan.settings.ppo
        rows = CooperativeVectorEnv(
            scenario,
            plan.environment,
            num_worlds=max(1, ppo.vehicles // len(driven_vehicles(scenario))),
            autoreset="same_step",
            arrays="numpy",
            threads=threads,
        )
        self.batch = CooperativeSB3VecEnv(rows)
        self.env = NormalisedEnv(self.batch, ppo.observation_clip, ppo.reward_scale)
        self._rollout = ppo.decisions * self.env.num_envs
        self._share, self._seconds, self.cpu_seconds = 0.0, 0.0, 0.0
        widths = list(ppo.hidden)
        self.model = PPO(
            "MlpPolicy",
            self.env,
            learning_rate=lambda _: ppo.learning_rate * (1.0 - self._share),
            n_steps=ppo.decisions,
            batch_size=max(2, self._rollout // ppo.minibatches),
            n_epochs=ppo.epochs,
            gamma=ppo.gamma,
            gae_lambda=ppo.gae_lambda,
            clip_range=ppo.clip,
            ent_coef=ppo.entropy,
            vf_coef=ppo.value_weight,
            max_grad_norm=ppo.max_gradient,
            rollout_buffer_class=ActingRowsBuffer,
            rollout_buffer_kwargs={"rows": self.batch},
            policy_kwargs={
                "net_arch": {"pi": widths, "vf": widths},
                "log_std_init": math.log(ppo.initial_std),
                "optimizer_kwargs": {"eps": 1e-5},
            },
            seed=plan.seed,
            device="cpu",
        )
        self.model.set_logger(Logger(None, []))
        self._watch = Watch(self.batch)

    def log_to(self, folder: str) -> None:
        """Write for TensorBoard from now on, to a folder that is there."""
        self.model.set_logger(configure(folder, ["tensorboard"]))

    def begin(self, tell: Callable[[str], None] = lambda line: None) -> None:
        """Clone another driver, where the settings say so, and start the first episodes; `tell` hears how far it is."""
        settings = self.plan.settings
        if settings.clone is not None:
            clone(
                *(self.model.policy, self.env, settings.clone),
                gamma=settings.ppo.gamma,
                reward_scale=settings.ppo.reward_scale,
                seed=self.plan.seed,
                tell=tell,
            )
        self.env.start()

    def update(self) -> Status:
        """Collect one rollout and learn from it.

        Raises:
            DivergedError: the policy is no longer finite.
        """
        begin, cpu_begin = monotonic(), process_time()
        self._share = self._spent()
        with self._finite():
            self.model.learn(self._rollout, callback=self._watch, reset_num_timesteps=False)
        self._seconds += monotonic() - begin
        self.cpu_seconds += process_time() - cpu_begin
        return self.status

    def mean_action(self, observations: np.ndarray) -> np.ndarray:
        """Return what the policy does without exploring, (rows, A), where it observes (rows, D).

        Raises:
            DivergedError: it is not finite.
        """
        with self._finite():
            return np.asarray(self.model.predict(self.env.normalise(observations), deterministic=True)[0])

    @contextmanager
    def _finite(self) -> Iterator[None]:
        """Say in one line that a policy is no longer finite, which torch finds out when it draws actions, or nobody."""
        try:
            yield
        except ValueError as error:
            if not str(error).startswith(TORCH_REFUSES):
                raise
            raise self._diverged() from None
        if not all(bool(values.isfinite().all()) for values in self.model.policy.parameters()):
            raise self._diverged()

    def _diverged(self) -> DivergedError:
        names = ("learning_rate", "initial_std", "reward_scale", "max_gradient")
        told = [f"ppo.{name} = {getattr(self.plan.settings.ppo, name):g}" for name in names]
        when = f"after {self.model.num_timesteps} steps the policy is not finite"
        return DivergedError(f"the training diverged: {when}; look at {', '.join(told)}")

    @property
    def status(self) -> Status:
        """How far the training is."""
        return Status(self.model.num_timesteps, self._seconds, self._spent(), self._watch.figures())

    def _spent(self) -> float:
        steps, seconds = self.plan.settings.budget
        return min(1.0, self.model.num_timesteps / steps if steps else self._seconds / (seconds or math.inf))

    def progress(self) -> dict[str, Any]:
        """Return how far it is as plain data, for `continue_at`."""
        return {"steps": self.model.num_timesteps, "seconds": self._seconds, "cpu_seconds": self.cpu_seconds}

    def continue_at(self, steps: int, seconds: float, cpu_seconds: float) -> None:
        """Count on from there."""
        self.model.num_timesteps, self._seconds, self.cpu_seconds = steps, seconds, cpu_seconds

    def record(self, figures: dict[str, float]) -> None:
        """Write figures of the mean action on held-out maps for TensorBoard."""
        for name, value in figures.items():
            self.model.logger.record(f"held_out/{name}", value)
        self.model.logger.dump(self.model.num_timesteps)

    def close(self) -> None:
        """End the threads and the log."""
        self.model.logger.close()
        self.env.close()
