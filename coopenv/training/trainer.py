"""One training: the batch, Stable-Baselines3's PPO on it, and its progress. Needs the extra `train`."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, process_time
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import Tensor, nn

from coopenv.api.terms.layout import observation_layout
from coopenv.api.trainers.sb3 import ActingRowsBuffer, CooperativeSB3VecEnv, LeanPpo, TanhPolicy, network
from coopenv.base.errors import CoopenvError
from coopenv.policies import Policy, find_agent, restart
from coopenv.policies.alone import Alone
from coopenv.policies.choices import choices_of
from coopenv.policies.memory import MEMORY, PARTS
from coopenv.policies.network import CRITIC, NetworkPolicy, RightOfWay, layout_tables, load_weights
from coopenv.scenario import Scenario
from coopenv.scenario.terms import SETTLED_FROM
from coopenv.training.actions import Steering, actions_of
from coopenv.training.batches import APART, LEAST_VARIANCE, Arrays, MixedWorlds, NormalisedEnv
from coopenv.training.memory import RememberingEnv, RememberingPolicy, SequencesBuffer
from coopenv.training.settings import Clone, TrainingPlan


@dataclass(frozen=True)
class Status:
    """Progress of a training, and recent figures of the exploring policy."""

    steps: int
    """Decisions of vehicles so far."""
    seconds: float
    share: float
    """Share of the decisions to learn from, 0 to 1."""
    figures: dict[str, float]
    """`return`, `arrival_rate` and `collision_rate` over the last episode of every vehicle, as soon as each has one;
    `e50_m` and `e95_m` in the last rollout."""

    @property
    def line(self) -> str:
        """The status in a few words."""
        f = self.figures
        parts = [f"{self.steps / 1e6:.2f} M steps", f"{self.steps / max(self.seconds, 1e-9):,.0f}/s"]
        if "return" in f:
            parts += [f"return {f['return']:.1f}", f"arrived {f['arrival_rate']:.0%}", f"hit {f['collision_rate']:.0%}"]
        if "e95_m" in f:
            parts.append(f"e95 {100 * f['e95_m']:.0f} cm")
        return ", ".join(parts)


class Watch(BaseCallback):
    """Collects errors of the rollout and ends of episodes, and records both for TensorBoard.

    Every row counts once, whether its episodes are short or long: crashes end first.
    """

    def __init__(self, env: CooperativeSB3VecEnv) -> None:
        super().__init__()
        self._env = env
        self._errors: list[np.ndarray] = []
        self._begun, self._whole = np.zeros(env.num_envs, dtype=bool), False
        self._last: dict[int, dict[str, Any]] = {}

    def _on_step(self) -> bool:
        infos = self._env.batch_infos
        counts = self._env.acted & (infos["time"] > SETTLED_FROM)
        self._errors.append(infos["position_error"][counts])
        self._begun |= self._env.acted
        self._last |= {row: self.locals["infos"][row] for row in np.flatnonzero(self.locals["dones"]).tolist()}
        self._whole = self._whole or len(self._last) >= self._begun.sum()  # others may be absent at first
        return True

    def _on_rollout_end(self) -> None:
        for name, value in self.figures().items():
            self.logger.record(f"vehicles/{name}", value)
        ended = self._ended
        for name in self._env.engine.reward_terms if ended else ():
            self.logger.record(f"reward_terms/{name}", float(np.mean([info["reward_terms"][name] for info in ended])))

    @property
    def _ended(self) -> list[dict[str, Any]]:
        return [*self._last.values()] if self._whole else []

    def figures(self) -> dict[str, float]:
        """Return the figures of a `Status`."""
        found: dict[str, float] = {}
        errors = np.concatenate(self._errors) if self._errors else np.empty(0)
        if errors.size:
            found |= {"e50_m": float(np.median(errors)), "e95_m": float(np.percentile(errors, 95))}
        if ended := self._ended:
            outcomes = [info["outcome"] for info in ended]
            found["return"] = float(np.mean([info["episode"]["r"] for info in ended]))
            found["arrival_rate"] = outcomes.count("arrived") / len(outcomes)
            found["collision_rate"] = outcomes.count("collided") / len(outcomes)
        return found

    def _on_rollout_start(self) -> None:
        self._errors.clear()


COUNTS = f"{CRITIC}counts"
"""Tensor of an agent's weights: count of the observations; mean, variance and count of the returns."""
BATCH = 512  # rows per gradient step
LONGEST_ALONE = 0.25
"""Share of the steps, or of the minutes, from which on the policy learns, too, whatever the critic explains."""


