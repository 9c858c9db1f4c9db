"""Checks across sections: topology, starts, limits, and warnings where the theory's conditions fail."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.base.errors import ScenarioError, ScenarioWarning
from coopenv.scenario import Scenario, files, load_scenario, parse_scenario, routes, starts
from coopenv.scenario.bodies import with_groups
from coopenv.scenario.schema import neighbour_sets, processing_order
from tests.helpers import builders
from tests.helpers.builders import errors, landmark, run, start, vehicle


def fleet(*neighbours: list[str] | None, **sections: Any) -> Scenario:
    """Parse one vehicle per list of neighbours (None: the default), with warnings as errors off."""
    given = [{} if names is None else {"neighbours": names} for names in neighbours]
    vehicles = [vehicle((2.0 * i, 0, 0), **more) for i, more in enumerate(given)]
    return builders.scenario(**{"vehicles": vehicles, **sections})


def test_default_neighbours_are_all_landmarks_and_leaders() -> None:
    assert neighbour_sets(fleet(None, None, None)) == [[0, 1, 2, 3], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 5]]
    everyone = neighbour_sets(fleet(None, None, topology={"acyclic": False}))
    assert everyone == [[0, 1, 2, 3, 5], [0, 1, 2, 3, 4]]


def order_of(scenario: Scenario) -> list[int]:
    return processing_order(scenario, neighbour_sets(scenario))


@pytest.mark.parametrize(
    ("neighbours", "order"),
    [
        ([["L1"], ["vehicle_1"], ["vehicle_2"]], [0, 1, 2]),
        ([["vehicle_2"], ["vehicle_3"], ["L1"]], [2, 1, 0]),
        ([["vehicle_3"], ["L1"], ["L1"]], [1, 2, 0]),
        ([["vehicle_4"], ["vehicle_1"], ["L1"], ["vehicle_3"]], [2, 3, 0, 1]),
        ([["L1"], ["L1"], ["L1"]], [0, 1, 2]),
    ],
)
def test_leaders_come_first(neighbours: list[list[str]], order: list[int]) -> None:
    assert order_of(fleet(*neighbours)) == order


@pytest.mark.parametrize(
    "neighbours",
    [
        [["vehicle_2"], ["vehicle_1"]],
        [["L1", "vehicle_3"], ["vehicle_1"], ["vehicle_2"]],
        [["L1"], ["vehicle_3"], ["vehicle_4"], ["L1", "vehicle_2"]],
    ],
)
def test_cycles_are_refused_and_named(neighbours: list[list[str]]) -> None:
    with pytest.raises(ScenarioError, match=r"topology: the neighbours form a cycle \(vehicle_\d -> .*Assumption 1"):
        fleet(*neighbours)
    assert order_of(fleet(*neighbours, topology={"acyclic": False})) == list(range(len(neighbours)))


NAMES = [f"vehicle_{i + 1}" for i in range(40)]


@pytest.mark.parametrize(
    ("neighbours", "sections", "words"),
    [
        ([[name] for name in NAMES[1:] + NAMES[:1]], {}, r"\(vehicle_\d+( -> vehicle_\d+){5} -> 34 more"),
        ([None, ["L1", "vehicle_11"]], {}, r"vehicles.1.neighbours: unknown target 'vehicle_11'"),
        ([None, ["L1", "vehicle_2"]], {}, "vehicles.1.neighbours: a vehicle cannot be its own neighbour"),
        ([None, None], {"observer": {"k": [1.0, 2.0, 3.0]}}, "observer.k: 3 values for 2 vehicles"),
        ([None], {"observer": {"q": {"L9": 1.0}}}, "observer.q: unknown target 'L9'"),
        ([None], {"dynamics": {"latency": 0.2}}, r"dynamics.latency: 0.2 s is longer than one decision \(0.1 s\)"),
        ([None], {"action": {"steering": 1.0}}, "action.steering: 1 rad is above dynamics.max_steering"),
        ([None], {"vehicles": [vehicle((1, 1, 1)), vehicle((1, 1, 1))]}, "vehicle_2 starts in the place of vehicle_1"),
    ],
)
def test_sections_must_fit_one_another(
    neighbours: list[list[str] | None], sections: dict[str, Any], words: str
) -> None:
    with pytest.raises(ScenarioError, match=words):
        fleet(*neighbours, **sections)


def test_values_at_their_limits_are_accepted() -> None:
    assert fleet(None, None, observer={"k": [1.0, 2.0]}).observer.k == (1.0, 2.0)
    fleet(None, dynamics={"latency": 0.1})


WALL = {"name": "house", "center": [0.0, 0.0, 1.0], "size": [4.0, 2.0, 2.0], "yaw": 0.5}
INTO_IT = [{"time": 0, "position": [0, 0, 1]}, {"time": 1, "position": [5, 0, 1]}]


def beside(gap: float) -> dict[str, Any]:
    """Return a car of 2 m that looks at the wall from a gap to its middle, m."""
    return vehicle([np.cos(0.5) * (2.0 + gap), np.sin(0.5) * (2.0 + gap), 1.0], body={"size": [2.0, 0.5, 0.5]})


@pytest.mark.parametrize(
    ("car", "origin", "inside"),
    [
        (vehicle((0, 0, 1)), 0, True),
        (vehicle((0, 0, 1)), 3, True),  # the map's origin moves nothing
        (vehicle((1.6, 0.9, 1)), 0, True),
        (vehicle((1.6, -0.9, 1)), 0, False),
        (vehicle((0, 0, 2.5)), 0, False),
        (vehicle((2.5, 0, 1)), 0, False),
        (beside(0.9), 0, True),
        (beside(1.1), 0, False),
        ({"motion": {"kind": "waypoints", "waypoints": INTO_IT}}, 0, True),
    ],
)
def test_starts_inside_buildings_are_refused(car: dict[str, Any], origin: float, inside: bool) -> None:
    expected = pytest.raises(ScenarioError, match=r"vehicles.1.initial_pose: vehicle_2 starts inside obstacle 'house'")
    with expected if inside else nullcontext():
        builders.scenario([vehicle((9, 9, 0)), car], obstacles=[WALL], map={"origin": [origin, 0, 0]})


def landmarks(count: int) -> list[dict[str, Any]]:
    return [landmark(f"L{i}", (i, 2 * i, 1)) for i in range(count)]


@pytest.mark.parametrize(
    ("vehicles", "sections", "words"),
    [
        (None, {"landmarks": landmarks(0)}, "only 0 landmarks"),
        (None, {"landmarks": landmarks(1)}, "only 1 landmark:"),
        (None, {"landmarks": landmarks(2)}, "only 2 landmarks"),
        (None, {"map": {"origin": [60.0, 0, 0]}}, r"landmark 'L1' lies \d+ m from the map origin.*set map.origin"),
        ([vehicle(), vehicle((3, 3, 0), neighbours=["L1", "vehicle_1"])], {}, "vehicle_2 has fewer than three"),
        (
            [vehicle((x, 0, 0), body={"size": [2.0, 1.0, 1.0]}) for x in (0.0, 1.9, 5.0, 6.9, 8.8)],
            {},
            "^vehicles.1.initial_pose: vehicle_2 starts in the place of vehicle_1: their boxes overlap$",
        ),
        (
            [
                {"routes": [name], "motion": {"kind": "driven"}, "body": {"size": [0.6, 0.3, 0.3]}}
                for name in ("a", "b")
            ],
            {"routes": [{"name": name, "waypoints": [[x, 0], [9, 0]]} for name, x in (("a", 0.0), ("b", 0.1))]},
            "^vehicles.1.routes: vehicle_2 starts in the place of vehicle_1: their boxes overlap$",
        ),
    ],
)
def test_a_doubtful_scenario_warns_once(
    vehicles: list[dict[str, Any]] | None, sections: dict[str, Any], words: str
) -> None:
    with pytest.warns(ScenarioWarning, match=words) as caught:
        parse_scenario(builders.raw(vehicles, **sections), "here")
    assert len(caught) == 1


@pytest.mark.parametrize("origin", [0.0, 40.0])
def test_a_sound_scenario_does_not_warn(origin: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse_scenario(builders.raw(map={"origin": [origin, 0, 0]}), "here")


def test_the_number_of_landmarks_is_not_doubted_with_sensors_beside_the_camera() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raw = builders.raw([vehicle()], landmarks=[], sensors=[{"kind": "position"}], observer={"name": "robust"})
        parse_scenario(raw, "here")


def test_sensors_that_an_observer_ignores_are_named() -> None:
    with pytest.warns(ScenarioWarning, match="observer 'riccati' takes the camera's bearings alone and ignores uwb"):
        parse_scenario(builders.raw([vehicle()], sensors=[{"kind": "range", "name": "uwb"}]), "here")


def shifted(origin: tuple[float, float, float], **sections: Any) -> dict[str, Any]:
    """Return a noisy scene whose every position is given in the same file coordinates, whatever the map's origin."""
    estimate = {"position_offset": [0.4, -0.3, 0.2], "orientation_offset_wxyz": [0.98, 0.0, 0.0, 0.198997487]}
    absolute = {"position": [2.3, -1.2, 0.4], "yaw": 0.2}
    return builders.raw(
        [
            vehicle(initial_estimate=estimate, motion=builders.constant([0.3, 0, 0], [0, 0, 0.2])),
            vehicle(
                (2, -1, 0.5), initial_estimate=absolute, body={"size": [0.5, 0.3, 0.3]}, goal={"position": [2, 2, 0]}
            ),
        ],
        obstacles=[{"name": "B", "center": [1.5, 1.5, 1], "size": [0.5, 0.5, 2.0]}],
        topology={"mode": "sensed"},
        noise={"velocity": 0.05, "angular_velocity": 0.01, "bearing": {"scale": 0.002}},
        map={"origin": list(origin)},
        **sections,
    )


