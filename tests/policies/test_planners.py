"""Drivers that look around, where it pays; and the small parts that they are made of."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from coopenv import parallel_env
from coopenv.api.terms.layout import observation_layout
from coopenv.policies import act, load_agent
from coopenv.policies.look_ahead import LookAhead
from coopenv.policies.prediction import FieldOfView, Occluder, Occluders, PlanarCovariance, unhidden
from coopenv.policies.right_of_way import discs_along, nearest
from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.four_way import FOUR_WAY
from tests.oracles.geometry import is_occluded

GROUPS = ("estimate", "odometry", "messages", "goal", "quality", "uncertainty", "map", "route", "self")


def square(**changes: Any) -> Scenario:
    """Return the four-way crossing without its buildings; `changes` replace sections of it."""
    usual = {"obstacles": [], "observer.name": "robust", "observation.include": GROUPS, "camera.range": 6.0}
    return load_scenario(FOUR_WAY, {**usual, **changes})


SCENARIO = square()


def observation(scenario: Scenario = SCENARIO, **fields: object) -> np.ndarray:
    """Return one row that holds these values, in their units."""
    layout = observation_layout(scenario)
    row = np.zeros((1, layout.size), dtype=np.float32)
    for name, value in fields.items():
        field = layout[name]
        values = np.broadcast_to(np.asarray(value, float), field.shape)
        row[0, field.slice] = ((values - field.center) / field.scale).ravel()
    return row


def test_peek_turns_to_landmarks_and_back_into_its_lane() -> None:
    peek: Any = load_agent("peek", SCENARIO)
    beside = [[2.5, 3.0, 0.0]] * 3 + [[50.0, 0.0, 0.0]] * 5
    lost = {"position_std": 0.0, "map_position": beside, "map_mask": [1, 1, 1, 0, 0, 0, 0, 0]}
    steering = peek.drive(observation(**lost))[1]
    assert steering[0] > 0.1  # to the left
    certain = peek.drive(observation(**{**lost, "position_std": -2.0}))[1]
    assert certain[0] == pytest.approx(0.0, abs=1e-6)
    assert peek.drive(observation(**{**lost, "route_offset": 0.9}))[1][0] <= 0.0  # no farther to the left


class Impatient(type(load_agent("stop_when_lost", SCENARIO))):  # type: ignore[misc]
    threshold, patience = 0.1, 0.3  # m, s


def test_stopping_has_an_end() -> None:
    driver = Impatient(SCENARIO)
    lost, sure = observation(position_std=0.0), observation(position_std=-2.0)
    speeds = [driver.drive(row)[0][0] for row in (lost, lost, lost, lost, lost, sure, lost)]
    assert speeds == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    driver.reset(np.array([True]))
    assert driver.drive(lost)[0][0] == 0.0


def other(x: float, y: float, angle: float) -> dict[str, object]:
    """Return what is heard of one other vehicle, at a place (m) and heading (rad) in the own frame."""
    place, forward = np.zeros((3, 3)), np.zeros((3, 3))
    place[0], forward[0] = (x, y, 0.0), (np.cos(angle), np.sin(angle), 0.0)
    return {"message_position": place, "message_forward": forward, "message_mask": [1, 0, 0]}


@pytest.mark.parametrize(
    ("x", "speed"), [(2.0, 1.0), (-2.9, 1.0), (-4.5, 0.5), (-6.0, 0.5), (-40.0, 0.5)], ids=lambda value: f"{value:g}"
)
def test_contact_is_kept_by_waiting_for_the_next_car_behind(x: float, speed: float) -> None:
    """Cameras reach 6 m: full speed up to half of it, the slowest pace near its end."""
    driver: Any = load_agent("keep_contact", SCENARIO)
    assert driver.drive(observation(**other(x, 0.3, 0.0)))[0][0] == pytest.approx(speed * driver.cruise, rel=0.02)


def test_contact_has_the_reach_of_sensors_of_vehicles() -> None:
    tags = {"kind": "relative_pose", "towards": ["landmarks"], "range": 1.0}
    ranges = {"kind": "range", "towards": ["vehicles"], "range": 4.0}
    assert [load_agent("keep_contact", square(sensors=sensors)).reach for sensors in ([tags], [tags, ranges])] == [
        6.0,
        4.0,
    ]


@pytest.mark.parametrize(
    ("x", "y", "angle", "speed"),
    [
        (3.0, -3.0, np.pi / 2, 0.0),  # would meet
        (3.0, -1.0, np.pi / 2, 1.0),  # will have passed
        (3.0, 3.0, np.pi / 2, 1.0),  # drives away
        (-2.0, 0.0, 0.0, 1.0),  # behind, as fast
        (0.5, 0.0, np.pi, 0.0),  # head-on: waiting is no worse
    ],
)
def test_giving_way(x: float, y: float, angle: float, speed: float) -> None:
    assert RouteFollower(SCENARIO).speed(observation(**other(x, y, angle)))[0] == speed


MUTUAL = square(**{"v2x.links": "all"})


def rows(present: int, **fields: object) -> np.ndarray:
    """Return the rows of the four vehicles of a world; one of them observes these values."""
    batch = np.repeat(observation(MUTUAL), 4, axis=0)
    batch[present] = observation(MUTUAL, **fields)[0]
    return batch


def test_the_right_of_way_is_that_of_the_order_where_all_receive_each_other() -> None:
    """Slot 1 of the messages is vehicle_3 for the first two, and vehicle_2 for the others."""
    crossing: dict[str, Any] = {name: np.roll(value, 1, axis=0) for name, value in other(3.0, -3.0, np.pi / 2).items()}
    speeds = [RouteFollower(MUTUAL).speed(rows(vehicle, **crossing))[vehicle] for vehicle in range(4)]
    assert speeds == [1.0, 1.0, 0.0, 0.0]
    alone = [RouteFollower(SCENARIO).speed(rows(vehicle, **crossing))[vehicle] for vehicle in range(4)]
    assert alone == [0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(("x", "speed"), [(0.9, 0.0), (2.5, 1.0)])
def test_a_follower_waits_for_vehicles_in_its_way(x: float, speed: float) -> None:
    assert RouteFollower(MUTUAL).speed(rows(0, **other(x, 0.0, np.pi / 2)))[0] == speed


def test_traffic_that_does_not_react_has_the_right_of_way() -> None:
    driven = RouteFollower(MUTUAL).goes_first
    assert driven.tolist() == [[True, True, True], [False, True, True], [False, False, True], [False, False, False]]
    assert not RouteFollower(SCENARIO).goes_first.any()
    assert not RouteFollower(load_scenario("behind_truck", {"v2x.links": "all"})).goes_first.any()


def test_rows_keep_their_vehicle_when_others_have_ended() -> None:
    driver, row = RouteFollower(MUTUAL), rows(3, **other(3.0, -3.0, np.pi / 2))[3]
    assert act(driver, {"vehicle_1": row})["vehicle_1"][0] > 0.9 and act(driver, {"vehicle_4": row})["vehicle_4"][0] < 0
    assert set(act(lambda rows: rows[:, :2], {"other": row})) == {"other"}


@pytest.mark.parametrize("kind", [RouteFollower, LookAhead])
def test_a_sender_that_leaps_counts_where_it_would_be_too(kind: type[RouteFollower]) -> None:
    """It is about to cross, and reports a moment later to be four metres farther, where it has passed."""
    driver = kind(SCENARIO)
    driver.foresight = 6.0
    meeting, passed = (observation(**other(3.0, y, np.pi / 2)) for y in (-3.0, 1.0))
    assert [driver(row)[0, 0] for row in (meeting, passed, passed)] == [-1.0, -1.0, -1.0]
    assert driver(meeting)[0, 0] == driver(passed)[0, 0] == -1.0
    driver.reset(np.array([True]))
    assert driver(passed)[0, 0] == 1.0


def test_neither_driving_nor_small_corrections_are_leaps() -> None:
    driver, rng = RouteFollower(SCENARIO), np.random.default_rng(0)
    for k in range(40):
        x, y = np.array([3.0 - 0.05 * k, 0.1 * k - 3.0]) + rng.uniform(-0.3, 0.3, 2)
        assert not driver.leaps(observation(**other(x, y, 1.6), velocity=[0.5, 0.0, 0.0])).any()


def test_leaps_of_the_farthest_senders_are_seen_in_the_open_square() -> None:
    """What lies beyond the scale of its entry is clipped there, and shows no leap."""
    env = parallel_env("open_square")
    observations, _ = env.reset(seed=0)
    for _ in range(5):  # until messages arrive
        observations, *_ = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    rows, layout = np.stack(list(observations.values())), observation_layout(env.scenario)
    there = layout["message_mask"].values(rows) > 0.5
    place = layout["message_position"]
    entries = np.abs(rows[:, place.start : place.stop]).reshape(len(rows), -1, 2)[there]
    assert 0.5 < entries.max() < 1.0
    driver = RouteFollower(env.scenario)
    driver(rows)
    rows[:, place.start : place.stop] *= 0.6
    assert np.array_equal(driver.leaps(rows).reshape(*there.shape, 2).any(axis=-1), there)


@pytest.mark.parametrize(("away", "speed"), [(2.0, 0.0), (4.8, 1.0)])
def test_planners_give_way_to_near_meetings_alone(away: float, speed: float) -> None:
    """Cars that turn to landmarks and back would otherwise wait for meetings that never come."""
    crossing = observation(**other(away, -away, np.pi / 2))  # would meet after so many seconds
    assert RouteFollower(SCENARIO).speed(crossing)[0] == 0.0
    assert LookAhead(SCENARIO).speed(crossing)[0] == speed


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_plans_that_lead_towards_others_cost_more(side: float) -> None:
    """Towards the side where somebody comes, not away from it."""
    planner = LookAhead(SCENARIO)
    with_other, alone = (
        planner.costs(seen, np.zeros(1, int), [])[0] for seen in (observation(**other(4.0, side, np.pi)), observation())
    )
    coming = with_other - alone
    turned = side * planner._first
    assert coming[(turned > 0.3) & (side * planner._second >= 0.0)].min() > 0.5
    np.testing.assert_allclose(coming[(turned < -0.3) & (side * planner._second <= 0.0)], 0.0, atol=1e-6)


@pytest.mark.parametrize(("std", "speed"), [(0.03, 1.0), (0.3, 0.0)])
def test_a_certain_vehicle_passes_closer(std: float, speed: float) -> None:
    crossing = other(3.0, -(3.0 - 0.83 * np.sqrt(2.0)), np.pi / 2)  # passes 0.83 m away
    assert RouteFollower(SCENARIO).speed(observation(position_std=np.log10(std), **crossing))[0] == speed


def test_the_team_planner_keeps_its_whole_deviation_away() -> None:
    lost = observation(position_std=np.log10(0.6))
    team = type(load_agent("team_look_ahead", SCENARIO))
    kept = [driver(SCENARIO).distance_to_keep(lost)[0] for driver in (RouteFollower, LookAhead, team)]
    assert kept == pytest.approx([0.9, 1.0, 0.85 + 0.6])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_no_plan_leads_farther_from_a_route_than_is_observed(side: float) -> None:
    """The offset in the observation is clipped at its scale: the true one may be larger."""
    planner, scale = LookAhead(SCENARIO), observation_layout(SCENARIO)["route_offset"].scale
    near, at_the_end = (
        planner.costs(observation(route_offset=share * side * scale), np.zeros(1, int), [])[0] for share in (0.95, 1.0)
    )
    assert np.isfinite(near).all()
    np.testing.assert_array_equal(np.isinf(at_the_end), planner._first * side > 0.0)


def test_the_nearest_approach_is_that_of_fine_steps() -> None:
    rng = np.random.default_rng(2)
    path = np.cumsum(np.concatenate([np.zeros((6, 1, 2)), rng.normal(size=(6, 3, 2))], axis=1), axis=1)
    times, place, velocity = np.array([0.0, 0.5, 1.2, 2.0]), rng.normal(size=(6, 2, 2)), rng.normal(size=(6, 2, 2))
    mask = np.array([[True, True], [True, False], [False, False], [True, True], [False, True], [True, True]])
    t = np.linspace(0.0, 5.0, 20001)
    for row in range(6):
        last = (path[row, 3] - path[row, 2]) / 0.8
        own = np.stack([np.interp(t, times, path[row, :, k]) for k in (0, 1)], axis=-1)
        own += np.maximum(t - 2.0, 0.0)[:, None] * last
        apart = np.linalg.norm(place[row][:, None] + velocity[row][:, None] * t[:, None] - own, axis=-1).min(axis=1)
        expected = min(apart[mask[row]], default=np.inf)
        found = nearest(path, times, place, velocity, mask, 5.0)[row]
        assert found == pytest.approx(expected, abs=1e-3)


def test_the_nearest_approach_to_a_car_on_a_circle_is_that_of_fine_steps() -> None:
    """The own way is straight, the other's circle has a radius of 5 m; chords of 0.1 s are within 1 mm of it."""
    times, speed, radius = np.linspace(0.0, 4.0, 41), 2.0, 5.0
    path = np.stack([1.5 * times, 0.0 * times], axis=-1)[None]
    for side in (1.0, -1.0):
        place, velocity = np.array([[[3.0, -4.0 * side]]]), np.array([[[0.0, speed * side]]])
        found = nearest(path, times, place, velocity, np.ones((1, 1), bool), 4.0, np.array([[side / radius]]))
        t = np.linspace(0.0, 4.0, 4001)
        angle = speed * t / radius
        other = place[0, 0] + radius * np.stack([np.cos(angle) - 1.0, side * np.sin(angle)], axis=-1)
        apart = np.linalg.norm(other - np.stack([1.5 * t, 0.0 * t], axis=-1), axis=-1)
        assert found[0] == pytest.approx(apart.min(), abs=2e-3)
        straight = nearest(path, times, place, velocity, np.ones((1, 1), bool), 4.0)
        assert abs(straight[0] - apart.min()) > 0.1


