"""P stays finite, symmetric and positive definite, and the estimate finite, whatever is seen and however stiff."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.scenario import Scenario
from coopenv.world.world import World
from tests.helpers.builders import LANDMARKS, constant, landmark, scenario, start, vehicle

NOISE = {
    "velocity": 0.05,
    "angular_velocity": 0.02,
    "bearing": {"model": "isotropic", "scale": 0.01},
}
MIXED_ERRORS = (
    {"position_radius": 0.5, "orientation_angle": 0.2},
    {"position_radius": 10.0, "orientation_angle": "uniform"},
    {"position_offset": [30.0, -20.0, 10.0], "orientation_offset_wxyz": [0.0, 0.0, 0.0, 1.0]},
)


def circling(miss: float = 0.5, **observer: object) -> Scenario:
    """Return three vehicles on circles that lose detections and messages at random."""
    vehicles = [
        vehicle(
            (1.5 * i, -1.0 * i, 0.5),
            yaw=0.7 * i,
            motion=constant([0.4, 0.0, 0.0], [0.0, 0.0, 0.2 + 0.1 * i]),
            initial_estimate=error,
        )
        for i, error in enumerate(MIXED_ERRORS)
    ]
    return scenario(
        vehicles,
        noise=NOISE,
        camera={"orientation": "body", "miss_probability": miss, "position": [0.3, 0.0, 0.2]},
        v2x={"delay": 1, "loss": 0.3},
        observer={"q": 25.0, **observer},
    )


def assert_healthy(world: World) -> None:
    state = world.get_state()
    P, R, p = state["covariance"], state["estimate_rotation"], state["estimate_position"]
    assert np.isfinite(P).all()
    assert (np.swapaxes(P, -1, -2) == P).all()
    P = P.astype(float)
    diagonal = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    assert np.isfinite(diagonal).all()
    assert (diagonal > 0.0).all()
    correlation = P / (diagonal[..., :, None] * diagonal[..., None, :])
    assert np.linalg.eigvalsh(correlation).min() > 0.0
    assert np.isfinite(p).all()
    R = R.astype(float)
    slack = 1e-12 if world.precision.name == "float64" else 3e-6
    assert np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max() < slack
    assert np.linalg.det(R).min() > 0.5


def watch(world: World, ticks: int, every: int) -> None:
    for _ in range(ticks // every):
        world.advance(every)
        assert_healthy(world)
    assert (world.get_state()["tick"] == ticks // every * every).all()


def alone(origin: np.ndarray, landmarks: int, k: float) -> Scenario:
    """Return one vehicle near an origin with some landmarks."""
    motion = constant([0.4, 0.0, 0.0], [0.0, 0.0, 0.3])
    return scenario(
        [vehicle(origin, motion=motion, initial_estimate=MIXED_ERRORS[0])],
        landmarks=[landmark(f"L{i}", (origin + p).tolist()) for i, p in enumerate(LANDMARKS[:landmarks])],
        noise=NOISE,
        observer={"k": k, "q": 25.0},
    )


FAR = np.array([1000.0, -500.0, 0.0])
RUNS: dict[str, tuple[Scenario, int, int]] = {
    "stiff": (circling(k=80.0), 6000, 60),
    **{f"almost never a target in view, k={k}": (circling(miss=0.999, k=k), 6000, 30) for k in (1.0, 80.0)},
    **{f"one landmark, k={k}": (alone(np.zeros(3), 1, k), 3000, 20) for k in (1.0, 80.0)},
    **{f"P0={P0}": (circling(k=80.0, P0=P0), 300, 1) for P0 in ([1e-6, 1e-6], [1e3, 1e5], [1e-6, 1e4])},
    "1 km from the origin, condition number of M above 1e12": (alone(FAR, len(LANDMARKS), 80.0), 1800, 10),
}


@pytest.mark.parametrize(("name", "dtype"), [*((name, "float32") for name in RUNS), ("stiff", "float64")])
def test_it_stays_healthy(name: str, dtype: str) -> None:
    made, ticks, every = RUNS[name]
    watch(start(made, range(4), dtype), ticks, every)


@pytest.mark.parametrize("k", [0.6, 1.0, 80.0, 1000.0])
def test_any_gain_over_a_minute_tick_by_tick(k: float) -> None:
    world = start(circling(k=k), range(4), "float32")
    watch(world, 600, 1)
    for _ in range(25):
        world.advance(60)
        assert_healthy(world)


@pytest.mark.parametrize("k", [1.0, 80.0])
def test_nothing_in_view_then_everything(k: float) -> None:
    """Five minutes blind, then every target at once."""
    world = start(circling(miss=1.0, k=k), range(4), "float32")
    watch(world, 18000, 6000)
    growth = 300.0 * np.array([0.1] * 3 + [1.0] * 3)
    P = world.get_state()["covariance"]
    np.testing.assert_allclose(
        np.diagonal(P, axis1=-2, axis2=-1), np.broadcast_to([1.0] * 3 + [100.0] * 3 + growth, (4, 3, 6)), rtol=2e-3
    )
    seeing = start(circling(miss=0.0, k=k), range(4), "float32")
    seeing.set_state(world.get_state())
    for _ in range(300):
        seeing.advance(1)
        assert_healthy(seeing)
