"""Scenes for the observer `robust`, and what to read off worlds of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.api.engine import Engine
from coopenv.base.seeds import evaluation_seed
from coopenv.observers import Recording
from coopenv.policies import decide, find_agent, restart
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.world.world import World
from tests.helpers.builders import reset, simulate

ISOTROPIC = {
    "noise.bearing.model": "isotropic",
    "noise.bearing.scale": 0.005 / math.sqrt(3.0),
    "noise.bearing.rate": "sample",
    "noise.odometry_rate": "sample",
    "rates.odometry": 60.0,
}
SMALL_ERRORS = {
    "vehicles.*.initial_estimate": {
        "position": None,
        "position_radius": 1.0,
        "orientation_angle": math.radians(10.0),
        "orientation_offset_wxyz": [1.0, 0.0, 0.0, 0.0],
    }
}
"""Initial errors drawn up to 10 degrees and 1 m."""


@cache
def small_errors(horizon: float, seed: int = 0) -> Recording:
    """Isotropic noise of 2.9 mrad; initial errors up to 10 degrees and 1 m."""
    return record(load_scenario("busy_intersection", {**ISOTROPIC, **SMALL_ERRORS, "horizon": horizon}), seed)


@cache
def everybody_sees_everybody(horizon: float) -> Recording:
    """Three landmarks and all other vehicles for each: rumours go round in every way."""
    names = load_scenario("busy_intersection").target_names
    everybody = {f"vehicles.{own}.neighbours": [n for n in names if n != own] for own in names[3:]}
    overrides = {**ISOTROPIC, **SMALL_ERRORS, **everybody, "horizon": horizon, "topology.acyclic": False}
    return record(load_scenario("busy_intersection", overrides), 0)


@cache
def noise_free(horizon: float, name: str = "busy_intersection") -> Recording:
    """The paper's start without noise."""
    return record(load_scenario(name, {"noise.enabled": False, "horizon": horizon}))


@cache
def crowd(horizon: float, leaders: int, gone: int) -> Recording:
    """One vehicle that hears more leaders than it can keep; the first of them are out of its view from a third on.

    Args:
        horizon: s.
        leaders: how many.
        gone: how many go out of view.
    """
    raw = load_scenario("busy_intersection_tracking", {"horizon": horizon}).model_dump()
    template, landmarks = raw["vehicles"][0], tuple(landmark["name"] for landmark in raw["landmarks"])

    def vehicle(place: tuple[float, ...], speed: float, neighbours: tuple[str, ...]) -> dict[str, Any]:
        motion = {**template["motion"], "linear": (0.0, speed, 0.0)}
        return {**template, "initial_pose": {"position": place}, "motion": motion, "neighbours": neighbours}

    lead = [vehicle((-2.0 - 1.5 * n, -10.0 + 2.0 * n, 2.0), 0.3, landmarks) for n in range(leaders)]
    follower = vehicle((-12.0, -16.0, 2.5), 0.6, tuple(f"vehicle_{n + 1}" for n in range(leaders)))
    raw["vehicles"] = [*lead, follower]
    recording = record(Scenario(**raw), 0)
    visible = recording.visible.copy()
    first = recording.landmarks.shape[1]
    visible[recording.ticks // 3 :, leaders, first : first + gone] = False
    return replace(recording, visible=visible, bearings=np.where(visible[..., None], recording.bearings, np.nan))


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
    engine.reset([evaluation_seed(seed * worlds + world) for world in range(worlds)])
    actions, observed = engine.world.actions.numpy(), engine.view("observation")
    restart(policy, np.ones(engine.view("alive").size, dtype=bool))
    while not engine.view("over").all():
        rows: Any = observed.reshape(-1, observed.shape[-1])
        actions[...] = decide(policy, rows, actions.shape[-1]).reshape(actions.shape)
        engine.step()
        yield engine
