"""`robust` in scenes that are drawn at random: graph, size, speeds, rates, noise, radio, errors that last, starts.

`pytest -s -m slow tests/observers/robust/test_drawn.py` prints, for each, the largest ANEES/6 of a vehicle by window.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from coopenv.scenario import Scenario, load_scenario
from tests.helpers.robust_worlds import watched

WINDOWS = ((5, 10), (10, 20), (20, 40))  # s
WORLDS = 8


class Drawn(NamedTuple):
    """A scene, and how it is changed."""

    name: str
    overrides: dict[str, Any]
    scale: float  # of all lengths and speeds
    turn: float  # rad, of the start
    offset: float  # m, likewise


def draw(number: int) -> Drawn:
    """Return the scene of a number."""
    random = np.random.default_rng(77000 + number)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    kind = str(random.choice(["lane", "roots", "tree", "random", "random", "ring"]))
    name = f"{kind}:{random.integers(4, 25)}"
    if kind in ("lane", "tree", "random"):
        name += f",seen={random.integers(2, 6)}"
    if kind == "ring":
        name += f",seen={random.integers(1, 3)}"
    if kind == "random":
        name += f",seed={random.integers(1000)}"
    camera = float(random.choice([10, 15, 20, 30, 60]))
    overrides: dict[str, Any] = {
        "rates.camera": camera,
        "rates.odometry": float(random.choice([10, 20, 50, 100, camera])),
        "rates.decision": 5.0,
        "noise.velocity": between(0.02, 0.4),
        "noise.angular_velocity": between(0.002, 0.05),
        "noise.bearing.scale": between(0.0005, 0.02),
        "v2x.period": int(max(1, round(camera * between(0.03, 0.5)))),
        "v2x.delay": int(random.choice([0, 1, round(camera * 0.1), round(camera * 0.2)])),
        "v2x.loss": float(random.choice([0.0, 0.0, 0.1, 0.3, 0.5])),
    }
    for key, chance, low, high in (
        ("noise.gyro_bias", 0.3, 0.003, 0.03),
        ("noise.odometry_scale", 0.3, 0.01, 0.06),
        ("camera.extrinsics_error", 0.2, 0.003, 0.03),
    ):
        if random.random() < chance:
            overrides[key] = between(low, high)
    if random.random() < 0.2:
        overrides["camera.position"] = random.uniform(-1.0, 1.0, 3).tolist()
    scale = between(0.5, 20.0)
    return Drawn(name, overrides, scale, between(0.02, 0.35), between(0.1, 2.0) * max(1.0, scale**0.5))


def built(drawn: Drawn) -> Scenario:
    """Return the scenario of a drawn scene."""
    made = load_scenario(drawn.name, {"observer.name": "robust", "horizon": 41.0, **drawn.overrides})

    def longer(values: Any) -> tuple[float, ...]:
        return tuple(drawn.scale * value for value in values)

    landmarks = [mark.model_copy(update={"position": longer(mark.position)}) for mark in made.landmarks]
    vehicles = []
    for vehicle in made.vehicles:
        motion = vehicle.motion.model_dump()
        for part in (motion, *motion.get("segments", ())):
            if "linear" in part:
                part["linear"] = longer(part["linear"])
        start = {"orientation_angle": drawn.turn, "position_radius": drawn.offset}
        changed = {
            "motion": type(vehicle.motion).model_validate(motion),
            "initial_pose": vehicle.initial_pose.model_copy(update={"position": longer(vehicle.initial_pose.position)}),
            "initial_estimate": vehicle.initial_estimate.model_copy(update=start),
        }
        vehicles.append(vehicle.model_copy(update=changed))
    return made.model_copy(update={"landmarks": tuple(landmarks), "vehicles": tuple(vehicles)})


def consistency(drawn: Drawn) -> np.ndarray:
    """Return (windows, W, N) the mean NEES/6; NaN where a vehicle never knows its pose."""
    half = int(drawn.overrides["rates.camera"]) // 2
    at = np.arange(1, 81) * half / drawn.overrides["rates.camera"]
    nees = watched(built(drawn), range(31000, 31000 + WORLDS), len(at), half)[0]
    parts = [nees[(at > start) & (at <= end)] for start, end in WINDOWS]
    counts = [np.isfinite(part).sum(axis=0) for part in parts]
    return np.array([np.nansum(p, axis=0) / np.where(n > 0, n, np.nan) for p, n in zip(parts, counts, strict=True)])


def test_noise_of_odometry_is_no_error_of_its_scale() -> None:
    """Four vehicles, a third as much noise as speed: the scale seemed to be off by a sixth, ANEES/6 was 3.4."""
    anees = np.nanmean(consistency(draw(557)), axis=1)
    assert (anees > 0.4).all() and (anees < 1.6).all(), anees


@pytest.mark.slow
def test_it_is_consistent_in_scenes_that_nobody_chose() -> None:
    """Some vehicles far down a large graph are surer than they may be, few by much."""
    typical, worst = [], []
    for number in range(500, 560):
        drawn = draw(number)
        anees = np.nanmean(consistency(drawn), axis=1)
        typical.append(np.nanmedian(anees, axis=1))
        worst.append(np.nanmax(anees, axis=1))
        print(f"\n{number} {drawn.name}: largest ANEES/6 {worst[-1].round(2)}, median {typical[-1].round(2)}", end="")
    print(f"\nmedian over scenes of the median {np.median(typical, axis=0).round(2)}", end="")
    print(f", of the largest {np.median(worst, axis=0).round(2)}; above 2: {(np.array(worst) > 2.0).mean(axis=0)}")
    assert (np.abs(np.median(typical, axis=0) - 1.0) < 0.2).all()
    assert (np.array(worst) > 2.0).mean() < 0.25