@pytest.mark.parametrize("y", [0.1, -0.1])
def test_a_planner_drives_around_a_car_that_gives_way_and_blocks_its_way(y: float) -> None:
    """One that only follows its route waits; one that has to give way waits as well, and does not come closer."""
    row = rows(0, **other(1.3, y, np.pi), map_mask=0)
    speed, steering = (values[0] for values in LookAhead(MUTUAL).drive(row))
    assert speed > 0.0 and abs(steering) > 0.2
    assert RouteFollower(MUTUAL).speed(row)[0] == 0.0
    assert RouteFollower(MUTUAL).speed(rows(3, **other(1.3, y, np.pi)))[3] == 0.0


def test_the_center_of_a_body_counts() -> None:
    """The car's reference point is its rear axle: two that meet head-on touch long before these are near."""
    driver = RouteFollower(MUTUAL)
    assert driver.body_center == pytest.approx(MUTUAL.vehicles[0].body.center[0]) and driver.body_center > 0.1
    way, touching = driver.route_points(rows(0))[0], 1.0 + 2.0 * driver.body_center + driver.blocking  # m, after 1 s
    for more, clear in ((-0.05, False), (0.05, True)):
        assert driver.clear(rows(0, **other(touching + more, 0.0, np.pi)), way)[0] == clear


