"""Environments of other projects, measured beside coopenv where they are installed; builders run in worker processes.

Actions are drawn beforehand and resets are included, as in coopenv's own cases.
"""

from __future__ import annotations

from importlib.util import find_spec
from itertools import cycle
from typing import Any

import numpy as np

from benchmarks.speed.cases import Built, Case, Library, parallel_step

HIGHWAY = Library(
    "highway-env", "highway_env", "benchmarks.speed.peer_cases:build_highway", ("highway-env", "gymnasium", "numpy")
)
VMAS = Library("VMAS", "vmas", "benchmarks.speed.peer_cases:build_vmas", ("vmas", "torch", "gym", "pyglet"))
MPE2 = Library("mpe2", "mpe2.simple_spread_v3", "benchmarks.speed.peer_cases:build_mpe2", ("mpe2", "pettingzoo"))
PEERS = (HIGHWAY, VMAS, MPE2)

CONTROLLED = 4
"""Agents of highway-env's intersection and of VMAS's scenarios."""
VMAS_BATCHES = (1, 32, 1024)
VMAS_EPISODE = 200
"""Steps."""


def installed(library: Library) -> bool:
    """Return whether the library can be imported here."""
    return find_spec(library.module.partition(".")[0]) is not None


def install_hint(library: Library) -> str:
    """Return what to say of a library that is not installed."""
    return f"not installed: pip install {library.distributions[0]}"


def peer_cases(quick: bool = False) -> list[Case]:
    """Return the peers' cases, installed or not."""
    navigation, road_traffic = ((1, 1024), (1, 32)) if quick else (VMAS_BATCHES, VMAS_BATCHES)
    cases = [
        Case(
            "highway-env intersection",
            HIGHWAY.name,
            1,
            CONTROLLED,
            dtype="float64",
            tick="simulation substeps of all cars on the road",
        )
    ]
    for scenario, tick, batches in (
        ("navigation", "lidar scans", navigation),
        ("road_traffic", "physics steps", road_traffic),
    ):
        options = {"scenario": scenario}
        cases += [Case(f"VMAS {scenario}", VMAS.name, n, CONTROLLED, tick=tick, options=options) for n in batches]
    cases.append(Case("mpe2 simple_spread", MPE2.name, 1, 3, dtype="float64", tick="physics steps"))
    return cases


def build_highway(case: Case) -> Built:
    """Return the multi-agent intersection, four cars under control among some ten."""
    import gymnasium
    import highway_env

    gymnasium.register_envs(highway_env)
    config = {"controlled_vehicles": case.vehicles}  # its default action and observation are the multi-agent ones
    env = gymnasium.make("intersection-multi-agent-v0", config=config, disable_env_checker=True)
    env.reset(seed=0)
    world: Any = env.unwrapped
    rates = world.config
    substeps = rates["simulation_frequency"] // rates["policy_frequency"]
    rng = np.random.default_rng(0)
    actions = cycle([tuple(rng.integers(0, 3, case.vehicles).tolist()) for _ in range(64)])

    def step() -> int:
        _, _, terminated, truncated, _ = env.step(next(actions))
        ticks = substeps * len(world.road.vehicles)
        if terminated or truncated:
            env.reset()
        result: int = ticks
        return result

    return Built(step)


def build_vmas(case: Case) -> Built:
    """Return a VMAS scenario in float32 on one torch thread, reset world by world as trainers do."""
    import torch
    import vmas

    torch.set_num_threads(1)
    env = vmas.make_env(
        case.options["scenario"],
        num_envs=case.worlds,
        device="cpu",
        continuous_actions=True,
        seed=0,
        max_steps=VMAS_EPISODE,
        n_agents=case.vehicles,
    )
    env.reset()
    shapes = [(case.worlds, env.get_agent_action_size(agent)) for agent in env.agents]
    scales = [agent.action.u_range_tensor for agent in env.agents]
    drawn = [
        [(2 * torch.rand(shape) - 1) * scale for shape, scale in zip(shapes, scales, strict=True)] for _ in range(8)
    ]
    actions = cycle(drawn)
    ticks = case.worlds * case.vehicles

    def step() -> int:
        done = env.step(next(actions))[2]
        if done.all():
            env.reset()
        else:
            for world in done.nonzero().flatten().tolist():
                env.reset_at(world)
        return ticks

    return Built(step)


def build_mpe2(case: Case) -> Built:
    """Return simple_spread as a ParallelEnv."""
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=case.vehicles)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = env.action_space(env.possible_agents[0]).n
    return Built(parallel_step(env, lambda: int(rng.integers(actions)), 1))
