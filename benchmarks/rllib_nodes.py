"""`python -m benchmarks.rllib_nodes`: steps per second of RLlib's PPO on one local Ray node and on two.

A node has one core and one runner with a batch of worlds; the learner is in this process. Clusters are started in turn,
and the first iteration on each is left out. Beside the rate by the clock stands that by CPU time, which other programs
change little: learning follows sampling, and the slowest runner counts. Needs the extra `rllib`.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import ray
import torch
from ray.cluster_utils import Cluster
from ray.rllib.algorithms.ppo import PPOConfig
from rich.console import Console
from rllib_env import CooperativeRows

from benchmarks.machine import machine
from coopenv.report.table import Table

NODES = (1, 2)
NAMES = ("training, by the clock", "training, by CPU time", "sampling, by CPU time", "learning, by CPU time")
STORE = 200 * 2**20
"""Bytes of a node's shared memory."""


@contextmanager
def cluster(nodes: int) -> Any:
    """Run a Ray cluster of nodes of one core on this machine."""
    options = {"num_cpus": 1, "object_store_memory": STORE}
    found = Cluster(initialize_head=True, head_node_args={**options, "include_dashboard": False})
    try:
        for _ in range(nodes - 1):
            found.add_node(**options)
        ray.init(address=found.address, log_to_driver=False)
        yield
    finally:
        ray.shutdown()
        found.shutdown()


def iterations(environment: str, nodes: int, count: int) -> list[tuple[float, ...]]:
    """Return steps per second of each iteration: by the clock, by CPU time, and of sampling and learning alone."""
    config = (
        PPOConfig()
        .environment(CooperativeRows, env_config={"env": environment, "threads": 1})
        .env_runners(num_env_runners=nodes, num_envs_per_env_runner=256, gym_env_vectorize_mode="vector_entry_point")
        .learners(num_learners=0)
        .training(train_batch_size_per_learner=16_384, minibatch_size=2048, num_epochs=4, gamma=0.99)
        .debugging(log_level="ERROR")
    )
    with cluster(nodes):
        algorithm, found = config.build_algo(), []

        def clocks() -> np.ndarray:
            spent = algorithm.env_runner_group.foreach_env_runner(lambda _: time.process_time(), local_env_runner=False)
            return np.array([time.perf_counter(), time.process_time(), *spent])

        for _ in range(count + 1):
            before = clocks()
            result = algorithm.train()
            clock, learning, *sampling = clocks() - before
            steps = result["env_runners"]["num_env_steps_sampled"]
            found.append(tuple(steps / s for s in (clock, learning + max(sampling), max(sampling), learning)))
        algorithm.stop()
    return found[1:]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rllib_nodes", description=__doc__)
    parser.add_argument("environment", nargs="?", default="urban_crossing", metavar="ENV")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="clusters of each size (default: 3)")
    parser.add_argument("--iterations", type=int, default=3, metavar="N", help="in each of them (default: 3)")
    asked = parser.parse_args(arguments)
    os.environ["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"
    torch.set_num_threads(1)
    rates = np.array(
        [
            [np.mean(iterations(asked.environment, nodes, asked.iterations), axis=0) for nodes in NODES]
            for _ in range(asked.rounds)
        ]
    )  # (rounds, nodes, 4)
    table = Table.of_texts(["what"], ["one node", "two nodes", "ratio"])
    for name, (one, two) in zip(NAMES, np.moveaxis(rates, (2, 1), (0, 1)), strict=True):
        ratio = two / one
        error = ratio.std(ddof=1) / math.sqrt(len(ratio)) if len(ratio) > 1 else math.nan
        table.add(name, f"{one.mean():,.0f}/s", f"{two.mean():,.0f}/s", f"{ratio.mean():.2f} ± {error:.2f}")
    place = machine()
    out = Console()
    out.print(f"{place['processor']}, {place['cores_available']} cores, load {place['load_average_at_start']:.1f}\n")
    out.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