def test_the_circle_of_another_car_is_measured() -> None:
    """From two messages, in the frame of a car that itself moves and turns."""
    scenario = load_scenario("highway_roundabout")
    driver, own_speed, own_turn, radius = RouteFollower(scenario), 6.0, 0.3, 20.0
    count, period = len(scenario.vehicles) - 1, 1.0 / scenario.rates.decision
    curvature = velocity = np.zeros(0)
    for time in (0.0, period):
        angle = 12.0 * time / radius
        place, forward = radius * np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        turned, moved = own_turn * time, own_speed * time
        frame = np.array([[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]])
        seen, ahead = frame @ (place - [moved, 0.0]), frame @ forward
        row = observation(
            scenario,
            velocity=[own_speed, 0.0, 0.0],
            angular_velocity=[0.0, 0.0, own_turn],
            message_mask=np.arange(count) == 0,
            message_position=[*seen, 0.0],
            message_forward=[*ahead, 0.0],
        )
        velocity, *_, curvature = driver.motions(row, *driver.received(row))
    assert curvature[0, 0] == pytest.approx(1.0 / radius, rel=0.02)
    assert np.linalg.norm(velocity[0, 0]) == pytest.approx(12.0, rel=0.02)


def test_the_intelligent_driver_keeps_its_distance() -> None:
    driver: Any = load_agent("idm", SCENARIO)
    free, near = (driver.drive(observation(velocity=[0.5, 0, 0], **way))[0][0] for way in ({}, other(0.9, 0, 0)))
    aside = driver.drive(observation(velocity=[0.5, 0, 0], **other(0.9, 1.0, 0)))[0][0]
    assert near < 0.5 < free == aside
    assert driver.drive(observation(velocity=[1.0, 0, 0]))[0][0] == pytest.approx(1.0)