def test_the_origin_moves_the_map_and_nothing_else() -> None:
    """The truth, sight and bearings are the same scene; the map's coordinates are less the origin."""
    origin = (1.0, -2.0, 0.5)
    worlds = [start(parse_scenario(shifted(o), "t"), 3) for o in ((0.0, 0.0, 0.0), origin)]
    initial = [np.concatenate(errors(world, world.get_state()), axis=None) for world in worlds]
    assert_allclose(*initial, atol=1e-6)
    here, there = (run(world, 30) for world in worlds)
    for a, b in zip(here, there, strict=True):
        assert_allclose(b["position"], a["position"] - np.array(origin), atol=1e-12)
        np.testing.assert_array_equal(b["sight"], a["sight"])
        np.testing.assert_array_equal(b["ended"], a["ended"])
        assert_allclose(b["bearing"], a["bearing"], atol=1e-12)
        assert_allclose(b["increment_translation"], a["increment_translation"], atol=1e-14)


def test_an_accurate_estimate_does_not_feel_a_small_shift() -> None:
    """The observer is not invariant to the origin, but its equilibrium is: from the truth nothing moves."""
    for origin in ((0.0, 0.0, 0.0), (0.5, -0.5, 0.2), (20.0, 10.0, 0.0)):
        data = shifted(origin, observer={"k": 1.0})
        data["noise"]["enabled"] = False
        for v in data["vehicles"]:
            v["initial_estimate"] = {}
        world = start(parse_scenario(data, "t"))
        world.advance(60)
        position, angle = errors(world, world.get_state())
        assert position.max() < 1e-11
        assert angle.max() < 1e-9


