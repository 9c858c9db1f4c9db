"""A camera whose mounting is declared not to be known: robust finds out how it is turned, and is as sure as it may be.

`pytest -s -m slow tests/observers/robust/test_mounting.py` prints the figures of docs/robust_evidence.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopenv.observers.robust.memory import MOUNTING
from coopenv.scenario import load_scenario
from coopenv.world.world import World
from tests.helpers.robust_worlds import watched

TURNED = {"camera.extrinsics_error": 0.01745}  # rad per axis: 1 deg


def judged(name: str, seeds: range, start: int, end: int, **overrides: Any) -> tuple[np.ndarray, np.ndarray, World]:
    """Return (W, N) the mean NEES/6 and error in m of each vehicle from one second to another; and the world."""
    made = load_scenario(name, {"observer.name": "robust", **TURNED, **overrides})
    nees, errors, world = watched(made, seeds, end, round(made.rates.camera), skipped=start)
    return nees.mean(axis=0), errors.mean(axis=0), world


def test_it_is_as_sure_as_it_may_be_and_finds_out_how_the_camera_is_turned() -> None:
    """A car that goes straight on tells its heading from the camera's by where its odometry leads."""
    nees, _, world = judged("busy_intersection_tracking", range(16), 10, 40)
    assert (nees.mean(axis=0) < 2.5).all()
    R = world.memory.member.numpy()["pose"]["R"][:, 0, MOUNTING]
    turn = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2
    true = world.view("camera_turn")[:, 0]
    frame = world.model.camera.numpy()["rotation"][0]
    error = turn - true @ frame.T
    P = world.memory.P.numpy()[:, 0, MOUNTING, MOUNTING, :3, :3]
    sizes = np.einsum("wi,wi->w", error, np.linalg.solve(P, error[..., None])[..., 0])
    assert sizes.mean() < 9.0  # of three numbers; about 6 was seen, with a standard error of 1.5
    assert np.sqrt((error**2).mean()) < 0.7 * TURNED["camera.extrinsics_error"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["busy_intersection_tracking", "lane:8", "tree:15"])
def test_figures_in_other_worlds(name: str) -> None:
    seeds = range(700, 732)
    nees, error, _ = judged(name, seeds, 10, 40)
    without, good, _ = judged(name, seeds, 10, 40, **{"camera.extrinsics_error": 0.0})
    print(f"\n{name}: ANEES/6 {_text(nees)}, error cm {_cm(error)}; of a true camera {_text(without)}, {_cm(good)}")
    assert (nees.mean(axis=0) < 2.5).all()


def _text(values: np.ndarray) -> str:
    return " ".join(f"{m:.2f}({s:.2f})" for m, s in zip(values.mean(axis=0), _error(values), strict=True))


def _cm(values: np.ndarray) -> str:
    return " ".join(f"{100 * m:.1f}" for m in values.mean(axis=0))


def _error(values: np.ndarray) -> np.ndarray:
    return np.asarray(values.std(axis=0, ddof=1) / np.sqrt(len(values)))