def test_predicted_covariances_are_those_of_a_kalman_filter() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    P = root @ root.T
    belief = PlanarCovariance(*(np.array([P[i, j]]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))))
    dx, dy, landmarks = 0.4, -0.3, np.array([[[2.0, 1.0], [-1.0, 3.0], [4.0, 4.0]]])
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    P = F @ P @ F.T + np.diag([0.01, 0.01, 0.002])
    variance = np.array([[0.01, 0.02, 0.01]])
    predicted = belief.driven(np.array([dx]), np.array([dy]), 0.01, 0.002)
    uncertain = predicted.along(landmarks)
    for k, (offset, r) in enumerate(zip(landmarks[0], variance[0], strict=True)):
        square_ = offset @ offset
        H = np.array([[offset[1] / square_, -offset[0] / square_, -1.0]])
        along, across = offset / np.sqrt(square_), np.array([-offset[1], offset[0]]) / np.sqrt(square_)
        if k == 0:
            expected = [(H @ P @ H.T).item(), along @ P[:2, :2] @ along, across @ P[:2, :2] @ across]
            np.testing.assert_allclose([part[0, 0] for part in uncertain], expected, rtol=1e-9)
        if k < 2:
            K = P @ H.T / (H @ P @ H.T + r)
            P = (np.eye(3) - K @ H) @ P
    found = predicted.measured(landmarks, variance, np.array([[1.0, 1.0, 0.0]]))
    np.testing.assert_allclose(np.concatenate(found), P[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], rtol=1e-9)
    assert found.std == pytest.approx(np.sqrt(P[0, 0] + P[1, 1]))


