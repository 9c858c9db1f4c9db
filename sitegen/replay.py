"""The replay on the home page: one scene under several observers, whole or with a broken camera.

`python -m sitegen.replay` runs them and writes `docs/javascripts/replay-data.js`, which the page loads from its own
folder. `docs/javascripts/replay.js` draws it.
"""

import base64
import json
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

import coopenv
from coopenv.api.engine import Engine
from coopenv.episode import Episode, Origin, semi_axes
from coopenv.estimation import Sight
from coopenv.observers.registry import states_covariance
from coopenv.runs.scenes import scene_of
from coopenv.viz.stage import Stage, roads, ways
from coopenv.viz.style import vehicle_colour
from sitegen.mirror import ROOT

FILE = ROOT / "docs/javascripts/replay-data.js"
ENVIRONMENT, SEED, LENGTH = "ring:5", 0, 20.0
OBSERVERS = ("riccati", "schmidt_kalman", "robust")
BROKEN = (None, 0, 2)
"""Index of the vehicle whose camera measures nothing; None: no such vehicle."""
STEP = 0.01
"""m and rad, of the whole numbers in the file."""

_SHORTEST = 0.065  # of the scene's side, length of a vehicle as drawn


def record_of(observer: str, broken: int | None, length: float = LENGTH) -> Episode:
    """Return the scene under an observer, s long."""
    blind = {} if broken is None else {f"vehicles.{broken}.camera.miss_probability": 1.0}
    scenario = coopenv.load_scenario(ENVIRONMENT, {"observer.name": observer, "horizon": length, **blind})
    with closing(Engine(scenario)) as engine:
        return scene_of(engine, Origin.of(ENVIRONMENT, scenario, seed=SEED))


def variant(record: Episode) -> dict[str, Any]:
    """Return what an observer estimates: place, heading, 3-sigma ellipse (K, N, 6), and targets in sight (K, N)."""
    turn = ways(record.scenario)
    semi, axes = semi_axes(record["position_covariance"][..., :2, :2])
    semi[~np.isfinite(semi) | (not states_covariance(record.source.observer))] = 0.0
    heading = _yaw(record["rotation_estimate"]) + turn
    along = np.arctan2(axes[..., 1, 1], axes[..., 0, 1])
    numbers = [*np.moveaxis(record["position_estimate"][..., :2], -1, 0), heading, semi[..., 1], semi[..., 0], along]
    visible = record["sight"] == Sight.VISIBLE
    return {
        "estimate": packed(np.stack(numbers, axis=-1)),
        "sight": packed(STEP * (visible @ (1 << np.arange(visible.shape[-1])))),
        "lost": packed(STEP * (record["position_error"] > Stage(record.scenario).bodies()[0][:, 0])),
    }


def _yaw(rotation: np.ndarray) -> np.ndarray:
    return np.asarray(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]))


def packed(values: np.ndarray) -> str:
    """Return numbers in whole steps, as 16-bit integers, least byte first, in base64."""
    whole = np.clip(np.round(np.nan_to_num(values) / STEP), -32768, 32767)
    return base64.b64encode(whole.astype("<i2").tobytes()).decode()


def content(records: Iterable[tuple[str, int | None, Episode]]) -> dict[str, Any]:
    """Return what the page draws of records by observer and broken camera, all of the same motion."""
    variants, first = {}, None
    for observer, broken, record in records:
        variants[f"{observer}/{-1 if broken is None else broken}"] = variant(record)
        first = first or record
    assert first is not None
    stage, scenario = Stage(first.scenario), first.scenario
    L, place = stage.landmarks, first["target_position"]
    heading = _yaw(first["target_rotation"][:, L:]) + ways(scenario)
    size, center = stage.bodies(_SHORTEST * stage.side)
    return {
        "rate": (len(first) - 1) / first.length,
        "frames": len(first),
        "low": stage.low.round(2).tolist(),
        "side": round(stage.side, 2),
        "roads": [corners.round(2).tolist() for corners in roads(scenario)],
        "landmarks": place[0, :L, :2].round(2).tolist(),
        "colours": [vehicle_colour(i) for i in range(stage.vehicles)],
        "size": size[:, :2].round(3).tolist(),
        "center": center[:, :2].round(3).tolist(),
        "step": STEP,
        "truth": packed(np.concatenate([place[:, L:, :2], heading[..., None]], axis=-1)),
        "variants": variants,
    }


def main(file: Path = FILE) -> None:
    """Run every variant and write the file."""
    records = [(observer, broken, record_of(observer, broken)) for observer in OBSERVERS for broken in BROKEN]
    file.write_text(f"window.coopenvReplay={json.dumps(content(records), separators=(',', ':'))}\n", encoding="utf-8")
    for observer, broken, record in records:
        print(observer, broken, (record["position_error"][-1]).round(2))


if __name__ == "__main__":
    main()
