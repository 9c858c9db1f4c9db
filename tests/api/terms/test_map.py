"""The observation's groups of the map, the way and the vehicle itself: what they say against geometry in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.estimation import Sight
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.four_way import FOUR_WAY
from tests.oracles.geometry import in_field_of_view, is_occluded, point_in_camera

GROUPS = ["uncertainty", "sightings", "map", "route", "self"]


def scenario_with(**more: Any) -> Scenario:
    far = {"position_scale": 50.0, "map_scale": 50.0, "age_scale": 1000.0, "include": GROUPS}
    return load_scenario(FOUR_WAY, {f"observation.{key}": value for key, value in {**far, **more}.items()})


def driven(scenario: Scenario, steps: int = 12, worlds: int = 4) -> Engine:
    engine = Engine(scenario, worlds, "float64")
    engine.reset(list(range(worlds)))
    rng = np.random.default_rng(0)
    for _ in range(steps):
        engine.step(rng.uniform([0.2, -1.0], 1.0, (worlds, len(scenario.vehicles), 2)))
    return engine


def seen(engine: Engine, scenario: Scenario, name: str) -> np.ndarray:
    """Return a field's values, (W, N, *shape)."""
    return observation_layout(scenario)[name].values(engine.view("observation").astype(float))


def estimates(engine: Engine) -> tuple[np.ndarray, np.ndarray]:
    """Return (R, position in the map) as estimated, (W, N, 3, 3) and (W, N, 3)."""
    R = engine.view("estimate_rotation")
    return R, np.einsum("wnij,wnj->wni", R, engine.view("estimate_position"))