def watch(
    scenario: Scenario,
    worlds: int,
    settings: Clone,
    gamma: float,
    seed: int,
    threads: int,
    report: Callable[[str], None],
    kind: Steering | None = None,
    rule: RightOfWay | None = None,
    clone: Policy | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return observations (rows, D), the driver's actions (rows, A) or letters (rows,), returns and vehicles (rows,).

    With a clone, it drives, and the driver's actions are those that it would have taken. Where the rule alone would
    slow the vehicle down as much, the speed is the largest one.
    """
    kind, name, noise = kind or Steering(), settings.agents[0], np.random.default_rng(seed)
    driver = kind.teacher(name, scenario)
    env = kind.batch(scenario, "clone", worlds, threads, driver)
    observation, _ = env.reset(seed=seed)
    restart(driver, np.ones(env.num_envs, dtype=bool))
    under_way = np.tile(scenario.acting, worlds)
    steps: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    while under_way.any():
        now = len(steps) * (kind.choices.kept if kind.choices else 1) / scenario.rates.decision
        report(f"watching {name}: {now:.0f} of {scenario.horizon:g} s")
        action = kind.chosen(driver, observation, scenario)
        tried = action if clone is None else kind.chosen(clone, observation, scenario)
        before, acted = observation, under_way
        observation, reward, terminated, truncated, _ = env.step(kind.perturbed(tried, settings.noise, noise))
        if rule:
            action[rule(before, np.ones_like(action))[:, 0] <= action[:, 0], 0] = 1.0
        steps.append((before, action, np.where(acted, reward, 0.0), acted))
        under_way = acted & ~(terminated | truncated)
    env.close()
    observations, chosen, rewards, acted = (np.stack(column) for column in zip(*steps, strict=True))
    returns, following = np.zeros_like(rewards), np.zeros(env.num_envs)
    for t in reversed(range(len(rewards))):
        returns[t] = following = rewards[t] + gamma * following
    vehicle = np.nonzero(acted)[1] % len(scenario.vehicles)
    return observations[acted], chosen[acted], returns[acted], vehicle


def regress(
    parameters: Iterable[nn.Parameter],
    columns: Sequence[Tensor],
    clone: Clone,
    seed: int,
    loss: Callable[..., Tensor],
    report: Callable[[str], None],
) -> None:
    """Minimise a loss, a function of the recorded columns (rows, ...), over minibatches of rows."""
    optimiser = torch.optim.Adam(parameters, clone.learning_rate)
    shuffle = torch.Generator().manual_seed(seed)
    for epoch in range(clone.epochs):
        optimiser.param_groups[0]["lr"] = clone.learning_rate * (1.0 - epoch / clone.epochs)
        report(f"learning from {clone.agents[0]}: pass {epoch + 1} of {clone.epochs}")
        for rows in torch.randperm(len(columns[0]), generator=shuffle).split(BATCH):
            optimiser.zero_grad()
            loss(*(values[rows] for values in columns)).backward()
            optimiser.step()


def tensors_of(name: str, scenario: Scenario, clip: float, actions: str = "steering") -> Arrays:
    """Return the tensors of a learned agent that a training with observations up to `clip` can continue.

    Raises:
        CoopenvError: there is no such agent, it is another kind of driver, or it observes otherwise.
    """
    agent, here = find_agent(name), layout_tables(observation_layout(scenario))
    if agent.folder is None or agent.network is None or not agent.network.observation:
        raise CoopenvError(f"start: {name} is no policy that PPO learns; clone.agent begins as any driver")
    theirs, ours = choices_of(agent.policy(scenario)), actions_of(actions, scenario).choices
    if not ours.matches(theirs) if ours else theirs:
        raise CoopenvError(f"start: {name} chooses other actions than actions = '{actions}': {agent.network.actions}")
    if (agent.network.observation, agent.network.action) != here:
        raise CoopenvError(f"start: {name} was trained with other fields or scales of the observation")
    if agent.network.clip != clip:
        raise CoopenvError(f"start: {name} needs ppo.observation_clip = {agent.network.clip:g}, got {clip:g}")
    return load_weights(agent.folder / agent.network.weights, agent.network.sha256)


TORCH_REFUSES = "Expected parameter"
"""Beginning of torch's error for a distribution with parameters that are not finite."""


class DivergedError(CoopenvError):
    """A learnt parameter is not finite."""


class Trainer:
    """A policy that all vehicles share, and everything that its next update depends on."""

    kinds: tuple[Any, Any, Any] = (LeanPpo, TanhPolicy, ActingRowsBuffer)
    """Classes of algorithm, policy and buffer, if the settings ask for no memory."""

    def __init__(self, plan: TrainingPlan, scenario: Scenario, threads: int | None = None) -> None:
        """Build worlds and networks.

        Args:
            plan: the plan of the training.
            scenario: of the environment, the plan's overrides applied.
            threads: shares of the batch on the CPU.
        """
        torch.set_num_threads(1)  # small matrices: more threads mostly wait for one another and for the worlds'
        self.plan, self.scenario = plan, scenario
        ppo = plan.settings.ppo
        self._scenarios = plan.scenarios(max(1, ppo.vehicles // sum(scenario.acting)))
        self.actions = actions_of(plan.settings.actions, scenario)
        batches = [self.actions.batch(each, plan.environment, count, threads) for each, count in self._scenarios]
        parts = [CooperativeSB3VecEnv(batch) for batch in batches]
        self.rule, rule = (RightOfWay(scenario) if plan.settings.right_of_way else None for _ in range(2))
        self.batch = parts[0] if len(parts) == 1 else MixedWorlds(parts)
        self.env = NormalisedEnv(self.batch, ppo, rule)
        self._rollout = ppo.decisions * self.env.num_envs
        self._share, self.seconds, self.cpu_seconds = 0.0, 0.0, 0.0
        self.gamma = ppo.discount(scenario) ** self.batch.kept
        """Discount per action."""
        widths = list(ppo.hidden)
        self.remembering = RememberingEnv(self.env, ppo.memory) if ppo.memory else None
        algorithm, policy, buffer = (LeanPpo, RememberingPolicy, SequencesBuffer) if ppo.memory else self.kinds
        self.model: Any = algorithm(
            policy,
            self.remembering or self.env,
            learning_rate=lambda _: ppo.learning_rate * (1.0 - self._share),
            n_steps=ppo.decisions,
            batch_size=max(2, self._rollout // ppo.minibatches),
            n_epochs=ppo.epochs,
            gamma=self.gamma,
            gae_lambda=ppo.gae_lambda,
            clip_range=ppo.clip,
            ent_coef=ppo.entropy,
            vf_coef=ppo.value_weight,
            max_grad_norm=ppo.max_gradient,
            rollout_buffer_class=buffer,
            rollout_buffer_kwargs={"rows": self.batch},
            policy_kwargs={
                "net_arch": {"pi": widths, "vf": widths},
                "log_std_init": math.log(ppo.initial_std),
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},
                **({"memory": ppo.memory} if ppo.memory else {}),
            },
            seed=plan.seed,
            device="cpu",
        )
        if self.remembering:
            self.remembering.cell, self.model.policy.buffer = self.model.policy.cell, self.model.rollout_buffer
        self.model.set_logger(Logger(None, []))
        self.env.settled = plan.settings.start is not None or plan.settings.clone is not None
        self.model.critic_alone = self.env.settled and ppo.critic_first > 0.0
        self._watch = Watch(self.batch)
        self.notes: list[str] = []
        """Remarks for the end."""
        self.teacher = plan.settings.clone.agents[0] if plan.settings.clone else ""
        """The agent that is cloned."""

    def begin(self, report: Callable[[str], None] = lambda line: None) -> None:
        """Begin as an agent or a clone, where settings name one, and start episodes; `report` gets progress lines."""
        settings = self.plan.settings
        if (start := settings.start) is not None:
            tensors = tensors_of(start, self.scenario, settings.ppo.observation_clip, settings.actions)
            try:
                self.take(tensors)
            except (RuntimeError, KeyError, ValueError) as error:
                here = f"ppo.hidden = {[*settings.ppo.hidden]} and ppo.memory = {settings.ppo.memory or 'none'}"
                raise CoopenvError(f"start: {start} has not the widths {here}: {error}") from None
            if find_agent(start).training.get("steps") == 0:  # a clone alone, of which no exploration was learnt
                for values in self.model.policy.spread.values():
                    nn.init.constant_(values, math.log(settings.ppo.initial_std))
            if COUNTS not in tensors:
                self.notes.append(f"{start} was saved without a critic: a new one learnt from its episodes")
        if settings.clone is not None:
            self._imitate(settings.clone.model_copy(update={"agent": self.teacher}), report)
        self.env.start()

    def _imitate(self, clone: Clone, report: Callable[[str], None]) -> None:
        """Fit the policy to a driver's actions, and the value to the discounted rewards that follow.

        The observations of the first round are also the first in the statistics for normalisation. Noise is added to
        all actions, so that corrections of deviations are recorded (Laskey et al. 2017).
        """
        env, networks, watched = self.env, self.model.policy.layers(), list[tuple[np.ndarray, ...]]()

        def loss(seen: Tensor, actions: Tensor, values: Tensor) -> Tensor:
            acting, valued = (network(layers, seen) for layers in networks)
            return self.actions.loss(acting, actions, clone.smoothing) + nn.functional.mse_loss(valued, values)

        for part in range(clone.rounds):
            watched += self._watched(clone, part, report)
            raw, actions, returns, _ = (np.concatenate(column) for column in zip(*watched, strict=True))
            if part == 0:
                env.statistics.update(raw)
                env.spread.update(returns)
            observations = torch.from_numpy(self.forgetting(env.normalise(raw)))
            values = (env.reward_scale * returns)[:, None]
            targets = [torch.from_numpy(aims.astype(np.float32)) for aims in (actions, values)]
            chosen = (part for layers in networks for layer in layers for part in layer.parameters())
            regress(chosen, (observations, *targets), clone, self.plan.seed, loss, report)
        env.looked_at.append(raw)

    def _watched(self, clone: Clone, part: int, report: Callable[[str], None]) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield what `watch` returns in the worlds of a round, by scenario."""
        all_worlds, threads = sum(count for _, count in self._scenarios), self.batch.engine.world.threads
        driving = self.driver() if part else None
        for place, (each, count) in enumerate(self._scenarios, part * len(self._scenarios)):
            worlds, start = max(1, clone.episodes * count // all_worlds // clone.rounds), self.plan.seed + APART * place
            rule = RightOfWay(each) if self.rule else None
            yield watch(each, worlds, clone, self.gamma, start, threads, report, self.actions, rule, driving)

    def update(self) -> Status:
        """Collect one rollout and learn from it.

        Raises:
            DivergedError: the policy is no longer finite.
        """
        begin, cpu_begin = monotonic(), process_time()
        self._share = self._spent()
        ahead = max(self._spent(self._rollout), self.seconds / (60.0 * (self.plan.settings.minutes or math.inf)))
        self.model.critic_alone = self.model.critic_alone and ahead <= LONGEST_ALONE
        with self.finite():
            self.model.learn(self._rollout, callback=self._watch, reset_num_timesteps=False)
        if self.model.critic_alone:
            self.model.critic_alone = self.model.explained < self.plan.settings.ppo.critic_first
        self.seconds += monotonic() - begin
        self.cpu_seconds += process_time() - cpu_begin
        return self.status

    def driver(self, *further: Alone) -> "MeanAction":
        """Return the policy as it is now, without exploration, under the rule of the training and further ones."""
        return MeanAction(self, *further)

    def forgetting(self, seen: np.ndarray) -> np.ndarray:
        """Return normalised observations beside an empty memory, where the policy has one."""
        return np.pad(seen, ((0, 0), (0, self.plan.settings.ppo.memory or 0)))

    @contextmanager
    def finite(self) -> Iterator[None]:
        """Raise an error of one line for a policy that is not finite, which torch notices only as it draws actions."""
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
        values = [f"ppo.{name} = {getattr(self.plan.settings.ppo, name)}" for name in names]
        when = f"after {self.model.num_timesteps} steps the policy is not finite"
        return DivergedError(f"the training diverged: {when}; look at {', '.join(values)}")

    @property
    def status(self) -> Status:
        """Progress of the training."""
        return Status(self.model.num_timesteps, self.seconds, self._spent(), self._watch.figures())

    def _spent(self, more: int = 0) -> float:
        """Return the share of the steps, after `more` further ones."""
        steps = self.plan.settings.steps
        return min(1.0, (self.model.num_timesteps + more) / steps) if steps else 1.0

    def tensors(self) -> Arrays:
        """Return a copy of networks and normalisation by the names of an agent's weights."""
        env, found = self.env, {name: values.detach().numpy() for name, values in self._parameters().items()}
        found |= {"observation.mean": env.statistics.mean, "observation.std": env.std}
        found[COUNTS] = np.array([env.statistics.count, env.spread.mean, env.spread.var, env.spread.count])
        return {name: np.array(values) for name, values in found.items()}

    @torch.no_grad()
    def take(self, tensors: Arrays) -> None:
        """Go on from a result of `tensors`; where it has no critic, the present one stays.

        Raises:
            KeyError, RuntimeError, ValueError: networks have other widths, or a number is not finite.
        """
        env = self.env
        if wrong := [name for name, values in tensors.items() if not np.isfinite(values).all()]:
            raise ValueError(f"{wrong[0]} is not finite")
        env.statistics.mean[...] = tensors["observation.mean"]
        env.statistics.var[...] = tensors["observation.std"].astype(float) ** 2 - LEAST_VARIANCE
        remembers = f"{MEMORY}{PARTS[0]}" in tensors
        if remembers and not self.remembering:
            raise ValueError("it has a memory")
        for name, values in self._parameters().items():
            if (COUNTS in tensors or not name.startswith(CRITIC)) and (remembers or not name.startswith(MEMORY)):
                first = not remembers and name.endswith("layers.0.weight")
                values.copy_(torch.from_numpy(self.forgetting(tensors[name]) if first else tensors[name]))
        if COUNTS in tensors:
            env.statistics.count, env.spread.mean, env.spread.var, env.spread.count = map(float, tensors[COUNTS])

    def _parameters(self) -> dict[str, Tensor]:
        """Return the learnt parameters by the names of an agent's weights."""
        networks = zip(("", CRITIC), self.model.policy.layers(), strict=True)
        each = [(f"{prefix}layers.{i}", layer) for prefix, layers in networks for i, layer in enumerate(layers)]
        found = {f"{name}.{part}": getattr(layer, part) for name, layer in each for part in ("weight", "bias")}
        if self.remembering:
            found |= {f"{MEMORY}{part}": getattr(self.remembering.cell, part) for part in PARTS}
        return {**found, **self.model.policy.spread}

    def record(self, figures: dict[str, float]) -> None:
        """Write figures of the mean action on held-out maps for TensorBoard."""
        for name, value in figures.items():
            self.model.logger.record(f"held_out/{name}", value)
        self.model.logger.dump(self.model.num_timesteps)

    def close(self) -> None:
        """End the threads and the log."""
        self.model.logger.close()
        self.env.close()


class MeanAction(NetworkPolicy):
    """The mean action, or the most likely letter, of a trainer's policy."""

    def __init__(self, trainer: Trainer, *further: Alone) -> None:
        """Take the policy, and rules beside that of the training."""
        self._trainer = trainer
        choices = actions_of(trainer.plan.settings.actions, trainer.scenario).choices
        super().__init__(choices, [*([trainer.rule] if trainer.rule else []), *further], trainer.tensors())

    def chosen(self, observations: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """See `NetworkPolicy.chosen`. Raises DivergedError: the policy is not finite."""
        trainer = self._trainer
        seen = trainer.env.normalise(observations)
        with trainer.finite():
            remembered = self._memory(seen, rows) if self._memory else seen
            return np.asarray(trainer.model.predict(remembered, deterministic=True)[0])
