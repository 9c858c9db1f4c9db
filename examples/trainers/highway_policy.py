"""Cost of localisation errors to a policy of highway-env: train it on the truth, run it on estimates.

Run: python examples/trainers/highway_policy.py           (five minutes on one core; keeps out/highway_policy.pt)
     python examples/trainers/highway_policy.py --quick   (half a minute, a policy that has hardly learnt)

Needs the extras `highway` and `train`. A DQN of Stable-Baselines3 learns on plain `intersection-v0`, where it sees true
kinematics. Then the same episodes are driven four times: on the truth, and wrapped in `EstimatedKinematics` with ideal,
sensed and blind cameras, where policy and lane keeping both act on what the car's observer estimates.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch
from estimated_kinematics import EstimatedKinematics
from highway_env.envs.intersection_env import IntersectionEnv
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest, t
from stable_baselines3 import DQN
from stable_baselines3.common.monitor import Monitor

ARMS = ("truth", "ideal", "sensed", "blind")


@dataclass(frozen=True)
class Episode:
    total: float  # sum of rewards
    crashed: bool
    arrived: bool
    error: float  # m, root mean square of the car's position error at its decisions


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--policy", type=Path, default=Path("out/highway_policy.pt"), help="weights; trained if not there"
    )
    parser.add_argument("--steps", type=int, default=3000, help="decisions to train for")
    parser.add_argument("--seeds", type=int, default=60, help="episodes per row of the table")
    parser.add_argument("--first-seed", type=int, default=10_000, help="training takes those from 0 on")
    parser.add_argument("--connected", type=int, default=2, help="cars of the traffic that are connected")
    parser.add_argument("--quick", action="store_true", help="few steps and seeds, nothing is kept")
    return parser.parse_args()


def model_of(env: gymnasium.Env) -> DQN:
    """Return an untrained DQN."""
    return DQN(
        "MlpPolicy",
        env,
        policy_kwargs={"net_arch": [128, 128]},
        learning_rate=1e-3,
        learning_starts=200,
        batch_size=64,
        gamma=0.95,
        target_update_interval=100,
        exploration_fraction=0.6,
        seed=0,
        device="cpu",
    )


def trained(policy: Path, steps: int, keep: bool) -> DQN:
    """Return the policy of a file of weights, or train it; weights are read without running code of the file."""
    model = model_of(Monitor(IntersectionEnv()))
    if keep and policy.exists():
        model.policy.load_state_dict(torch.load(policy, weights_only=True))
        return model
    model.learn(steps)
    if keep:
        policy.parent.mkdir(parents=True, exist_ok=True)
        torch.save(model.policy.state_dict(), policy)
    return model


def drive(model: DQN, arm: str, seeds: range, connected: int) -> Iterator[Episode]:
    env: gymnasium.Env = IntersectionEnv()
    if arm != "truth":
        env = EstimatedKinematics(env, sensing=arm, connected=connected, lane_keeping=True)
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        total, over, errors = 0.0, False, []
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(int(action))
            errors.append(info["localisation"]["position_error"] if arm != "truth" else 0.0)
            total, over = total + float(reward), terminated or truncated
        car = env.unwrapped.vehicle
        error = float(np.sqrt(np.mean(np.square(errors))))
        yield Episode(total, bool(car.crashed), bool(env.unwrapped.has_arrived(car)), error)


def mean(values: np.ndarray) -> str:
    """Return a mean with its 95 % interval (Student's t)."""
    if np.ptp(values) == 0.0:
        return f"{values[0]:.2f}"
    half = float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return f"{values.mean():.2f} [{values.mean() - half:.2f}, {values.mean() + half:.2f}]"


def share(values: np.ndarray) -> str:
    """Return a share in % with its 95 % interval (Wilson)."""
    interval = binomtest(int(values.sum()), len(values)).proportion_ci(method="wilson")
    return f"{100 * values.mean():.0f} [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"


def main() -> None:
    args = parse()
    torch.set_num_threads(1)
    steps, count = (250, 2) if args.quick else (args.steps, args.seeds)
    model = trained(args.policy, steps, keep=not args.quick)
    seeds = range(args.first_seed, args.first_seed + count)
    title = f"intersection-v0, {count} seeds, means with 95 % intervals"
    table = Table(
        "sensing", "position error [m]", "return", "lost against truth", "collisions [%]", "arrivals [%]", title=title
    )
    returns = {}
    for arm in ARMS:
        episodes = list(drive(model, arm, seeds, args.connected))
        columns = {name: np.array([getattr(e, name) for e in episodes]) for name in Episode.__dataclass_fields__}
        returns[arm] = columns["total"]
        lost = mean(returns["truth"] - returns[arm])  # of the same seeds, so that luck counts less
        shares = share(columns["crashed"]), share(columns["arrived"])
        table.add_row(arm, mean(columns["error"]), mean(returns[arm]), lost, *shares)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
