"""Who lies is found out before it costs much: five vehicles of which each sees at least two honest targets besides.

The paper's intersection with more neighbours. Honest errors are compared with those in the same worlds without a lie.
`pytest -s -m slow tests/observers/robust/test_lies.py` prints the table of docs/robust_evidence.md.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from coopenv.scenario import Scenario, load_scenario
from tests.helpers.builders import reset, simulate
from tests.helpers.robust_worlds import position_errors

SEEN = (
    ("SL1", "SL2", "SL3"),
    ("SL1", "SL2", "SL3", "vehicle_1"),
    ("SL2", "SL3", "vehicle_1", "vehicle_2"),
    ("SL2", "SL3", "vehicle_1", "vehicle_2", "vehicle_3"),
    ("SL3", "vehicle_1", "vehicle_2", "vehicle_3", "vehicle_4"),
)
LIES: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
    "the first from its first word, 5 m": ((0,), {"kind": "jump"}),
    "the second from its first word, 5 m": ((1,), {"kind": "jump"}),
    "the second from 15 s on, 5 m": ((1,), {"kind": "jump", "start": 15.0}),
    "the second drifts at 5 cm/s from 15 s on": ((1,), {"kind": "drift", "start": 15.0}),
    "the third drifts at 5 cm/s from 15 s on": ((2,), {"kind": "drift", "start": 15.0}),
    "the second repeats itself 1 s late from 15 s on": ((1,), {"kind": "replay", "start": 15.0}),
    "the first two collude from 15 s on, 5 m": ((0, 1), {"kind": "collude", "start": 15.0}),
}


def scene(
    liars: tuple[int, ...] = (), horizon: float = 50.0, *, overrides: dict[str, Any] | None = None, **lie: Any
) -> Scenario:
    """Return the five vehicles, of which some lie."""
    changes = {"observer.name": "robust", "horizon": horizon, **(overrides or {})}
    made = load_scenario("busy_intersection_tracking", changes)
    raw = made.model_dump()
    for vehicle, seen in zip(raw["vehicles"], SEEN, strict=True):
        vehicle["neighbours"] = seen
    for n in liars:
        raw["vehicles"][n]["faults"] = {"lie": lie}
    return Scenario(**raw)


def mean_errors(made: Scenario, seeds: range, seconds: int, start: float) -> np.ndarray:
    """Return (W, N) the mean position error of each vehicle from `start` on, m."""
    world = simulate(made, len(seeds))
    reset(world, seeds)
    found = []
    for k in range(2 * seconds):
        world.advance(30)
        if (k + 1) / 2 > start:
            found.append(position_errors(world))
    return np.mean(found, axis=0)


@cache
def honest(seeds: range, seconds: int, start: float) -> np.ndarray:
    """Return the errors in worlds without a lie."""
    return mean_errors(scene(), seeds, seconds, start)


def costs(name: str, seeds: range, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) by how much larger errors are with a lie than without, NaN for who lies; (W,) that of their mean."""
    liars, lie = LIES[name]
    start = max(lie.get("start", 0.0), 5.0)
    without = honest(seeds, seconds, start).mean(axis=0)
    found = mean_errors(scene(liars, **lie), seeds, seconds, start)
    found[:, list(liars)] = np.nan
    return found.mean(axis=0) / without, np.nanmean(found, axis=1) / without[~np.isnan(found[0])].mean()


@pytest.mark.parametrize("name", LIES)
def test_a_lie_costs_little(name: str) -> None:
    """In most worlds, and on average."""
    each = costs(name, range(6), 25)[1]
    assert np.median(each) < 3.0
    assert each.mean() < 3.0


def test_who_is_honest_is_believed() -> None:
    world = simulate(scene(), 8)
    reset(world, range(8))
    world.advance(60 * 25)
    assert world.memory.monitor.numpy()["exclusions"].sum() <= 1


def verdicts(made: Scenario, seed: int, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, N) how often each vehicle has excluded each other one, and (N,) the position errors, m, in the end."""
    world = simulate(made, 1)
    reset(world, [seed])
    world.advance(60 * seconds)
    return world.memory.monitor.numpy()["exclusions"][0], position_errors(world)[0]


@pytest.mark.parametrize(
    "lie", [{"kind": "jump", "start": 2.0}, {"kind": "replay", "start": 4.0}, {"kind": "drift", "speed": 0.2}], ids=str
)
def test_all_who_see_a_liar_exclude_it_and_nobody_else(lie: dict[str, Any]) -> None:
    excluded = sum(verdicts(scene((1,), 12.0, **lie), seed, 10)[0] for seed in (400, 401))
    assert (excluded[[2, 3, 4], 1] >= 1).all(), excluded
    assert excluded.sum(axis=0)[[0, 2, 3, 4]].max() <= 1, excluded


@pytest.mark.parametrize(
    ("seed", "overrides"),
    [
        (1217, {}),
        (1417, {}),
        (1417, {"camera.extrinsics_error": 0.01745, "camera.extrinsics_position_error": 0.01}),
        (1417, {"faults.clock_offset": 0.02}),
    ],
)
def test_who_has_fitted_its_pose_to_a_lie_changes_its_mind(seed: int, overrides: dict[str, Any]) -> None:
    """Worlds in which a vehicle fits its own pose to a liar's first words, and believes honest ones no more."""
    excluded, off = verdicts(scene((1,), 15.0, overrides=overrides, kind="jump"), seed, 14)
    assert excluded[:, 1].sum() >= 1
    assert (np.delete(off, 1) < 0.5).all(), off


def test_who_has_contradicted_himself_is_not_asked_about_again() -> None:
    """Worlds in which two colluders, who jump at 15 s, would explain more than the two who are honest."""
    found = mean_errors(scene((0, 1), kind="collude", start=15.0), range(1315, 1319), 20, 15.0)
    assert (found[:, 4] < 0.3).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", LIES)
def test_what_lies_cost_in_other_worlds(name: str) -> None:
    ratio, means = costs(name, range(900, 924), 45)
    each = " ".join("-" if np.isnan(r) else f"{r:.2f}" for r in ratio)
    print(f"\n{name}: {means.mean():.2f}({means.std(ddof=1) / np.sqrt(len(means)):.2f}), each {each}")
    assert means.mean() < 3.0
