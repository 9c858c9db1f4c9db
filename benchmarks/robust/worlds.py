"""Worlds of `robust` that run on, and what is read off them: estimates, errors, NEES."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.api.engine import Engine
from coopenv.base.seeds import evaluation_seed
from coopenv.estimation.poses import Array
from coopenv.policies import decide, find_agent, restart
from coopenv.scenario import Scenario
from coopenv.sources.worlds import Simulated
from coopenv.world.world import World


def started(scenario: Scenario, seeds: Sequence[int], dtype: str = "float64") -> World:
    """Return a world per seed at its start, none of which is reset when it is over."""
    world = Simulated(scenario).world(len(seeds), dtype, "cpu", None)
    world.reset(seeds)
    world.mask.zero_()
    return world


def estimates(world: World) -> tuple[Array, Array]:
    """Return R (W, N, 3, 3) and p (W, N, 3) as estimated."""
    R = world.view("estimate_rotation").astype(float)
    return R, np.einsum("wnij,wnj->wni", R, world.view("estimate_position").astype(float))


def position_errors(world: World) -> Array:
    """Return position errors (W, N) in m, also of vehicles in a search."""
    truth = world.view("position")[:, world.model.landmarks :]
    return np.asarray(np.linalg.norm(truth - estimates(world)[1], axis=-1))


def nees_of(world: World) -> tuple[Array, Array]:
    """Return NEES / 6 (W, N) and position errors in m of vehicles under way; NaN of others and in a search."""
    (R, p), L = estimates(world), world.model.landmarks
    memory: Any = world.memory
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
    act: Callable[[World, int], Array] | None = None,
) -> tuple[Array, Array, World]:
    """Return NEES / 6 and position errors in m (K, W, N) as `nees_of` does, and the world at the end.

    Args:
        scenario: with the observer `robust`.
        seeds: one per world.
        samples: number of samples.
        every: ticks from one sample to the next.
        skipped: number of first samples that are left out.
        dtype: precision of the worlds.
        act: returns the actions (W, N, 2) of a sample by its number.
    """
    world = started(scenario, seeds, dtype)
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
    engine.reset([evaluation_seed(seed * worlds + world) for world in range(worlds)])
    actions, observed = engine.world.actions.numpy(), engine.view("observation")
    restart(policy, np.ones(engine.view("alive").size, dtype=bool))
    while not engine.view("over").all():
        rows: Any = observed.reshape(-1, observed.shape[-1])
        actions[...] = decide(policy, rows, actions.shape[-1]).reshape(actions.shape)
        engine.step()
        yield engine
