"""The sliding observability Gramian over a way: what was seen over the last metres, however long they took."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.api.engine import Engine
from coopenv.base.errors import ScenarioError
from coopenv.estimation.outcomes import Sight
from coopenv.scenario import load_scenario
from tests.helpers.four_way import FOUR_WAY

SEEN = {"camera.range": 30.0, "camera.miss_probability": 0.0, "topology.acyclic": True, "obstacles": []}


def engine_of(**changes: object) -> Engine:
    names = {key.replace("__", "."): value for key, value in changes.items()}
    engine = Engine(load_scenario(FOUR_WAY, {**SEEN, **names}), 1, "float64")
    engine.reset([0])
    return engine


def expected(samples: list[tuple[float, float, np.ndarray]], length: float) -> float:
    """Return the smallest eigenvalue of samples (way before, way behind, C^T C), in ten blocks of a window."""
    block = length / 10
    newest = int(samples[-1][1] / block)
    kept = [(end - begin, G) for begin, end, G in samples if int(end / block) > newest - 10]
    return float(np.linalg.eigvalsh(sum(w * G for w, G in kept) / sum(w for w, _ in kept))[0])


def test_it_is_the_mean_over_the_last_metres() -> None:
    engine = engine_of(observer__gramian_distance=1.0)
    landmarks = engine.world.model.landmarks
    camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # to body
    rng, samples, way = np.random.default_rng(0), [], 0.0
    compared = 0
    for tick in range(1, 241):
        engine.step(np.array([[[rng.uniform(-1, 1), 0.2]] * 4]) if tick % 6 == 1 else None, ticks=1)
        if tick % 3:
            continue
        now = float(engine.view("distance_driven")[0, 0])
        if now > way:
            R = engine.view("estimate_rotation")[0, 0]
            G = np.zeros((6, 6))
            for n in np.flatnonzero(engine.view("sight")[0, 0, :landmarks] == Sight.VISIBLE):
                b = R @ camera @ engine.view("bearing")[0, 0, n]
                z = engine.view("position")[0, n]
                cross = np.array([[0, -z[2], z[1]], [z[2], 0, -z[0]], [-z[1], z[0], 0]])
                C = (np.eye(3) - np.outer(b, b)) @ np.hstack([-cross, np.eye(3)])
                G += C.T @ C
            samples.append((way, now, G))
            way = now
        if samples:
            engine.refresh()
            compared += 1
            found = engine.view("gramian_min_eigenvalue")[0, 0]
            assert found == pytest.approx(expected(samples, 1.0), rel=1e-6, abs=1e-9)
    assert way > 1.5 and compared > 60


def test_standing_neither_adds_nor_forgets() -> None:
    engine = engine_of(observer__gramian_distance=1.0, noise__enabled=False)
    for _ in range(20):
        engine.step(np.array([[[1.0, 0.0]] * 4]))
    for _ in range(15):  # the speed fades
        engine.step(np.array([[[-1.0, 0.0]] * 4]))
    before = engine.view("gramian_min_eigenvalue").copy()
    for _ in range(20):
        engine.step(np.array([[[-1.0, 0.0]] * 4]))
    assert (before > 0).any()
    np.testing.assert_allclose(engine.view("gramian_min_eigenvalue"), before, rtol=1e-4)


def test_a_fast_vehicle_forgets_the_blocks_that_it_skips() -> None:
    """What it sees lasts for no more than the window, though a sample is longer than a block."""
    engine = engine_of(observer__gramian_distance=0.1)  # blocks of 1 cm, samples of up to 5 cm
    for _ in range(20):
        engine.step(np.array([[[1.0, 0.0]] * 4]))
    kept = engine.view("gramian_time")[0].sum(axis=-1)
    assert (kept > 0.04).all() and (kept < 0.16).all()


def test_a_distance_is_positive() -> None:
    with pytest.raises(ScenarioError, match=r"observer\.gramian_distance: "):
        load_scenario(FOUR_WAY, {"observer.gramian_distance": 0.0})
