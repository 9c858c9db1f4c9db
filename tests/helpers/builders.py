"""Small scenarios from plain data, worlds of them, and what to read off a world's state."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.base.errors import ScenarioWarning
from coopenv.scenario import Scenario, parse_scenario
from coopenv.sources.worlds import Simulated
from coopenv.world.world import World
from tests.oracles import continuous

LANDMARKS = ((3.0, 3.0, 2.0), (-3.0, 2.5, 1.0), (0.5, 4.0, 3.0), (4.0, -2.0, 1.5))


def landmark(name: str, position: Sequence[float], **more: Any) -> dict[str, Any]:
    return {"name": name, "position": list(position), **more}


def vehicle(position: Sequence[float] = (0.0, 0.0, 0.5), yaw: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"initial_pose": {"position": list(position), "yaw": yaw}, **more}


def constant(linear: Sequence[float], angular: Sequence[float] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    return {"kind": "constant", "linear": list(linear), "angular": list(angular)}


FOLLOWING = (["L1", "L2", "L3"], ["L1", "L2", "vehicle_1"], ["L3", "vehicle_1", "vehicle_2"])


def circling(neighbours: Sequence[list[str]] | None = None, **more: Any) -> list[dict[str, Any]]:
    """Return vehicles that drive circles: by default three, each of which hears all before it."""
    motion = constant([0.3, 0.0, 0.0], [0.0, 0.0, 0.2])
    names = neighbours or FOLLOWING
    return [vehicle((2.0 * i, -1.0, 0.5), motion=motion, neighbours=n, **more) for i, n in enumerate(names)]


def raw(vehicles: Sequence[dict[str, Any]] | None = None, **sections: Any) -> dict[str, Any]:
    """Return the data of a scenario: by default one standing vehicle among four landmarks."""
    return {
        "title": "test",
        "horizon": 3600.0,
        "landmarks": [landmark(f"L{i + 1}", p) for i, p in enumerate(LANDMARKS)],
        "camera": {"orientation": "body"},
        "vehicles": list(vehicles) if vehicles is not None else [vehicle()],
        **sections,
    }


def scenario(vehicles: Sequence[dict[str, Any]] | None = None, **sections: Any) -> Scenario:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        return parse_scenario(raw(vehicles, **sections), "test")


def simulate(description: Scenario, worlds: int, dtype: str = "float64", threads: int | None = None) -> World:
    """Return worlds with the observer that the scenario names."""
    return Simulated(description).world(worlds, dtype, "cpu", threads)


def start(description: Scenario, seeds: Sequence[int] | int = 0, dtype: str = "float64") -> World:
    """Return a world per seed, reset."""
    seeds = [seeds] if isinstance(seeds, int) else list(seeds)
    world = simulate(description, len(seeds), dtype)
    reset(world, seeds)
    return world


def reset(world: World, seeds: Sequence[int] | None = None, mask: np.ndarray | None = None) -> None:
    """Start new episodes and let all worlds run on."""
    world.reset(seeds, mask)
    world.mask.zero_()


def run(world: World, ticks: int, *names: str) -> list[dict[str, np.ndarray]]:
    """Return the state at the start and after each of `ticks` ticks: the fields of some names, else everything."""

    def state() -> dict[str, np.ndarray]:
        return {name: world.view(name).copy() for name in names} if names else world.get_state()

    states = [state()]
    for _ in range(ticks):
        world.advance(1)
        states.append(state())
    return states


def command(world: World, actions: Any) -> None:
    world.actions.assign(np.broadcast_to(actions, (world.worlds, world.model.vehicles, world.model.action_size)).copy())


def estimated_position(state: dict[str, np.ndarray]) -> np.ndarray:
    """Return Rhat phat (W, N, 3)."""
    return np.einsum("wnij,wnj->wni", state["estimate_rotation"], state["estimate_position"])


def errors(world: World, state: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return |pbar - Rhat phat| (W, N) in m and the geodesic angle (W, N) in degrees."""
    first = world.model.landmarks
    position = np.linalg.norm(state["position"][:, first:] - estimated_position(state), axis=-1)
    return position, continuous.angle_between_deg(state["estimate_rotation"], state["rotation"][:, first:])


State = dict[str, np.ndarray]


def assert_same(a: State, b: State, rows_a: object = slice(None), rows_b: object = slice(None)) -> None:
    """Compare two saved states, or rows of them, bit for bit."""
    assert a.keys() == b.keys()
    for name in a:
        assert same_bits(a[name][rows_a], b[name][rows_b]), name


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def quaternion_wxyz(R: np.ndarray) -> list[float]:
    return Rotation.from_matrix(R).as_quat(scalar_first=True).tolist()


def from_oracle(case: continuous.Scenario, rate: float, **sections: Any) -> Scenario:
    """Return the same noise-free world as an oracle's scenario; all lever arms must be equal."""
    names = [f"L{j + 1}" for j in range(len(case.landmarks))]
    names += [f"vehicle_{i + 1}" for i in range(case.num_vehicles)]
    vehicles = [
        {
            "initial_pose": {"position": case.position[i].tolist(), "quaternion_wxyz": quaternion_wxyz(case.R[i])},
            "initial_estimate": {
                "position": case.position_hat[i].tolist(),
                "quaternion_wxyz": quaternion_wxyz(case.R_hat[i]),
            },
            "motion": constant(case.velocity[i].tolist(), case.angular_velocity[i].tolist()),
            "neighbours": [names[j] for j in case.neighbours[i]],
        }
        for i in range(case.num_vehicles)
    ]
    landmarks = [
        landmark(names[j], case.landmarks[j].tolist(), motion=constant(case.landmark_velocity[j].tolist()))
        for j in range(len(case.landmarks))
    ]
    return scenario(
        vehicles,
        landmarks=landmarks,
        camera={"orientation": "body", "position": case.lever_arm[0].tolist()},
        rates={"camera": rate, "decision": rate},
        observer={
            "k": case.k,
            "q": case.q,
            "V": [case.V[0, 0], case.V[3, 3]],
            "P0": [case.P0[0, 0], case.P0[3, 3]],
        },
        **sections,
    )
