"""Neighbourhood: bodies in cells of the grid, against all pairs; vehicles that keep those nearby, and their memory."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, ScenarioError, ScenarioWarning
from coopenv.estimation import Sight
from coopenv.scenario import Scenario
from coopenv.world.state import size_of, state_sizes, state_struct
from tests.helpers.builders import assert_same, constant, landmark, scenario, simulate, start, vehicle
from tests.oracles import geometry

RANGE = 25.0


def street(most: int | None, vehicles: int = 40, observer: str = "riccati", **sections: Any) -> Scenario:
    """Return vehicles that drive fast among as many landmarks, so that many come into range and leave it."""
    rng = np.random.default_rng(3)
    half = 6.0 * np.sqrt(vehicles)
    places = rng.uniform(-half, half, (2 * vehicles, 2))
    cars = [
        vehicle(
            [*place, 0.5],
            float(rng.uniform(-3, 3)),
            body={"size": [4.0, 2.0, 1.5]},
            marker=[0.0, 0.0, 1.0],
            motion=constant([float(rng.uniform(0, 25)), 0, 0], [0, 0, float(rng.uniform(-0.5, 0.5))]),
            initial_estimate={"position_offset": [0.3, 0.2, 0.0]},
        )
        for place in places[:vehicles].tolist()
    ]
    sections.setdefault("v2x", {"delay": 1, "range": 30.0})
    return scenario(
        cars,
        landmarks=[landmark(f"L{i}", [*place, 2.0]) for i, place in enumerate(places[vehicles:].tolist())],
        topology={"mode": "sensed", "acyclic": False, "most_nearby": most, **sections.pop("topology", {})},
        camera={"model": "omnidirectional", "range": RANGE},
        observer={"name": observer},
        **sections,
    )


VARIANTS: dict[str, dict[str, Any]] = {
    "cyclic": {},
    "acyclic": {"topology": {"acyclic": True}, "v2x": {"range": 20.0}},
    "all": {
        "topology": {"acyclic": True},
        "v2x": {"links": "all", "range": 35.0, "loss": 0.3, "period": 3, "delay": 2, "staleness": 0.5},
    },
    "faults": {
        "faults": {"clock_offset": 0.05, "map_error": {"chance": 1.0, "offset": 0.5}},
        "randomisation": {"camera_range": [0.7, 1.3]},
        "map": {"accuracy": 0.2},
    },
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("observer", ["riccati", pytest.param("robust", marks=pytest.mark.slow)])
def test_results_are_those_of_all_pairs(variant: str, observer: str) -> None:
    worlds = [start(street(most, observer=observer, **VARIANTS[variant]), 5) for most in (None, 60)]
    everything, nearby = worlds
    met = set()
    for _ in range(12):
        for world in worlds:
            world.advance(5)
        met |= {*nearby.view("kept_agent")[0, 0].tolist()}
        for name in ("estimate_rotation", "estimate_position", "covariance", "gramian_22", "protection_level"):
            assert_allclose(nearby.view(name), everything.view(name), rtol=1e-9, atol=1e-12, err_msg=name)
        assert_array_equal(nearby.view("collided"), everything.view("collided"))
        sight, of_all = nearby.view("sight"), everything.view("sight")
        assert_array_equal(sight == Sight.VISIBLE, of_all == Sight.VISIBLE)
        kept = sight != Sight.NOT_A_NEIGHBOUR
        assert_array_equal(sight[kept], of_all[kept])
        assert_array_equal(nearby.view("arriving"), everything.view("arriving"))
    assert len(met) > nearby.view("kept_count")[0, 0]  # some have made room


def test_all_in_range_are_kept_in_order() -> None:
    world = start(street(60), 0)
    for _ in range(10):
        world.advance(6)
        position, L = world.view("position")[0], world.model.landmarks
        for i in range(world.model.vehicles):
            distance = np.linalg.norm(position - position[L + i], axis=1)
            in_range = {a for a in np.flatnonzero(distance < np.where(np.arange(len(distance)) < L, RANGE, 30.0))}
            count = int(world.view("kept_count")[0, i])
            agents = world.view("kept_agent")[0, i][world.view("kept_order")[0, i, :count]].tolist()
            assert in_range - {L + i} <= {*agents}
            assert agents == sorted({*agents})


def test_too_many_in_range_are_one_line() -> None:
    with pytest.raises(CoopenvError, match=r"^topology\.most_nearby: more than 5 targets and senders are in range of "):
        start(street(5), 0)
    world = simulate(street(5), 1)
    world.device = "cuda:0"  # where only resets look
    world.reset([0])
    crowded = world.view("crowded") > 0
    for _ in range(20):
        world.advance(30)
        now = world.view("crowded") > 0
        assert crowded.any() and now[crowded].all()  # until the next reset
        crowded = now
    world.mask.fill_(1)
    world.restart()  # as an automatic restart on the device
    assert (world.view("crowded") > 0)[crowded].all()
    with pytest.warns(ScenarioWarning, match=r"more than 5 targets and senders are in range of vehicle_\d+ in world 0"):
        world.reset([0])


@pytest.mark.parametrize(
    ("sections", "problem"),
    [
        ({"v2x": {}}, r"v2x\.range: needed with topology\.most_nearby"),
        ({"sensing": "ideal"}, r"topology\.most_nearby: needs topology\.mode = 'sensed'"),
        ({"topology": {"mode": "fixed"}}, r"topology\.most_nearby: needs topology\.mode = 'sensed'"),
    ],
)
def test_scenarios_without_ranges_are_refused(sections: dict[str, Any], problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem):
        street(60, **sections)


def test_observers_on_the_host_are_refused() -> None:
    with pytest.raises(CoopenvError, match=r"^topology\.most_nearby: observer 'smoother' runs on the host"):
        Engine(street(60, observer="smoother"))


def test_saved_states_go_on_as_they_were_and_are_checked() -> None:
    world = start(street(60), 0)
    world.advance(6)
    saved = world.get_state()
    world.advance(6)
    expected = world.get_state()
    world.set_state(saved)
    world.advance(6)
    assert_same(world.get_state(), expected)
    saved["kept_agent"][0, 0, 0] = 1000
    with pytest.raises(CoopenvError, match="'kept_agent'"):
        world.set_state(saved)


def test_memory_grows_with_the_vehicles() -> None:
    sizes = []
    for vehicles in (40, 160):
        world = simulate(street(60, vehicles), 1)
        sizes.append(size_of(state_struct(world.precision), state_sizes(world.model, 1)))
    assert sizes[1] < 4.1 * sizes[0]


def test_observations_have_a_row_for_each_that_is_kept() -> None:
    engine = Engine(street(60), 1, "float64")
    engine.reset([0])
    engine.step()
    field = engine.layout["bearing_mask"]
    assert field.shape == (60,)
    seen = field.values(engine.view("observation"))[0]
    count = engine.view("kept_count")[0]
    for i in range(len(seen)):
        agents = np.sort(engine.view("kept_agent")[0, i][: count[i]])
        assert_array_equal(seen[i, : count[i]] == 1.0, engine.view("sight")[0, i, agents] == Sight.VISIBLE)
        assert not seen[i, count[i] :].any()


def test_the_map_is_found_in_the_grid_as_among_all_landmarks() -> None:
    sections: dict[str, Any] = {"observation": {"include": ["map"], "map_size": 12, "map_scale": 300.0}}
    engine = Engine(street(60, 80, **sections), 1, "float64")
    engine.reset([1])
    world = engine.world
    for step in range(3):
        engine.step()
        if step == 2:  # one off the map, and one between two landmarks of the same distance
            world.view("estimate_rotation")[0, :2] = np.eye(3)
            world.view("estimate_position")[0, 0] = [5000.0, 0.0, 0.0]
            world.view("estimate_position")[0, 1] = world.view("position")[0, [3, 4]].mean(axis=0)
            engine.refresh()
        found = engine.layout["map_position"].values(engine.view("observation").astype(float))[0]
        R, p = (engine.view(f"estimate_{name}")[0] for name in ("rotation", "position"))
        for i in range(80):
            offsets = world.view("position")[0, :80] - R[i] @ p[i]
            order = np.argsort(np.hypot(*offsets.T[:2]), kind="stable")[:12]
            assert_allclose(found[i], np.clip(offsets[order] @ R[i], -300.0, 300.0), atol=1e-3)


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


@pytest.mark.parametrize(
    ("seed", "vehicles", "landmarks", "buildings", "across"),
    [(0, 4, 8, 12, 1), (1, 4, 8, 12, 1), (2, 4, 8, 12, 1), (1, 60, 20, 40, 16)],
)
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
