"""What is found in the cells of the grid, against plain geometry of all pairs in random scenes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from coopenv.estimation.outcomes import Sight
from tests.helpers.builders import constant, landmark, scenario, start, vehicle
from tests.oracles import geometry

HALF = 60.0


def crowd(seed: int, vehicles: int, landmarks: int, buildings: int) -> dict[str, object]:
    """Return the vehicles, landmarks and buildings of a random scene, far from its origin."""
    rng = np.random.default_rng(seed)
    middle = np.array([310.0, -170.0])

    walls = [
        {
            "name": f"b{k}",
            "center": [*(middle + rng.uniform(-HALF, HALF, 2)).tolist(), 1.0],
            "size": [float(rng.uniform(0.2, 16.0)), float(rng.uniform(0.2, 3.0)), 4.0],
            "yaw": float(rng.uniform(-3, 3)),
        }
        for k in range(buildings)
    ]

    def place() -> list[float]:
        while True:
            p = middle + rng.uniform(-HALF, HALF, 2)
            if all(np.linalg.norm(p - wall["center"][:2]) > np.hypot(*wall["size"][:2]) / 2 + 5.0 for wall in walls):
                return [*p.tolist(), float(rng.uniform(0.4, 1.5))]

    cars = [
        vehicle(
            place(),
            float(rng.uniform(-3, 3)),
            body={"size": rng.uniform(0.5, 6.0, 3).tolist(), "center": rng.uniform(-0.5, 0.5, 3).tolist()},
            camera={"range": float(rng.uniform(10.0, 40.0))},
            motion=constant([float(rng.uniform(-8, 8)), 0.0, 0.0], [0.0, 0.0, float(rng.uniform(-1, 1))]),
        )
        for _ in range(vehicles)
    ]
    marks = [
        landmark(f"L{i}", place(), marker=[0.0, 0.0, 0.5], body={"size": [0.5, 0.5, 1.0]}) for i in range(landmarks)
    ]
    return {"vehicles": cars, "landmarks": marks, "obstacles": walls}


def overlap_by_corners(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> bool:
    """Return whether two upright boxes (centre, rotation, half) overlap: footprints by points of a fine grid."""
    (ca, Ra, ha), (cb, Rb, hb) = a, b
    if abs(ca[2] - cb[2]) > ha[2] + hb[2]:
        return False
    fine = np.linspace(-1.0, 1.0, 81)
    points = np.array(list(product(fine, fine)))
    inside = []
    for (c, R, h), (d, S, g) in (((ca, Ra, ha), (cb, Rb, hb)), ((cb, Rb, hb), (ca, Ra, ha))):
        local = (c[:2] + points * h[:2] @ R[:2, :2].T - d[:2]) @ S[:2, :2]
        inside.append((np.abs(local) <= g[:2]).all(axis=1).any())
    return bool(any(inside))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("vehicles", "landmarks", "buildings", "across"), [(4, 8, 12, 1), (60, 20, 40, 16)])
def test_sights_and_contacts_are_those_of_all_pairs(
    seed: int, vehicles: int, landmarks: int, buildings: int, across: int
) -> None:
    given = crowd(seed, vehicles, landmarks, buildings)
    description = scenario(topology={"mode": "sensed", "acyclic": False}, camera={"model": "omnidirectional"}, **given)
    world = start(description, seed)
    assert world.model.cells.across == across
    world.advance(60)  # up to 8 m, into one another and into buildings
    L = len(description.landmarks)
    R, position = world.view("rotation")[0], world.view("position")[0]
    agents = [*description.landmarks, *description.vehicles]
    center = position + np.einsum("aij,aj->ai", R, [agent.body.center for agent in agents])
    half = np.array([agent.body.size for agent in agents]) / 2
    marker = position + np.einsum("aij,aj->ai", R, [agent.marker for agent in agents])
    scene = world.model.scene
    walls = [getattr(scene, f"obstacle_{name}").numpy() for name in ("center", "rotation", "half")]
    met = set()
    for i in range(vehicles):
        own, sight = L + i, world.view("sight")[0, i]
        for target in {*range(L + vehicles)} - {own}:
            ends = position[own], marker[target]
            distance, reach = np.linalg.norm(ends[1] - ends[0]), description.cameras[i].range
            depths = [reach - distance]
            if distance < reach + 1e-9:
                others = [a for a in range(L + vehicles) if a not in (own, target)]
                depths.append(geometry.depth_by_enumeration(*ends, *walls).max())
                depths.append(geometry.depth_by_enumeration(*ends, center[others], R[others], half[others]).max())
            if np.abs(depths).min() < 1e-9:
                continue
            expected = Sight.VISIBLE
            if distance > reach:
                expected = Sight.OUT_OF_VIEW
            elif depths[1] > 0.0:
                expected = Sight.OCCLUDED_BY_BUILDING
            elif depths[2] > 0.0:
                expected = Sight.OCCLUDED_BY_BODY
            assert sight[target] == expected, (i, target)
            met.add(expected)
        boxes = [(center[a], R[a], half[a]) for a in range(L + vehicles) if a != own]
        boxes += [tuple(part[k] for part in walls) for k in range(len(walls[0]))]
        near = [box for box in boxes if np.linalg.norm(box[0] - center[own]) <= np.linalg.norm(box[2] + half[own])]
        touching = any(overlap_by_corners((center[own], R[own], half[own]), box) for box in near)
        assert world.view("collided")[0, i] == touching
    assert vehicles < 60 or (len(met) == 4 and world.view("collided").any() and not world.view("collided").all())
