"""Train one policy that all vehicles share with PPO: everything in this file, plain torch, CPU or GPU.

Run: python examples/train_ppo.py --out out/ppo                (about two minutes on two cores)
     python examples/train_ppo.py --device cuda:0 --num-worlds 8192 --rollout 16 --minibatches 8 --total-steps 50000000

Needs torch (the extra `train`). The batch has one row per (world, vehicle), and its arrays are torch tensors on the
device of the worlds: in the rollout nothing waits for the host. Three things deserve care, and each is one line below:

- a vehicle that has arrived or crashed stays in its world until the others are done: its rows are not `alive`;
- the batch resets a world in the step after its last one (`next_step`): that step took no action and is left out;
- the horizon cuts an episode off (`truncated`), it does not end it: the value of the last observation still counts.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import coopenv


def option(default: Any, text: str) -> Any:
    """Return a field with its default and the text that --help shows."""
    return field(default=default, metadata={"help": text})


@dataclass
class Arguments:
    env: str = option("urban_crossing", "environment or TOML file")
    device: str = option("cpu", "cpu or cuda:0")
    seed: int = option(1, "of the worlds, the weights and the exploration")
    num_worlds: int = option(256, "worlds side by side")
    total_steps: int = option(4_000_000, "decisions of vehicles to collect, the dead ones included")
    rollout: int = option(32, "decision steps between updates")
    epochs: int = option(4, "passes over each rollout")
    minibatches: int = option(8, "gradient steps per pass")
    learning_rate: float = option(1e-3, "of Adam at the start; falls linearly to zero")
    gamma: float = option(0.998, "discount per decision; a crossing takes about 110 of them")
    gae_lambda: float = option(0.95, "of the generalised advantage estimate")
    clip: float = option(0.2, "of the probability ratio")
    entropy: float = option(0.0, "weight of the entropy bonus")
    value_weight: float = option(0.5, "weight of the value loss")
    max_gradient: float = option(0.5, "norm at which gradients are clipped")
    reward_scale: float = option(0.1, "makes values of order one")
    hidden: int = option(64, "width of the two hidden layers")
    initial_std: float = option(0.5, "of the exploration; actions reach from -1 to 1")
    log_every: int = option(15, "updates between lines")
    evaluation_worlds: int = option(64, "worlds of which one episode each is judged before and after")
    out: str = option("", "folder for weights and curve; none: nothing is written")


class Policy(nn.Module):
    """Mean action, one standard deviation per entry of it, and the value."""

    def __init__(self, inputs: int, outputs: int, hidden: int, initial_std: float) -> None:
        super().__init__()
        self.actor = network(inputs, hidden, outputs, gain=0.01)
        self.critic = network(inputs, hidden, 1, gain=1.0)
        self.log_std = nn.Parameter(torch.full((outputs,), float(np.log(initial_std))))

    def value(self, observation: Tensor) -> Tensor:
        return self.critic(observation).squeeze(-1)

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

    NAMES = ("episodes", "return", "arrived", "collided", "steps", "position_error", "rows")

    def __init__(self, rows: int, device: str) -> None:
        self.sums = torch.zeros(len(self.NAMES), device=device)
        self.running = torch.zeros(2, rows, device=device)

    def add(self, reward: Tensor, valid: Tensor, terminated: Tensor, done: Tensor, position_error: Tensor) -> None:
        self.running[0] += reward * valid
        self.running[1] += valid
        ended = valid & done
        # arriving pays and colliding costs: the sign of the last reward tells which it was
        events = (ended, ended & terminated & (reward > 0), ended & terminated & (reward <= 0))
        episodes, arrived, collided = (event.sum() for event in events)
        returned, steps = (self.running * ended).sum(1)
        error = (position_error * valid).sum()
        self.sums += torch.stack([episodes, returned, arrived, collided, steps, error, valid.sum()])
        self.running *= ~ended

    def read(self) -> dict[str, float]:
        """Return means per finished episode and forget them; waits for the device."""
        total = dict(zip(self.NAMES, self.sums.tolist(), strict=True))
        self.sums.zero_()
        episodes, rows = max(total["episodes"], 1.0), max(total["rows"], 1.0)
        means = {name: total[name] / episodes for name in ("return", "arrived", "collided", "steps")}
        return {"episodes": total["episodes"], **means, "position_error": total["position_error"] / rows}


def evaluate(act: Callable[[Tensor], Tensor], args: Arguments) -> dict[str, float]:
    """Return the means of one episode per vehicle of fresh worlds."""
    env = coopenv.make_vec(
        args.env, num_worlds=args.evaluation_worlds, device=args.device, autoreset="disabled", arrays="torch"
    )
    observation, _ = env.reset(seed=coopenv.evaluation_seed(args.seed))
    tally = Tally(env.num_envs, args.device)
    over = torch.zeros(env.num_envs, dtype=torch.bool, device=args.device)
    for _ in range(round(env.scenario.horizon * env.scenario.rates.decision)):
        with torch.no_grad():
            action = act(observation)
        observation, reward, terminated, truncated, infos = env.step(action)
        tally.add(reward, infos["alive"] & ~over, terminated, terminated | truncated, infos["position_error"])
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
    std = policy.log_std.exp()
    for _ in range(args.rollout):
        observation = now["observation"].clone()  # the environment writes the next one into the same memory
        mean = policy.actor(observation)
        action = mean + std * torch.randn_like(mean)
        now["observation"], reward, terminated, truncated, infos = env.step(action)  # clips the action
        valid = infos["alive"] & ~now["done"]  # not parked, and not the step that reset the world
        now["done"] = terminated | truncated
        steps.append(
            {
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
        tally.add(reward, valid, terminated, now["done"], infos["position_error"])
    return {name: torch.stack([step[name] for step in steps]) for name in steps[0]}, policy.value(now["observation"])


def line(name: str, row: dict[str, float]) -> str:
    return (
        f"{name:>20}  return {row['return']:7.2f}  arrived {row['arrived']:4.0%}  collided {row['collided']:4.0%}"
        f"  steps {row['steps']:4.0f}  position error {100 * row['position_error']:4.1f} cm"
    )


def save(policy: Policy, args: Arguments, curve: list[dict[str, float]]) -> None:
    """Write the weights (no pickle), the arguments beside them, and the learning curve."""
    folder = Path(args.out)
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: values.detach().cpu().contiguous() for name, values in policy.state_dict().items()}
    try:
        from safetensors.torch import save_file
    except ImportError:
        np.savez(folder / "weights.npz", **{name: values.numpy() for name, values in weights.items()})
    else:
        save_file(weights, folder / "weights.safetensors", metadata={k: str(v) for k, v in asdict(args).items()})
    with (folder / "curve.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, curve[0])
        writer.writeheader()
        writer.writerows(curve)


def train(args: Arguments) -> list[dict[str, float]]:
    """Train, print, save; return the learning curve."""
    if args.device == "cpu":
        torch.set_num_threads(1)  # small matrices: more threads mostly wait for one another and for the worlds'
    torch.manual_seed(args.seed)
    env = coopenv.make_vec(args.env, num_worlds=args.num_worlds, device=args.device, arrays="torch")
    size, actions = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    policy = Policy(size, actions, args.hidden, args.initial_std).to(args.device)
    optimiser = torch.optim.Adam(policy.parameters(), args.learning_rate, eps=1e-5)
    print(line("random", evaluate(lambda o: 2 * torch.rand(len(o), actions, device=args.device) - 1, args)))

    first, _ = env.reset(seed=args.seed)
    now = {"observation": first, "done": torch.zeros(env.num_envs, dtype=torch.bool, device=args.device)}
    tally = Tally(env.num_envs, args.device)
    updates = max(1, args.total_steps // (args.rollout * env.num_envs))
    curve: list[dict[str, float]] = []
    start = time.perf_counter()
    for done in range(1, updates + 1):
        optimiser.param_groups[0]["lr"] = args.learning_rate * (1 - (done - 1) / updates)
        with torch.no_grad():
            buffer, last_value = collect(args, env, policy, now, tally)
            buffer["advantage"] = advantages(args, buffer, last_value)
            buffer["return"] = buffer["advantage"] + buffer["value"]
        valid = buffer["valid"].flatten().nonzero().squeeze(1)
        names = ("observation", "action", "log_probability", "advantage", "return")
        update(args, policy, optimiser, {name: buffer[name].flatten(0, 1)[valid] for name in names})
        if done % args.log_every == 0 or done == updates:
            seconds = time.perf_counter() - start
            steps = done * args.rollout * env.num_envs
            curve.append({"vehicle_steps": steps, "seconds": round(seconds, 2), **tally.read()})
            print(line(f"{steps:,} steps", curve[-1]), f" {seconds:4.0f} s  {steps / seconds:,.0f} steps/s", flush=True)

    print(line("mean action", evaluate(policy.actor, args)))
    if args.out:
        save(policy, args, curve)
    return curve


def parse(words: list[str] | None = None) -> Arguments:
    parser = argparse.ArgumentParser(description="PPO with one policy for all vehicles")
    for f in fields(Arguments):
        flag = "--" + f.name.replace("_", "-")
        parser.add_argument(flag, type=type(f.default), default=f.default, help=f"{f.metadata['help']} (%(default)s)")
    return Arguments(**vars(parser.parse_args(words)))


if __name__ == "__main__":
    train(parse())