Box = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Center, rotation and half sizes."""


def heard(engine: Engine, scenario: Scenario, w: int, i: int) -> list[Box]:
    """Return the boxes of the vehicles from whom vehicle i has a fresh message, where the messages put them."""
    sent, now = engine.view("inbox_tick")[w, i], engine.view("tick")[w]
    boxes = []
    for sender, vehicle in enumerate(scenario.vehicles):
        if sender != i and sent[sender] >= 0 and now - sent[sender] <= scenario.v2x.staleness * scenario.rates.camera:
            R, p = (engine.view(f"inbox_{name}")[w, i, sender] for name in ("rotation", "position"))
            boxes.append((p + R @ np.array(vehicle.body.center), R, np.array(vehicle.body.size) / 2))
    return boxes


def predicted(scenario: Scenario, point: np.ndarray, R: np.ndarray, p: np.ndarray, vehicles: list[Box]) -> bool:
    """Tell by the oracle whether a point is to be seen from a pose, past buildings and vehicles."""
    camera = scenario.camera
    ray = point_in_camera(point, R, p, camera.position)
    intrinsics = (*camera.focal_length, *camera.principal_point, *camera.image_size)
    if camera.range is not None and np.linalg.norm(ray) > camera.range:
        return False
    if not in_field_of_view(ray, *intrinsics):
        return False
    origin = p + R @ np.array(camera.position)
    boxes = [(np.array(o.center), np.eye(3), np.array(o.size) / 2) for o in scenario.obstacles] + vehicles
    return not any(is_occluded(origin, point, center, turn, half) for center, turn, half in boxes)


def test_the_map_is_that_of_the_nearest_landmarks_by_ones_own_estimate() -> None:
    scenario = scenario_with(map_size=14)
    engine = driven(scenario)
    places = np.array([landmark.position for landmark in scenario.landmarks])  # 12
    R, p = estimates(engine)
    position, mask = seen(engine, scenario, "map_position"), seen(engine, scenario, "map_mask")
    in_view, age = seen(engine, scenario, "map_in_view"), seen(engine, scenario, "map_age")
    now = engine.view("tick")[0]
    found = []
    for w, i in np.ndindex(*p.shape[:2]):
        order = np.argsort(np.linalg.norm((places - p[w, i])[:, :2], axis=1))
        np.testing.assert_allclose(position[w, i, :12], (places[order] - p[w, i]) @ R[w, i], atol=1e-4)
        assert mask[w, i].tolist() == [1] * 12 + [0] * 2
        assert not position[w, i, 12:].any() and not in_view[w, i, 12:].any() and (age[w, i, 12:] == 1000.0).all()
        boxes = heard(engine, scenario, w, i)
        expected = [predicted(scenario, places[n], R[w, i], p[w, i], boxes) for n in order]
        assert in_view[w, i, :12].tolist() == expected
        found += expected
        then = engine.view("bearing_tick")[w, i, order]
        np.testing.assert_allclose(age[w, i, :12], np.where(then < 0, 1000.0, (now - then) / 60.0), atol=1e-3)
    assert 0.2 < np.mean(found) < 0.8


def test_a_wrong_map_is_observed_as_it_is() -> None:
    error = {"chance": 1.0, "offset": 2.0, "direction": [1.0, 0.0, 0.0]}
    more = {"include": ["map"], "map_size": 3, "map_scale": 50.0}
    overrides = {f"observation.{key}": value for key, value in more.items()}
    scenario = load_scenario("busy_intersection", {**overrides, "vehicles.vehicle_2.faults": {"map_error": error}})
    engine = driven(scenario, 2)
    R, p = estimates(engine)
    places = np.array([landmark.position for landmark in scenario.landmarks])
    for i in range(5):
        own = places + np.array([2.0 * (i == 1), 0.0, 0.0])
        order = np.argsort(np.linalg.norm((own - p[0, i])[:, :2], axis=1))
        expected = (own[order] - p[0, i]) @ R[0, i]
        np.testing.assert_allclose(seen(engine, scenario, "map_position")[0, i], expected, atol=1e-4)


def test_landmarks_expected_in_view_mostly_are() -> None:
    scenario = scenario_with(map_size=12)
    engine = driven(scenario, steps=30)
    _, p = estimates(engine)
    places = np.array([landmark.position for landmark in scenario.landmarks])
    order = np.argsort(np.linalg.norm((places - p[..., None, :])[..., :2], axis=-1), axis=-1)
    visible = np.take_along_axis(engine.view("sight")[..., :12] == Sight.VISIBLE, order, axis=-1)
    assert (visible == (seen(engine, scenario, "map_in_view") == 1.0)).mean() > 0.9  # the others: cars, misses, errors


def test_received_vehicles_occlude_landmarks() -> None:
    """By the oracle, and often: the truck."""
    more = {"include": ["map"], "map_size": 14, "map_scale": 50.0}
    scenario = load_scenario("behind_truck", {f"observation.{key}": value for key, value in more.items()})
    engine = driven(scenario, steps=0, worlds=8)
    for _ in range(90):
        engine.step(np.tile([1.0, 0.0], (8, 2, 1)))
    R, p = estimates(engine)
    marks = np.array([engine.view("position")[:, k] for k in range(14)]).swapaxes(0, 1)
    found = []
    for w, place in enumerate(marks):
        order = np.argsort(np.linalg.norm((place - p[w, 1])[:, :2], axis=1))
        boxes = heard(engine, scenario, w, 1)
        past, through = ([predicted(scenario, place[n], R[w, 1], p[w, 1], b) for n in order] for b in (boxes, []))
        assert seen(engine, scenario, "map_in_view")[w, 1].tolist() == past
        found.append(sum(through) - sum(past))
    assert sum(found) >= 4


def test_every_landmark_is_expected_where_the_topology_is_fixed() -> None:
    name = "busy_intersection"
    scenario = load_scenario(name, {"observation.include": ["map"], "observation.map_size": 2})
    engine = driven(scenario, 1)
    assert seen(engine, scenario, "map_in_view").all()


def test_the_route_is_relative_to_the_own_estimate() -> None:
    scenario = scenario_with(route_step=1.0)
    engine = driven(scenario)
    R, p = estimates(engine)
    for i, vehicle in enumerate(scenario.vehicles):
        assert vehicle.goal is not None
        start, goal = np.array(vehicle.initial_pose.position), np.array(vehicle.goal.position)
        length = np.linalg.norm((goal - start)[:2])
        along = (goal - start)[:2] / length
        left = np.array([-along[1], along[0]])
        offset = (p[:, i] - start)[:, :2]
        way = offset @ along
        ahead = np.add([[1.0], [2.0], [4.0], [8.0]], way)
        points = start[:2] + ahead[..., None] * along - p[:, i, :2]
        heading = np.arctan2(R[:, i, 1, 0], R[:, i, 0, 0])
        directions = np.angle(np.exp(1j * (np.arctan2(points[..., 1], points[..., 0]) - heading)))
        turn = np.angle(np.exp(1j * (heading - np.arctan2(along[1], along[0]))))
        for name, expected in (
            ("route_offset", offset @ left),
            ("route_heading", turn),
            ("route_left", length - way),
        ):
            np.testing.assert_allclose(seen(engine, scenario, name)[:, i, 0], np.clip(expected, -1, 50), atol=1e-4)
        np.testing.assert_allclose(seen(engine, scenario, "route_ahead")[:, i], np.clip(directions.T, -1, 1), atol=1e-4)


def test_own_state_and_sightings_are_observed() -> None:
    scenario = scenario_with(map_size=1)
    engine = driven(scenario, steps=40)
    np.testing.assert_allclose(seen(engine, scenario, "steering")[..., 0], engine.view("turn"), atol=1e-5)
    np.testing.assert_allclose(seen(engine, scenario, "last_action"), engine.view("action"), atol=1e-6)
    np.testing.assert_allclose(seen(engine, scenario, "time_left"), 1.0 - 4.0 / 40.0, atol=1e-6)
    L = len(scenario.landmarks)
    body = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera to body
    for i in range(4):
        others = [L + j for j in range(4) if j != i]
        bearing = engine.view("bearing")[:, i, others] @ body.T
        np.testing.assert_allclose(seen(engine, scenario, "sighting")[:, i], bearing, atol=1e-6)
        visible = engine.view("sight")[:, i, others] == Sight.VISIBLE
        assert np.array_equal(seen(engine, scenario, "sighting_mask")[:, i] == 1.0, visible)
    assert seen(engine, scenario, "sighting_mask").any()


def test_deviations_are_those_of_the_covariance_that_the_observer_states() -> None:
    scenario = scenario_with(map_size=1)
    engine = driven(scenario)
    P, p_hat = engine.view("covariance"), engine.view("estimate_position")
    for w, i in np.ndindex(*p_hat.shape[:2]):
        x, y, z = p_hat[w, i]
        J = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
        cov = J @ P[w, i] @ J.T
        for name, expected in (
            ("position_std", np.sqrt(np.trace(cov))),
            ("axis_std", np.sqrt(np.diag(cov))),
            ("heading_std", np.sqrt(P[w, i, 2, 2])),
        ):
            np.testing.assert_allclose(seen(engine, scenario, name)[w, i], np.log10(expected), atol=1e-5)


def nearness(ego: Any, landmark: Any) -> Any:
    """Closeness of a landmark in the camera's view, 0 if out of view."""
    if landmark.in_view and landmark.exists:
        return 1.0 / (1.0 + landmark.distance)
    return 0.0


