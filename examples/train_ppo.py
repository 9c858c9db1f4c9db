"""Train one policy that all vehicles share with PPO: everything in this file, plain torch, CPU or GPU.

Run: python examples/train_ppo.py --out out/ppo                (about two minutes on two cores)
     python examples/train_ppo.py --out out/ppo --resume       (goes on from the last checkpoint)
     python examples/train_ppo.py --device cuda:0 --num-worlds 8192 --rollout 16 --minibatches 8 --total-steps 50000000

Needs torch, tyro and TensorBoard (the extra `train`). The batch has one row per (world, vehicle), and its arrays are
torch tensors on the device of the worlds: in the rollout nothing waits for the host. Three things deserve care, each of
them one line below:

- a vehicle that has arrived or crashed stays in its world until the others are done: its rows are not `alive`;
- the batch resets a world in the step after its last one (`next_step`): that step took no action and is left out;
- the horizon cuts an episode off (`truncated`), it does not end it: the value of the last observation still counts.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

import coopenv


@dataclass
class Arguments:
    env: str = "urban_crossing"
    """environment or TOML file"""
    device: str = "cpu"
    """cpu or cuda:0"""
    seed: int = 1
    """of the worlds, the weights and the exploration"""
    num_worlds: int = 256
    """worlds side by side"""
    total_steps: int = 4_000_000
    """decisions of vehicles to collect, the dead ones included"""
    rollout: int = 32
    """decision steps between updates"""
    epochs: int = 4
    """passes over each rollout"""
    minibatches: int = 8
    """gradient steps per pass"""
    learning_rate: float = 1e-3
    """of Adam at the start; falls linearly to zero"""
    gamma: float | None = None
    """discount per decision; none: 1 - 1 / the decisions of an episode"""
    gae_lambda: float = 0.95
    """of the generalised advantage estimate"""
    clip: float = 0.2
    """of the probability ratio"""
    entropy: float = 0.0
    """weight of the entropy bonus"""
    value_weight: float = 0.5
    """weight of the value loss"""
    max_gradient: float = 0.5
    """norm at which gradients are clipped"""
    reward_scale: float = 0.1
    """makes values of order one"""
    hidden: int = 64
    """width of the two hidden layers"""
    initial_std: float = 0.5
    """of the exploration; actions reach from -1 to 1"""
    log_every: int = 15
    """updates between lines, each with a checkpoint"""
    evaluation_worlds: int = 64
    """held-out worlds of which one episode each is judged before and after"""
    out: str = ""
    """folder for weights, checkpoint, curve and TensorBoard; none: nothing is written"""
    resume: bool = False
    """go on from the checkpoint in the folder; the other arguments have to be those it began with"""


class Normaliser(nn.Module):
    """Observations by the running mean and standard deviation of those of rows that acted."""

    LEAST_VARIANCE, LIMIT = 1e-4, 6.0

    def __init__(self, size: int) -> None:
        super().__init__()
        for name, value in (("mean", torch.zeros(size)), ("variance", torch.ones(size)), ("count", torch.zeros(()))):
            self.register_buffer(name, value)

    def forward(self, observation: Tensor) -> Tensor:
        scaled = (observation - self.mean) / torch.sqrt(self.variance + self.LEAST_VARIANCE)
        return scaled.clamp(-self.LIMIT, self.LIMIT)

    def learn(self, observation: Tensor) -> None:
        """Take in observations (rows, size); Chan et al. 1979."""
        count, (variance, mean) = len(observation), torch.var_mean(observation, 0, correction=0)
        total = self.count + count
        change, share = mean - self.mean, count / total
        self.variance += share * (variance - self.variance) + share * (1 - share) * change**2
        self.mean += share * change
        self.count.copy_(total)


class Policy(nn.Module):
    """Mean action, one standard deviation per entry of it, and the value; actor and critic see normalised rows."""

    def __init__(self, inputs: int, outputs: int, hidden: int, initial_std: float) -> None:
        super().__init__()
        self.normaliser = Normaliser(inputs)
        self.actor = network(inputs, hidden, outputs, gain=0.01)
        self.critic = network(inputs, hidden, 1, gain=1.0)
        self.log_std = nn.Parameter(torch.full((outputs,), float(np.log(initial_std))))

    def value(self, observation: Tensor) -> Tensor:
        return self.critic(observation).squeeze(-1)

    def drive(self, observation: Tensor) -> Tensor:
        """Return the mean action for observations as the environment gives them."""
        return self.actor(self.normaliser(observation))

    def log_probability(self, observation: Tensor, action: Tensor) -> Tensor:
        return gaussian(action, self.actor(observation), self.log_std)


def network(inputs: int, hidden: int, outputs: int, gain: float) -> nn.Sequential:
    def linear(a: int, b: int, gain: float) -> nn.Linear:
        layer = nn.Linear(a, b)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
        return layer

    middle = 2**0.5
    return nn.Sequential(
        linear(inputs, hidden, middle),
        nn.Tanh(),
        linear(hidden, hidden, middle),
        nn.Tanh(),
        linear(hidden, outputs, gain),
    )


def gaussian(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log probability of an action, up to a constant that no ratio sees."""
    return -(0.5 * ((action - mean) * torch.exp(-log_std)) ** 2 + log_std).sum(-1)


