"""`robust` where nobody knows where it is: everybody finds its place, and nobody is sure of a wrong one.

`pytest -s -m slow tests/observers/robust/test_lost.py` prints the table of docs/robust_evidence.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.scenario import Scenario, load_scenario
from tests.helpers.builders import reset, simulate
from tests.helpers.robust_worlds import estimates, nees_of, position_errors

NEAR, TURN = 0.5, np.radians(5.0)  # m and rad
WRONG = 20.0  # NEES/6
LOST: dict[str, Any] = {"position": None, "position_radius": 15.0, "orientation_angle": np.pi}
SCENES = ("busy_intersection", "lane:8", "lane:12", "tree:12", "tree:20", "random:20,seed=31", "roots:12")


def all_lost(name: str, seconds: float) -> Scenario:
    """Return an environment in which all start up to 15 m and 180 degrees off, and know that."""
    made = load_scenario(name, {"observer.name": "robust", "horizon": seconds + 1.0})
    start = {**LOST, "orientation_offset_wxyz": (1.0, 0.0, 0.0, 0.0)}
    vehicles = tuple(
        v.model_copy(update={"initial_estimate": v.initial_estimate.model_copy(update=start)}) for v in made.vehicles
    )
    return made.model_copy(update={"vehicles": vehicles})


@dataclass(frozen=True)
class Outcome:
    """How a scene went."""

    settled: np.ndarray
    """(W, N) s, from which on the estimate is within 0.5 m and 5 degrees; infinite where it is not in the end."""
    wrong: np.ndarray
    """(W, N) share of the time for which a vehicle believes a pose that its own covariance excludes."""
    nees: np.ndarray
    """(W, N) mean NEES/6 in the last quarter."""


def outcome(scenario: Scenario, seeds: range, seconds: float) -> Outcome:
    """Return how worlds of a scenario went, looked at five times a second."""
    world = simulate(scenario, len(seeds), "float32")
    reset(world, seeds)
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
    return Outcome(settled, wrong, np.nanmean(late, axis=0))


@pytest.mark.parametrize("name", ["lane:6", "random:9,seed=2"])
def test_everybody_finds_its_place(name: str) -> None:
    found = outcome(all_lost(name, 24.0), range(8), 24.0)
    assert np.isfinite(found.settled).all()
    assert found.wrong.mean() < 0.005
    assert (found.nees.mean(axis=0) < 2.0).all()


def test_who_hears_of_all_others_finds_its_place_in_the_paper_s_scene() -> None:
    """The fifth vehicle's solutions nearly meet until 17 s: it follows them, and is near long before they part."""
    found = outcome(load_scenario("busy_intersection", {"observer.name": "robust", "horizon": 25.0}), range(16), 24.0)
    assert np.isfinite(found.settled).all() and not found.wrong.any()
    assert np.median(found.settled[:, 4]) < 14.0


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_how_soon_everybody_finds_its_place(name: str) -> None:
    found = outcome(all_lost(name, 60.0), range(7000, 7016), 60.0)
    per_vehicle = np.median(found.settled, axis=0)
    print(
        f"\n| `{name}` | {np.median(per_vehicle):.1f} | {per_vehicle.max():.1f} | {np.isinf(found.settled).mean():.3f} "
        f"| {100.0 * found.wrong.mean():.2f} | {np.nanmean(found.nees, axis=0).max():.2f} |"
    )
    assert np.isfinite(found.settled).mean() > 0.8
    assert found.wrong.mean() < 0.005