def test_registered_fields_per_landmark() -> None:
    coopenv.register_observation("nearness", nearness, per="landmark", low=0)
    envs = coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides={"observation.include": ["map", "nearness"]})
    envs.reset(seed=0)
    observations = envs.step(np.zeros(envs.action_space.shape))[0]
    layout = envs.observation_layout
    assert layout["nearness"].shape == (8,)
    distance = np.linalg.norm(layout["map_position"].values(observations)[..., :2], axis=-1)
    near = layout["nearness"].values(observations)
    assert near.any()
    np.testing.assert_allclose(near[near > 0], 1.0 / (1.0 + distance[near > 0]), rtol=0.02)


def test_a_planar_observation_leaves_out_what_a_car_cannot_change() -> None:
    whole, planar = ({"observation.include": ["estimate", "odometry", "map", "goal"]} for _ in range(2))
    planar["observation.planar"] = True
    a, b = (coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides=o) for o in (whole, planar))
    one, two = a.reset(seed=0)[0], b.reset(seed=0)[0]
    for name, kept in {
        "estimate_position": [0, 1],
        "estimate_forward": [0, 1],
        "velocity": [0],
        "angular_velocity": [2],
        "map_position": [0, 1],
        "goal": [0, 1],
        "odometry_age": [0],
    }.items():
        np.testing.assert_array_equal(
            b.observation_layout[name].values(two), a.observation_layout[name].values(one)[..., kept]
        )
    assert "estimate_left" not in b.observation_layout


def test_scales_and_centers_of_single_fields() -> None:
    names = {"observation.include": ["position_std", "odometry_age", "log_determinant", "goal"]}
    changed = {**names, "observation.scales.log_determinant": 20.0, "observation.centers.log_determinant": -4.0}
    a, b = (coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides=o) for o in (names, changed))
    one, two = a.reset(seed=0)[0], b.reset(seed=0)[0]
    assert list(a.observation_layout) == ["goal", "position_std", "odometry_age", "log_determinant"]
    value = a.observation_layout["log_determinant"].values(one)
    np.testing.assert_allclose(two[:, b.observation_layout["log_determinant"].slice], (value + 4.0) / 20.0, rtol=1e-5)
    np.testing.assert_allclose(b.observation_layout["log_determinant"].values(two), value, rtol=1e-5)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("observation.scales.goall", 1.0, "observation.scales: unknown field 'goall' .did you mean 'goal'"),
        ("observation.centers.progress", 1.0, "observation.centers: unknown field 'progress'"),
        ("observation.scales.goal", 0.0, "observation.scales.goal: "),
        ("observation.map_size", 0, "observation.map_size: "),
        ("observation.include", ["mapp"], "unknown group or field 'mapp' .did you mean 'map'"),
        ("observation.exclude", ["maap"], r"exclude: unknown group or field 'maap' \(did you mean 'map'\?\)"),
        ("reward.uncertainty_cap", 0.0, "reward.uncertainty_cap: "),
        ("reward.uncertainty_threshold", -0.1, "reward.uncertainty_threshold: "),
    ],
)
def test_errors_are_one_line(key: str, value: Any, message: str) -> None:
    with pytest.raises(coopenv.ScenarioError, match=message):
        load_scenario(FOUR_WAY, {key: value})