class Tally:
    """Sums over the episodes of vehicles that have ended, kept on the device until someone reads them."""

    NAMES = ("episodes", "return", "steps", "arrived", "collided", "position_error", "rows")

    def __init__(self, rows: int, device: str, terms: tuple[str, ...]) -> None:
        self.names = (*self.NAMES, *(f"term_{name}" for name in terms))
        self.sums = torch.zeros(len(self.names), device=device)
        self.running = torch.zeros(2 + len(terms), rows, device=device)

    def add(self, reward: Tensor, valid: Tensor, done: Tensor, infos: dict[str, Any]) -> None:
        self.running += torch.stack([reward, torch.ones_like(reward), *infos["reward_terms"].values()]) * valid
        ended = valid & done
        arrived, collided = ((ended & (infos["ended"] == outcome)).sum() for outcome in (1, 2))
        returned, steps, *terms = (self.running * ended).sum(1)
        error = (infos["position_error"] * valid).sum()
        self.sums += torch.stack([ended.sum(), returned, steps, arrived, collided, error, valid.sum(), *terms])
        self.running *= ~ended

    def read(self) -> dict[str, float]:
        """Return means per finished episode and forget them; waits for the device."""
        total = dict(zip(self.names, self.sums.tolist(), strict=True))
        self.sums.zero_()
        episodes, rows = total.pop("episodes"), total.pop("rows")
        error = total.pop("position_error") / max(rows, 1.0)
        means = {name: value / max(episodes, 1.0) for name, value in total.items()}
        return {"episodes": episodes, **means, "position_error": error}


def evaluate(act: Callable[[Tensor], Tensor], args: Arguments) -> dict[str, float]:
    """Return the means of one episode per vehicle of held-out worlds."""
    env = coopenv.make_vec(
        args.env, num_worlds=args.evaluation_worlds, device=args.device, autoreset="disabled", arrays="torch"
    )
    observation, _ = env.reset(seed=coopenv.evaluation_seed(0))
    tally = Tally(env.num_envs, args.device, env.engine.reward_terms)
    acting = torch.as_tensor(env.acting, device=args.device)
    over = torch.zeros_like(acting)
    for _ in range(round(env.scenario.horizon * env.scenario.rates.decision)):
        with torch.no_grad():
            action = act(observation)
        observation, reward, terminated, truncated, infos = env.step(action)
        tally.add(reward, acting & infos["alive"] & ~over, terminated | truncated, infos)
        over |= terminated | truncated
    return tally.read()