def test_an_unknown_field_is_reported_without_the_names_of_all_fields() -> None:
    with pytest.raises(ScenarioError, match=r"unknown field 'a'; known: .*\.\.\. \(\d+ in all\)$") as caught:
        load_scenario("overtaking", {"observation.scales": {"a": 1.0}})
    assert len(str(caught.value)) < 400


def fleet_on_routes(n: int, entry: list[float] | None = None, apart: float = 0.0) -> dict[str, Any]:
    """Return vehicles that may start on the same two routes, which begin together; sizes differ by `apart` m."""
    spread = {"start_spread": 0.2, "lateral_spread": 0.1}
    ways = [{"name": f"r{i}", "waypoints": [[0.0, 0.0], [9.0, float(i)]], **spread} for i in range(2)]
    sizes = [[0.6 + apart * i, 0.3, 0.3] for i in range(n)]
    driven: dict[str, Any] = {"motion": {"kind": "driven"}, "routes": ["r0", "r1"], "entry": entry}
    return builders.raw([{**driven, "body": {"size": size}} for size in sizes], routes=ways)


@pytest.mark.parametrize("apart", [0.0, 0.001])
def test_many_vehicles_on_equal_routes_are_compared_up_to_the_first_overlap(
    monkeypatch: pytest.MonkeyPatch, apart: float
) -> None:
    compared, overlap = [0], routes.boxes_overlap

    def counted(a: routes.Boxes, b: routes.Boxes) -> Any:
        compared[0] += len(a.half)
        return overlap(a, b)

    monkeypatch.setattr(routes, "boxes_overlap", counted)
    with pytest.warns(ScenarioWarning, match=r"vehicle_2 starts in the place of vehicle_1: their boxes overlap$"):
        parse_scenario(fleet_on_routes(64, apart=apart), "here")
    assert compared[0] < 64 * 64
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse_scenario(fleet_on_routes(64, [1.0, 9.0], apart), "here")  # they wait for their entry