def test_excluded_fields_alone_are_left_out() -> None:
    layout = observation_layout(load_scenario("open_square"))
    changes = {"observation.exclude": ["map", "goal"]}
    left = observation_layout(load_scenario("open_square", changes))
    assert list(left) == [name for name, field in layout.items() if field.group not in ("map", "goal")]
    assert layout.size - left.size == sum(f.stop - f.start for f in layout.values() if f.group in ("map", "goal"))
    observation, _ = coopenv.parallel_env("open_square", overrides=changes).reset(seed=1)
    whole, _ = coopenv.parallel_env("open_square").reset(seed=1)
    for name, field in left.items():
        np.testing.assert_array_equal(field.values(observation["vehicle_2"]), layout[name].values(whole["vehicle_2"]))


def test_an_observation_of_nothing_is_refused() -> None:
    with pytest.raises(coopenv.CoopenvError, match=r"observation\.exclude: nothing is left"):
        observation_layout(
            load_scenario("open_square", {"observation.include": ["map"], "observation.exclude": ["map"]})
        )


WORLDS, FAR = 8, 4.0
TIMES = np.linspace(0.0, 6.0, 3001)


def test_clearance_is_the_least_distance_on_the_two_ways_that_are_expected() -> None:
    """Closest approach of a received vehicle, against positions at many instants."""
    wide = {"position_scale": 50.0, "scales": {"route_ahead": 3.2}, "include": ["messages", "clearance", "route"]}
    scenario = load_scenario("urban_crossing", {f"observation.{key}": value for key, value in wide.items()})
    engine = Engine(scenario, WORLDS, "float64")
    engine.reset(list(range(WORLDS)))
    rng = np.random.default_rng(0)
    for _ in range(60):  # until they meet
        engine.step(rng.uniform([0.6, -0.1], [1.0, 0.1], (WORLDS, len(scenario.vehicles), 2)))
    layout, speed = observation_layout(scenario), scenario.dynamics.max_speed
    observation = engine.view("observation").astype(float)
    read = {name: layout[name].values(observation) for name in ("message_clearance", "route_ahead", "message_mask")}
    place, forward = (layout[f"message_{name}"].values(observation) for name in ("position", "forward"))
    assert scenario.observation.route_step == 0.5
    reach = scenario.observation.route_step * 2.0 ** np.arange(4)
    heard = read["message_mask"].reshape(place.shape[:-1]) > 0.5
    for row in np.ndindex(heard.shape):
        if not heard[row]:
            np.testing.assert_allclose(read["message_clearance"][row], FAR, atol=1e-6)
            continue
        angle = read["route_ahead"][row[:-1]]
        way = np.concatenate([np.zeros((1, 2)), reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)])
        way = np.concatenate([way, [4.0 * way[-1] - 3.0 * way[-2]]])  # goes on as its last leg, 2 m from 4 m
        own = np.stack([np.interp(speed * TIMES, [0.0, *reach, 10.0], way[:, i]) for i in range(2)], axis=-1)
        other = place[row][:2] + speed * TIMES[:, None] * forward[row][:2]
        expected = [np.linalg.norm(other - own, axis=-1).min(), np.linalg.norm(other, axis=-1).min()]
        np.testing.assert_allclose(read["message_clearance"][row], np.minimum(expected, FAR), atol=4e-3)
    assert (read["message_clearance"] < 1.0).any() and heard.any()


def test_the_right_of_way_belongs_to_earlier_senders_and_traffic() -> None:
    heard = {"observation.include": ["messages", "precedence"], "v2x.loss": 0.0}
    for name, expected in (("open_square", np.tri(4, 3, -1)), ("behind_truck", [[0.0], [1.0]])):
        engine = Engine(load_scenario(name, heard), 1)
        engine.reset([0])
        layout = observation_layout(engine.backend.scenario)
        assert not layout["message_precedence"].values(engine.view("observation")).any(), "nothing heard yet"
        engine.step(np.zeros(engine.view("actions").shape))
        np.testing.assert_array_equal(layout["message_precedence"].values(engine.view("observation"))[0], expected)