def advantages(args: Arguments, buffer: dict[str, Tensor], last_value: Tensor) -> Tensor:
    """Return generalised advantage estimates, (rollout, rows).

    The observation that follows a truncated step is the last of its episode (the reset comes one step later), so the
    next value of the buffer is just the one to bootstrap from.
    """
    result = torch.zeros_like(buffer["reward"])
    following = torch.zeros_like(last_value)
    next_value = last_value
    for t in reversed(range(args.rollout)):
        goes_on = ~(buffer["terminated"][t] | buffer["truncated"][t])
        target = buffer["reward"][t] + args.gamma * next_value * ~buffer["terminated"][t]
        following = target - buffer["value"][t] + args.gamma * args.gae_lambda * goes_on * following
        result[t] = following
        next_value = buffer["value"][t]
    return result


def update(args: Arguments, policy: Policy, optimiser: torch.optim.Optimizer, batch: dict[str, Tensor]) -> None:
    """Take the gradient steps of one rollout; a batch holds rows that acted, and no others."""
    rows = len(batch["advantage"])
    size = -(-rows // args.minibatches)
    for _ in range(args.epochs):
        for chosen in torch.randperm(rows, device=args.device).split(size):
            part = {name: values[chosen] for name, values in batch.items()}
            advantage = part["advantage"]
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            change = policy.log_probability(part["observation"], part["action"]) - part["log_probability"]
            ratio = change.exp()
            clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
            gain = torch.minimum(ratio * advantage, clipped * advantage).mean()
            value_loss = 0.5 * ((policy.value(part["observation"]) - part["return"]) ** 2).mean()
            loss = args.value_weight * value_loss - gain - args.entropy * policy.log_std.sum()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), args.max_gradient)
            optimiser.step()


def collect(
    args: Arguments, env: coopenv.CooperativeVectorEnv, policy: Policy, now: dict[str, Tensor], tally: Tally
) -> tuple[dict[str, Tensor], Tensor]:
    """Return a rollout, (rollout, rows, ...) per entry, and the value of the observation after it."""
    steps: list[dict[str, Tensor]] = []
    std, acting = policy.log_std.exp(), torch.as_tensor(env.acting, device=args.device)
    for _ in range(args.rollout):
        raw = now["observation"].clone()  # the environment writes the next one into the same memory
        observation = policy.normaliser(raw)
        mean = policy.actor(observation)
        action = mean + std * torch.randn_like(mean)
        now["observation"], reward, terminated, truncated, infos = env.step(action)  # clips the action
        valid = acting & infos["alive"] & ~now["done"]  # not parked, and not the step that reset the world
        now["done"] = terminated | truncated
        steps.append(
            {
                "raw": raw,
                "observation": observation,
                "action": action,
                "log_probability": gaussian(action, mean, policy.log_std),
                "value": policy.value(observation),
                "reward": reward * args.reward_scale,
                "terminated": terminated.clone(),
                "truncated": truncated.clone(),
                "valid": valid,
            }
        )
        tally.add(reward, valid, now["done"], infos)
    last_value = policy.value(policy.normaliser(now["observation"]))
    return {name: torch.stack([step[name] for step in steps]) for name in steps[0]}, last_value


def line(name: str, row: dict[str, float]) -> str:
    return (
        f"{name:>20}  return {row['return']:7.2f}  arrived {row['arrived']:4.0%}  collided {row['collided']:4.0%}"
        f"  steps {row['steps']:4.0f}  position error {100 * row['position_error']:4.1f} cm"
    )