@pytest.mark.parametrize("most", ["MOST_CORNERS", "MOST_STARTS"])
def test_comparisons_of_starts_have_a_limit(monkeypatch: pytest.MonkeyPatch, most: str) -> None:
    monkeypatch.setattr(starts, most, 20)
    if most == "MOST_STARTS":
        with pytest.raises(ScenarioError, match=r"vehicles.1: routes and spreads up to this vehicle are over 20"):
            parse_scenario(fleet_on_routes(2, apart=0.1), "here")
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            parse_scenario(fleet_on_routes(2), "here")


def test_a_search_for_overlaps_ends_at_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "MOST_COMPARED", 50_000)
    count = 400
    points = np.zeros((count, 3))
    same = routes.Boxes(points, np.tile(np.eye(3), (count, 1, 1)), np.ones((count, 3)))
    blocks = [len(block) for block in routes.overlapping_pairs(same, routes.Boxes(*same))]
    assert 0 < sum(blocks) < count * count and blocks[0] <= routes.BLOCK + count


def test_routes_that_follow_one_another_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "MOST_FOLLOWERS", 5)
    raw = fleet_on_routes(1) | {"termination": {"after_arrival": "continue"}}
    raw["routes"].append({"name": "r2", "waypoints": [[9.0, 0.0], [0.0, 0.0]]})
    raw["vehicles"][0]["goal"] = {"radius": 1000.0}
    with pytest.raises(ScenarioError, match=r"routes: 9 pairs may follow one another within 1000 m, over 5"):
        parse_scenario(raw, "here")


def test_the_expanded_size_of_a_file_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MOST_BYTES", 1000)
    many = {**builders.vehicle(), "neighbours": ["L1"] * 100}
    with pytest.raises(ScenarioError, match=r"scenario: vehicles.0.count: 9 times its length is 0 MiB, over 0 MiB"):
        load_scenario(builders.raw([{**many, "count": 9}]))
    defaults = {"vehicle_defaults": {"neighbours": ["L1"] * 100}}
    with pytest.raises(ScenarioError, match=r"scenario: vehicle_defaults: 9 times its length is"):
        load_scenario(builders.raw([builders.vehicle((i, 0, 0)) for i in range(9)]) | defaults)


def test_groups_make_no_more_landmarks_than_a_scenario_may_have() -> None:
    lines = [{"start": [0, 0], "end": [1, 1]}]
    groups = [{"name": f"g{i}", "count": 1000, "height": [1, 2], "lines": lines} for i in range(60)]
    assert len(with_groups({"landmark_groups": groups, "landmarks": []})["landmarks"]) == 50_001


@pytest.mark.parametrize("explicit", [[], [1], [3], [0, 2, 4]])
def test_leaders_come_first_whether_neighbours_are_listed_or_not(explicit: list[int]) -> None:
    names = {i: ["L1", *(f"vehicle_{j + 1}" for j in range(i) if j % 2 == 0)] for i in explicit}
    cars = [builders.vehicle((3 * i, 0, 0), **({"neighbours": names[i]} if i in names else {})) for i in range(6)]
    made = builders.scenario(cars)
    sets = neighbour_sets(made)
    order = processing_order(made, sets)
    assert sorted(order) == [*range(6)]
    assert all(order.index(j - 4) < order.index(i) for i, own in enumerate(sets) for j in own if j >= 4)