def test_a_bearing_that_may_be_missing_counts_by_its_odds() -> None:
    none = np.zeros(1)
    belief = PlanarCovariance(np.ones(1), none, none, np.full(1, 2.0), none, np.full(1, 0.1))
    line, variance = np.array([[[3.0, 1.0]]]), np.full((1, 1), 0.001)
    never, maybe, surely = (belief.measured(line, variance, np.full((1, 1), odds)) for odds in (0.0, 0.3, 1.0))
    np.testing.assert_allclose(np.array(maybe), 0.7 * np.array(never) + 0.3 * np.array(surely), atol=1e-12)


def test_odds_of_a_view_fall_near_the_edges_and_far_away() -> None:
    view = FieldOfView(SCENARIO.camera)
    offset = np.array([[3.0, 0.0], [3.0, 1.5], [3.0, -1.5], [3.0, 8.0], [40.0, 0.0]])
    odds = view.odds(offset, np.zeros(5), np.full(5, 0.1), np.full(5, 0.2))
    assert odds[0] == 1.0 and (odds[1:3] > 0.1).all() and (odds[1:3] < 1.0).all() and (odds[3:] == 0.0).all()
    sharp = view.odds(offset, np.zeros(5), np.full(5, 1e-6), np.full(5, 1e-6))
    assert (sharp == view.sees(offset, np.zeros(5))).all()