class Store:
    """The folder of a training: a checkpoint that is replaced as a whole, the curve, and TensorBoard's files."""

    def __init__(self, args: Arguments) -> None:
        self.folder = Path(args.out) if args.out else None
        self.writer = None
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.writer = SummaryWriter(str(self.folder / "tensorboard"))

    def save(self, done: int, policy: Policy, optimiser: torch.optim.Optimizer, curve: list[dict[str, float]]) -> None:
        if self.folder is None or self.writer is None:
            return
        for name, value in curve[-1].items():
            self.writer.add_scalar(name, value, int(curve[-1]["vehicle_steps"]))
        parts = {"done": done, "policy": policy.state_dict(), "optimiser": optimiser.state_dict(), "curve": curve}
        new = self.folder / "checkpoint.new"
        torch.save({**parts, "random": torch.get_rng_state()}, new)
        os.replace(new, self.folder / "checkpoint.pt")  # noqa: PTH105
        with (self.folder / "curve.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, curve[0])
            writer.writeheader()
            writer.writerows(curve)

    def load(self, device: str) -> dict[str, Any]:
        """Return what `save` wrote; tensors and numbers alone are read, no code."""
        path = self.folder / "checkpoint.pt" if self.folder is not None else None
        if path is None or not path.is_file():
            raise SystemExit(f"nothing to resume: there is no {path or 'folder, --out'}")
        return torch.load(path, map_location=device, weights_only=True)

    def finish(self, policy: Policy) -> None:
        """Write the weights alone (no pickle), and close the log."""
        if self.folder is None or self.writer is None:
            return
        from safetensors.torch import save_file

        weights = {name: values.detach().cpu().contiguous() for name, values in policy.state_dict().items()}
        save_file(weights, self.folder / "weights.safetensors")
        self.writer.close()


def train(args: Arguments) -> list[dict[str, float]]:
    """Train, print, save; return the learning curve."""
    if args.device == "cpu":
        torch.set_num_threads(1)  # small matrices: more threads mostly wait for one another and for the worlds'
    torch.manual_seed(args.seed)
    env = coopenv.make_vec(args.env, num_worlds=args.num_worlds, device=args.device, arrays="torch")
    args = replace(args, gamma=args.gamma or 1.0 - 1.0 / env.scenario.decisions)
    size, actions = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    policy = Policy(size, actions, args.hidden, args.initial_std).to(args.device)
    optimiser = torch.optim.Adam(policy.parameters(), args.learning_rate, eps=1e-5)
    store, begun, curve = Store(args), 0, []
    if args.resume:
        saved = store.load(args.device)
        policy.load_state_dict(saved["policy"])
        optimiser.load_state_dict(saved["optimiser"])
        torch.set_rng_state(saved["random"].cpu())
        begun, curve = saved["done"], saved["curve"]
    else:
        print(line("random", evaluate(lambda o: 2 * torch.rand(len(o), actions, device=args.device) - 1, args)))

    first, _ = env.reset(seed=args.seed + begun)  # worlds are drawn anew after a checkpoint
    now = {"observation": first, "done": torch.zeros(env.num_envs, dtype=torch.bool, device=args.device)}
    tally = Tally(env.num_envs, args.device, env.engine.reward_terms)
    updates = max(1, args.total_steps // (args.rollout * env.num_envs))
    start = time.perf_counter() - (curve[-1]["seconds"] if curve else 0.0)
    for done in range(begun + 1, updates + 1):
        optimiser.param_groups[0]["lr"] = args.learning_rate * (1 - (done - 1) / updates)
        learn(args, env, policy, optimiser, now, tally)
        if done % args.log_every == 0 or done == updates:
            seconds = time.perf_counter() - start
            steps = done * args.rollout * env.num_envs
            curve.append({"vehicle_steps": steps, "seconds": round(seconds, 2), **tally.read()})
            print(line(f"{steps:,} steps", curve[-1]), f" {seconds:4.0f} s  {steps / seconds:,.0f} steps/s", flush=True)
            store.save(done, policy, optimiser, curve)

    print(line("mean action", evaluate(policy.drive, args)))
    store.finish(policy)
    return curve


def learn(
    args: Arguments,
    env: coopenv.CooperativeVectorEnv,
    policy: Policy,
    optimiser: torch.optim.Optimizer,
    now: dict[str, Tensor],
    tally: Tally,
) -> None:
    """Collect a rollout and learn from its rows that acted."""
    with torch.no_grad():
        buffer, last_value = collect(args, env, policy, now, tally)
        buffer["advantage"] = advantages(args, buffer, last_value)
        buffer["return"] = buffer["advantage"] + buffer["value"]
    valid = buffer["valid"].flatten().nonzero().squeeze(1)
    names = ("raw", "observation", "action", "log_probability", "advantage", "return")
    batch = {name: buffer[name].flatten(0, 1)[valid] for name in names}
    policy.normaliser.learn(batch.pop("raw"))
    update(args, policy, optimiser, batch)


if __name__ == "__main__":
    train(tyro.cli(Arguments, description=__doc__))
