"""Worlds of vehicles with the observer `robust`, and how large its errors are by its own covariances."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.api.engine import Engine
from coopenv.evaluation import held_out_seeds
from coopenv.policies import decide, find_agent, restart
from coopenv.scenario import Scenario
from coopenv.world.world import World
from tests.helpers.builders import reset, simulate


def estimates(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return R (W, N, 3, 3) and p (W, N, 3) as estimated."""
    R = world.view("estimate_rotation").astype(float)
    return R, np.einsum("wnij,wnj->wni", R, world.view("estimate_position").astype(float))


def position_errors(world: World) -> np.ndarray:
    """Return position errors (W, N) in m, also of vehicles in a search."""
    return np.linalg.norm(world.view("position")[:, world.model.landmarks :] - estimates(world)[1], axis=-1)


def nees_of(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return NEES / 6 (W, N) and position errors in m of vehicles under way; NaN of others and in a search."""
    (R, p), L, memory = estimates(world), world.model.landmarks, world.memory
    assert np.isfinite(p).all()
    away = world.view("position")[:, L:].astype(float) - p
    turned = Rotation.from_matrix((np.swapaxes(R, -1, -2) @ world.view("rotation")[:, L:]).reshape(-1, 3, 3))
    e = np.concatenate([turned.as_rotvec().reshape(p.shape), np.einsum("wnji,wnj->wni", R, away)], -1)
    searching = memory.search.numpy()["active"] == 1
    P = np.where(searching[..., None, None], np.eye(6), memory.P.numpy()[:, :, 0, 0])
    assert (np.linalg.eigvalsh(P)[..., 0] > 0.0).all()
    under_way = (world.view("ended") == 0) & ~searching
    found = np.einsum("wni,wni->wn", e, np.linalg.solve(P, e[..., None])[..., 0]) / 6.0
    return np.where(under_way, found, np.nan), np.where(under_way, np.linalg.norm(away, axis=-1), np.nan)


def watched(
    scenario: Scenario,
    seeds: Sequence[int],
    samples: int,
    every: int,
    *,
    skipped: int = 0,
    dtype: str = "float64",
    act: Callable[[World, int], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, World]:
    """Return NEES / 6 and position errors in m (K, W, N) as `nees_of` does, and the world in the end.

    There is a sample after so many ticks each; of the first ones `skipped` are left out. `act` gives the actions.
    """
    world = simulate(scenario, len(seeds), dtype)
    reset(world, seeds)
    found = []
    for k in range(samples):
        if act is not None:
            world.actions.numpy()[...] = np.clip(act(world, k), -1, 1)
        world.advance(every)
        if k >= skipped:
            found.append(nees_of(world))
    nees, errors = (np.array(part) for part in zip(*found, strict=True))
    return nees, errors, world


def steps_of(agent: str, scenario: Scenario, worlds: int, seed: int) -> Iterator[Engine]:
    """Yield the engine after every decision of an agent, until all episodes are over."""
    engine, policy = Engine(scenario, worlds), find_agent(agent).policy(scenario)
    engine.reset(held_out_seeds(seed, worlds))
    actions, observed = engine.world.actions.numpy(), engine.view("observation")
    restart(policy, np.ones(engine.view("alive").size, dtype=bool))
    while not engine.view("over").all():
        rows: Any = observed.reshape(-1, observed.shape[-1])
        actions[...] = decide(policy, rows, actions.shape[-1]).reshape(actions.shape)
        engine.step()
        yield engine