def test_a_field_of_view_is_that_of_the_camera() -> None:
    view = FieldOfView(SCENARIO.camera)
    offset = np.array([[3.0, 0.0], [-3.0, 0.0], [7.0, 0.0], [2.0, 1.1], [2.0, 1.6], [2.0, -1.6]])
    assert view.sees(offset, np.zeros(6)).tolist() == [True, False, False, True, False, False]
    assert view.sees(offset, np.full(6, np.pi / 4)).tolist() == [False, False, False, True, True, False]
    around = FieldOfView(SCENARIO.camera.model_copy(update={"model": "omnidirectional", "range": None}))
    assert around.sees(offset, np.zeros(6)).all()


def test_missing_observation_fields_are_named() -> None:
    few = square(**{"observation.include": [group for group in GROUPS if group != "map"]})
    with pytest.raises(ValueError, match=r"agent 'peek' cannot be built: the observation lacks map_position "):
        load_agent("peek", few)
    nowhere = square(**{"observation.include": ["odometry"]})
    with pytest.raises(ValueError, match=r"the observation lacks route \(route: the group route or goal\)"):
        load_agent("constant_speed", nowhere)


def test_distances_fit_the_car() -> None:
    """Small cars have the given sizes; a full-size car keeps room for a car across its way."""
    small, large = RouteFollower(SCENARIO), RouteFollower(load_scenario("highway_intersection"))
    assert (small.clearance, small.closest, small.look_ahead, small.foresight) == (0.9, 0.75, 1.0, 6.0)
    assert small.paces == (1.0,)
    assert large.closest == pytest.approx(math.hypot(5.0 / 2, 2.0) + 0.25)  # two discs along it
    assert large.clearance == pytest.approx(large.closest + 0.15 * 5.0 / 0.586)
    assert large.look_ahead == pytest.approx(10.0)  # five decisions at 10 m/s
    assert large.foresight == pytest.approx(2.5)  # 2 s to stop from 10 m/s, and half a second
    assert load_agent("peek", load_scenario("highway_intersection")).ahead == pytest.approx(0.4 * 5.0 / 0.586)


def test_cars_of_highway_env_are_steered_on_the_pursued_circle() -> None:
    """highway-env's kinematic bicycle, from the published equations, gets to the point that is pursued."""
    driver = RouteFollower(load_scenario("highway_intersection"))
    for direction in (-0.4, 0.1, 0.5):
        steering = driver.pursue(np.array([direction])).item()
        slip = np.arctan(np.tan(steering) / 2.0)  # of the direction of motion from the heading
        curvature = np.sin(slip) / 2.5
        assert curvature == pytest.approx(2.0 * np.sin(direction - slip) / driver.look_ahead)


