"""Figures of the studies: ANEES and errors by time, costs of lies, times of searches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.robust.scenes import LIES, ROBUST, Drawn, built, with_liars
from benchmarks.robust.worlds import estimates, nees_of, position_errors, started, steps_of, watched
from coopenv.estimation.poses import Array
from coopenv.scenario import Scenario, load_scenario
from coopenv.world.world import World


def by_window(name: str, overrides: dict[str, float], seeds: range, edges: tuple[int, ...]) -> tuple[Array, Array]:
    """Return (windows, W, N) the mean NEES/6 and (windows, N) the RMS position error, m, between seconds."""
    made = load_scenario(name, {**ROBUST, "horizon": float(edges[-1]) + 1.0, **overrides})
    half = round(made.rates.camera) // 2
    nees, errors, _ = watched(made, seeds, 2 * edges[-1], half, skipped=2 * edges[0])
    windows = 2 * (np.array(edges[1:-1]) - edges[0])
    means = [part.mean(axis=0) for part in np.split(nees, windows)]
    return np.array(means), np.array([np.sqrt((part**2).mean(axis=(0, 1))) for part in np.split(errors, windows)])


WINDOWS = ((5, 10), (10, 20), (20, 40))
"""s, of drawn scenes."""


def consistency(drawn: Drawn) -> Array:
    """Return (windows, W, N) the mean NEES/6 of 8 worlds; NaN where a vehicle never knows its pose."""
    half = int(drawn.overrides["rates.camera"]) // 2
    at = np.arange(1, 81) * half / drawn.overrides["rates.camera"]
    nees = watched(built(drawn), range(31000, 31008), len(at), half)[0]
    parts = [nees[(at > start) & (at <= end)] for start, end in WINDOWS]
    counts = [np.isfinite(part).sum(axis=0) for part in parts]
    return np.array([np.nansum(p, axis=0) / np.where(n > 0, n, np.nan) for p, n in zip(parts, counts, strict=True)])


def by_vehicle(environment: str, agent: str, lasting: dict[str, Any], worlds: int) -> tuple[Array, Array, Array]:
    """Return (N,) ANEES from 2 s on and its standard error, and (K, W, N) position errors, m, of an agent's episodes.

    Every world counts alike, however long its episode; vehicles that are not there do not count.
    """
    found = [
        nees_of(engine.world) for engine in steps_of(agent, load_scenario(environment, ROBUST | lasting), worlds, 0)
    ]
    nees, errors = (np.array(part)[20:] for part in zip(*found, strict=True))
    known = np.isfinite(nees).sum(axis=0)
    vehicles = np.where(known > 0, np.nansum(nees, axis=0) / np.maximum(known, 1), np.nan)
    return np.nanmean(vehicles, axis=0), np.nanstd(vehicles, axis=0) / np.sqrt((known > 0).sum(axis=0)), errors


def judged(name: str, seeds: range, start: int, end: int, **overrides: Any) -> tuple[Array, Array, World]:
    """Return (W, N) the mean NEES/6 and error in m of each vehicle from one second to another; and the world."""
    made = load_scenario(name, {**ROBUST, **overrides})
    nees, errors, world = watched(made, seeds, end, round(made.rates.camera), skipped=start)
    return nees.mean(axis=0), errors.mean(axis=0), world


def mean_errors(made: Scenario, seeds: range, seconds: int, start: float) -> Array:
    """Return (W, N) the mean position error of each vehicle from `start` on, m."""
    world = started(made, seeds)
    found = []
    for k in range(2 * seconds):
        world.advance(30)
        if (k + 1) / 2 > start:
            found.append(position_errors(world))
    return np.asarray(np.mean(found, axis=0))


@cache
def _honest(seeds: range, seconds: int, start: float) -> Array:
    return mean_errors(with_liars(), seeds, seconds, start)


def costs(name: str, seeds: range, seconds: int) -> tuple[Array, Array]:
    """Return the ratios of errors with a lie to errors without it.

    Args:
        name: title in `LIES`.
        seeds: one per world.
        seconds: s of simulation.

    Returns:
        (N,) ratios by vehicle, NaN for liars, and (W,) ratios of the mean over honest vehicles.
    """
    liars, lie = LIES[name]
    start = max(lie.get("start", 0.0), 5.0)
    without = _honest(seeds, seconds, start).mean(axis=0)
    found = mean_errors(with_liars(liars, **lie), seeds, seconds, start)
    found[:, list(liars)] = np.nan
    return found.mean(axis=0) / without, np.nanmean(found, axis=1) / without[~np.isnan(found[0])].mean()


NEAR, TURN = 0.5, np.radians(5.0)
"""Largest errors, m and rad, of a vehicle that has found its place."""
WRONG = 20.0
"""NEES/6 above which a pose is wrong."""


@dataclass(frozen=True)
class Search:
    """Results of vehicles that start lost."""

    settled: Array
    """(W, N) s, from which on the estimate is within `NEAR` and `TURN`; infinite where it is not at the end."""
    wrong: Array
    """(W, N) share of the time for which a vehicle holds a pose that its own covariance excludes."""
    nees: Array
    """(W, N) mean NEES/6 in the last quarter."""


def search(scenario: Scenario, seeds: range, seconds: float) -> Search:
    """Return how worlds of a scenario went, looked at five times a second."""
    world = started(scenario, seeds, "float32")
    L, ticks = world.model.landmarks, round(scenario.rates.camera) // 5
    near, nees = [], []
    for _ in range(round(5 * seconds)):
        world.advance(ticks)
        away = position_errors(world)
        turned = np.swapaxes(estimates(world)[0], -1, -2) @ world.view("rotation")[:, L:]
        turn = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude().reshape(away.shape)
        near.append((away < NEAR) & (turn < TURN))
        nees.append(nees_of(world)[0])
    settled = np.where(near[-1], (len(near) - np.argmin(np.array(near)[::-1], axis=0)) / 5.0, np.inf)
    settled = np.where(np.all(near, axis=0), 0.0, settled)
    late = np.array(nees[len(nees) * 3 // 4 :])
    wrong = (np.nan_to_num(np.array(nees)) > WRONG).mean(axis=0)
    return Search(settled, wrong, np.nanmean(late, axis=0))