def test_messages_show_which_vehicles_measure_the_receiver() -> None:
    radio = {"v2x.delay": 3, "v2x.period": 2, "v2x.loss": 0.3, "v2x.links": "all", "v2x.staleness": 0.5}
    options = {"observation.include": ["seen"], "observation.age_scale": 1000.0}
    scenario = load_scenario("scout_platoon", {**radio, **options})
    engine, first = Engine(scenario, 3, "float64"), len(scenario.landmarks)
    engine.reset([5, 6, 7])
    frames = [engine.view("sight")[:, :, first:] == Sight.VISIBLE]
    masks = 0
    for now in range(1, 90):
        engine.step(np.tile([0.5, 0.1], (3, 3, 1)), ticks=1)
        frames.append(engine.view("sight")[:, :, first:] == Sight.VISIBLE)
        mask, age = (seen(engine, scenario, name) for name in ("seen_mask", "seen_age"))
        for w, i, n in np.ndindex(3, 3, 2):
            sender = n + (n >= i)
            sent = int(engine.view("inbox_tick")[w, i, sender])
            measured = [k for k in range(sent + 1) if frames[k][w, sender, i]]
            fresh = sent >= 0 and now - sent <= 15
            assert mask[w, i, n] == (fresh and sent in measured)
            assert age[w, i, n] == pytest.approx((now - measured[-1]) / 30 if measured else 1000.0, abs=1e-3)
            masks += int(mask[w, i, n])
    assert 100 < masks < 900


def test_reports_state_how_well_the_sender_knows_its_position() -> None:
    radio = {"v2x.delay": 3, "v2x.period": 2, "v2x.loss": 0.3, "v2x.links": "all", "v2x.staleness": 0.2}
    scenario = load_scenario("scout_platoon", {**radio, "observation.include": ["stated"]})
    engine = Engine(scenario, 3, "float64")
    engine.reset([5, 6, 7])
    stated, unknown = [engine.view("position_std").copy()], 0
    for now in range(1, 60):
        engine.step(np.tile([0.5, 0.1], (3, 3, 1)), ticks=1)
        stated.append(engine.view("position_std").copy())
        values = seen(engine, scenario, "message_std")
        for w, i, n in np.ndindex(3, 3, 2):
            sender = n + (n >= i)
            sent = int(engine.view("inbox_tick")[w, i, sender])
            at_hand = sent > 0 and now - sent <= 6  # the first message, of the start, states none
            expected = np.log10(stated[sent][w, sender]) if at_hand else 0.25  # the end of its range
            assert values[w, i, n] == pytest.approx(expected, abs=1e-5)
            unknown += not at_hand
    assert 10 < unknown < 900
    silent = Engine(load_scenario("scout_platoon", {"observation.include": ["stated"], "observer.name": "riccati"}), 1)
    silent.reset([5])
    silent.step(np.zeros((1, 3, 2)))
    assert (silent.view("observation") == 1.0).all(), "a pose alone states nothing"


def test_what_was_never_measured_is_not_found() -> None:
    """An age reads the same for what was measured longer ago than its scale, and for what was never measured."""
    fields = ["bearings", "sightings", "map", "seen", "found", "role"]
    scenario = load_scenario("scout_platoon", {"observation.include": fields, "observation.age_scale": 0.5})
    engine = Engine(scenario, 3)
    engine.reset([5, 6, 7])
    ever = np.zeros_like(seen(engine, scenario, "bearing_found"), dtype=bool)
    for _ in range(60):
        ever |= engine.view("sight") == Sight.VISIBLE
        found = {name: seen(engine, scenario, f"{name}_found") for name in ("bearing", "sighting", "map", "seen")}
        np.testing.assert_array_equal(found["bearing"], ever)
        for name, flags in found.items():
            assert flags[seen(engine, scenario, f"{name}_age") < 0.499].all(), name
        engine.step(np.tile([0.5, 0.2], (3, 3, 1)), ticks=3)
    old = seen(engine, scenario, "bearing_age") > 0.499
    assert found["bearing"][old].any() and not found["bearing"].all() and found["seen"].any() and found["map"].any()
    others = [[2, 3], [1, 3], [1, 2]]
    places = np.array(others) + len(scenario.landmarks) - 1
    cars = np.take_along_axis(found["bearing"], np.broadcast_to(places, (3, 3, 2)), axis=2)
    np.testing.assert_array_equal(found["sighting"], cars)
    np.testing.assert_array_equal(seen(engine, scenario, "role"), np.broadcast_to(np.eye(3), (3, 3, 3)))