@pytest.mark.parametrize(("brakes", "speed"), [(5.0, -1.0), (20.0, 1.0)])
def test_slow_brakes_stop_for_a_vehicle_across_the_way(brakes: float, speed: float) -> None:
    """Driving at full speed the other would be gone in time."""
    scenario = load_scenario("highway_intersection", {"dynamics.max_acceleration": brakes, "v2x.links": "neighbours"})
    first = np.arange(len(scenario.vehicles) - 1) == 0
    place, forward = (np.outer(first, vector) for vector in ((12.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    row = observation(scenario, message_mask=first, message_position=place, message_forward=forward)
    assert RouteFollower(scenario)(row)[0, 0] == speed


HOUSE = {"name": "house", "center": [2.0, 1.0, 1.0], "size": [2.0, 1.0, 2.0], "yaw": 0.4}


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def fields(**given: Any) -> Any:
    return lambda name: np.asarray(given[name], dtype=float)


def test_occlusion_by_boxes_is_the_oracle_s() -> None:
    rng = np.random.default_rng(1)
    rows, camera_height, height, top = 40, 0.2, 0.6, 0.5
    angle, center = rng.uniform(-np.pi, np.pi, rows), rng.uniform(-2.0, 2.0, (rows, 2))
    forward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    below = (top - camera_height) / (height - camera_height)
    box = Occluder(center, forward, (0.8, 0.3), below, rng.uniform(size=rows) < 0.8, moves=True)
    camera, points = rng.uniform(-3.0, 3.0, (rows, 3, 2)), rng.uniform(-3.0, 3.0, (rows, 5, 2))
    seen = rng.uniform(size=(rows, 3, 5)) < 0.9
    found = seen & ~unhidden([box], seen, camera, points, distance=0.7)
    for r, p, k in np.ndindex(found.shape):
        place = [*(center[r] + 0.7 * forward[r]), 0.0]  # down to -0.5 m, which no line of sight reaches
        line = [*camera[r, p], camera_height], [*points[r, k], height]
        expected = is_occluded(*np.array(line), place, turn(angle[r]), np.array([0.8, 0.3, top]))
        assert found[r, p, k] == (expected and box.there[r] and seen[r, p, k])
    assert 0.1 < found.mean() < 0.6
    assert (unhidden([], seen, camera, points, distance=0.0) == seen).all()


def test_boxes_are_those_of_the_map_and_the_messages() -> None:
    scenario = square(obstacles=[HOUSE])
    occluders = Occluders(scenario, observation_layout(scenario))
    place, forward = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    place[0, 1], forward[0, 1] = (3.0, -1.0, 0.0), (0.0, 1.0, 0.0)
    read = fields(
        message_position=place,
        message_forward=forward,
        message_mask=[[0, 1, 0]],
        estimate_position=[[1.0, 0.0, 0.0]],
        estimate_forward=[[0.0, 1.0, 0.0]],
    )
    car, house = occluders.boxes(read)
    np.testing.assert_allclose(car.center, [[3.0, -0.84]])
    assert car.moves and 0.0 < car.below < 0.1  # a car is hardly higher than a camera
    np.testing.assert_allclose(house.center, [[1.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(house.forward, [[np.sin(0.4), -np.cos(0.4)]])
    assert house.below == 1.0 and not house.moves
    few = Occluders(scenario, {name: None for name in observation_layout(scenario) if name != "estimate_position"})
    assert len(few.boxes(read)) == 1  # who does not see where it is knows of no building


def test_landmarks_behind_the_truck_are_worth_nothing() -> None:
    """A car is lost, with landmarks ahead and to the left; a truck ahead is heard in one of two observations."""
    scenario = load_scenario("behind_truck")
    fields: dict[str, Any] = {
        **{name: 0.0 for name in ("position_std", "axis_std", "heading_std")},  # 1 m and 1 rad: it is lost
        "map_position": [[3.0, 0.2], [3.0, -0.2], [3.5, 0.0], [4.0, 0.1], [0.7, 2.9], [0.9, 2.7]],
        "message_position": [[0.9, 0.0]],
        "message_forward": [[1.0, 0.0]],
    }
    rows = np.concatenate([observation(scenario, **fields, message_mask=[heard]) for heard in (0.0, 1.0)])
    straight, aside = load_agent("peek", scenario)(rows)[:, 1]
    assert abs(straight) < 0.3 and aside > 0.6  # to the left
    free, hidden = LookAhead(scenario).costs(rows, np.zeros(2, int), [])[:, 0]  # of the plan straight on
    assert hidden > free + 1.0


def test_discs_cover_a_long_car() -> None:
    for length, width in ((5.0, 2.0), (12.0, 2.5), (2.0, 2.0)):
        centres = discs_along(length, width)
        edge = np.linspace(-length / 2, length / 2, 101)
        far = np.hypot(edge[:, None] - centres, width / 2).min(axis=1)
        assert far.max() <= np.hypot(length / len(centres), width) / 2 + 1e-9


def test_boxes_below_the_camera_hide_nothing_and_others_are_where_they_stand() -> None:
    """A camera at 0.4 m, landmarks at 2.4 m: a box up to 1.4 m is above half of every line of sight."""
    house = {"yaw": 0.5, "size": [2.0, 1.0, 0.2]}
    low, level, tall, towering = (
        {**house, "name": f"top_{top}", "center": [40.0, 1.0 + 9 * n, top - 0.1]}
        for n, top in enumerate((0.3, 0.4, 1.4, 9.0))
    )
    scenario = square(
        **{
            "obstacles": [low, level, tall, towering],
            "camera.position": [0.1, 0.0, 0.4],
            "landmarks.*.position": [5.0, 5.0, 2.4],
            "vehicles.*.body": {"size": [1.0, 0.5, 1.8], "center": [0.25, 0.1, 0.0]},
            "map.origin": [1.0, 2.0, 0.0],
        }
    )
    ahead = np.array([0.6, 0.8, 0.0])
    row = observation(
        scenario,
        estimate_position=(0.5, -1.0, 0.0),
        estimate_forward=ahead,
        message_position=[(2.0, 0.0, 0.0)] * 3,
        message_forward=[(0.0, 2.0, 0.0)] * 3,
        message_mask=[1, 0, 0],
    )
    layout = observation_layout(scenario)
    boxes = Occluders(scenario, layout).boxes(lambda name: layout[name].values(row))
    assert [box.below for box in boxes] == pytest.approx([0.25, 0.5, 1.0])  # vehicle, tall, towering
    assert [box.moves for box in boxes] == [True, False, False]
    assert [box.half for box in boxes] == [(0.5, 0.25), (1.0, 0.5), (1.0, 0.5)]
    vehicle, *houses = boxes
    assert vehicle.forward[0] == pytest.approx([0.0, 1.0]) and vehicle.center[0] == pytest.approx([1.9, 0.25])
    turn = np.array([[0.6, 0.8], [-0.8, 0.6]])
    for box, y in zip(houses, (19.0, 28.0), strict=True):
        assert box.center[0] == pytest.approx(turn @ (40.0 - 1.0 - 0.5, y - 2.0 + 1.0), abs=1e-5)
        assert box.forward[0] == pytest.approx(turn @ (math.cos(0.5), math.sin(0.5)), abs=1e-6)


def test_a_field_of_view_ends_short_of_the_edges_of_the_image() -> None:
    lens = {"model": "pinhole", "image_size": [640, 300], "principal_point": [300.0, 170.0], "range": 8.0}
    camera = square(
        **{f"camera.{key}": value for key, value in {**lens, "focal_length": [400.0, 250.0]}.items()}
    ).camera
    view, margin = FieldOfView(camera), math.radians(1.5)
    assert view.left == pytest.approx(math.atan(300.0 / 400.0) - margin, abs=1e-12)
    assert view.right == pytest.approx(-math.atan(340.0 / 400.0) + margin, abs=1e-12)
    assert view.reach == pytest.approx(0.95 * 8.0) and view.ahead == camera.position[0]
