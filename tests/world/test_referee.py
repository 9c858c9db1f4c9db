"""Contact of boxes, arrival, and what ends an episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.estimation import Outcome
from coopenv.scenario.routes import Boxes
from coopenv.world import referee
from tests.helpers.builders import command, constant, landmark, reset, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES, Calls
from tests.scenario.test_routes import depth as overlap

call = Calls(__name__, {referee.boxes_touch: "3 33 3 3 33 3 > b"})


def test_upright_boxes_against_a_linear_programme() -> None:
    rng = np.random.default_rng(0)
    count = 750
    ca, cb = rng.uniform(-1.5, 1.5, (2, count, 3)) * [1, 1, 0.7]
    yaw = rng.uniform(-np.pi, np.pi, (2, count))
    yaw[:, :200] = np.pi / 2 * rng.integers(0, 4, (2, 200))  # parallel faces
    Ra, Rb = (Rotation.from_euler("z", y[:, None]).as_matrix() for y in yaw)
    ha, hb = rng.uniform(0.05, 1.2, (2, count, 3))
    depth = np.array([overlap(Boxes(ca, Ra, ha), Boxes(cb, Rb, hb), n) for n in range(count)])
    clear = np.abs(depth) > 1e-5
    for dtype in DTYPES:
        touching = call(referee.boxes_touch, dtype, ca, Ra, ha, cb, Rb, hb)
        swapped = call(referee.boxes_touch, dtype, cb, Rb, hb, ca, Ra, ha)
        np.testing.assert_array_equal(touching[clear], (depth > 0)[clear])
        np.testing.assert_array_equal(swapped, touching)
        assert 0.2 < touching.mean() < 0.8


BODY = {"size": [1.0, 0.5, 0.4], "center": [0.3, 0.0, 0.2]}


def cars(*places: tuple[float, float, float], **sections: Any) -> Any:
    """Return standing vehicles with the same body at (x, y, yaw)."""
    return scenario([vehicle((x, y, 0.0), yaw, body=BODY) for x, y, yaw in places], **sections)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.99, 0.0, 0.0), 1),
        ((1.01, 0.0, 0.0), 0),
        ((0.0, 0.51, 0.0), 0),
        ((0.0, 0.49, 0.0), 1),
        ((1.59, 0.0, np.pi), 1),  # nose to nose: each body reaches 0.8 m ahead of its origin
        ((1.61, 0.0, np.pi), 0),
        ((1.04, -0.79, np.pi / 2), 1),
        ((1.06, -0.79, np.pi / 2), 0),
    ],
)
def test_contact_of_two_cars(place: tuple[float, float, float], expected: int) -> None:
    state = start(cars((0.0, 0.0, 0.0), place)).get_state()
    assert state["collided"][0].tolist() == [expected, expected]


def test_heights_count() -> None:
    low = vehicle((0, 0, 0), body=BODY)
    over = [vehicle((0.1, 0, z), body=BODY) for z in (0.39, 0.41)]
    assert [int(start(scenario([low, v])).get_state()["collided"][0, 0]) for v in over] == [1, 0]


def test_contact_with_buildings_and_bodies_of_landmarks() -> None:
    wall = {"name": "wall", "center": [2.0, 0.0, 0.5], "size": [1.0, 4.0, 1.0], "yaw": 0.0}
    post = landmark("post", (0.0, 3.0, 0.0), body={"size": [0.2, 0.2, 2.0]})
    bare = landmark("bare", (0.0, -3.0, 0.0))
    for place, expected in (  # moved there after the start, which may not be inside of a building
        ((0.69, 0, 0), 0),
        ((0.71, 0, 0), 1),
        ((-0.91, 3, 0), 0),
        ((-0.89, 3, 0), 1),
        ((0, -3, 0), 0),
    ):
        world = start(cars((-5.0, 0.0, 0.0), obstacles=[wall], landmarks=[post, bare]))
        state = world.get_state()
        state["position"][0, -1] = place
        state["start_position"][0, -1] = place
        world.set_state(state)
        world.advance(1)
        assert world.get_state()["collided"][0, 0] == expected, place


def test_vehicles_without_a_body_touch_nothing() -> None:
    state = start(scenario([vehicle((0, 0, 0)), vehicle((0.1, 0, 0), body=BODY)])).get_state()
    assert state["collided"][0].tolist() == [0, 0]


def crash(**termination: bool) -> list[dict[str, np.ndarray]]:
    """Return a second in which vehicle 1 runs at 2 m/s through vehicle 2, from 2 m away; vehicle 3 stands aside."""
    made = scenario(
        [
            vehicle((0, 0, 0), body=BODY, motion=constant([2.0, 0, 0])),
            vehicle((2, 0, 0), body=BODY),
            vehicle((0, 9, 0), body=BODY),
        ],
        termination=termination,
    )
    return run(start(made), 120)


def test_a_collision_ends_both_episodes_for_good() -> None:
    states = crash()
    touching = np.array([s["collided"][0] for s in states])
    ended = np.array([s["ended"][0] for s in states])
    expected = np.abs(2.0 - 2.0 * np.arange(121) / 60) <= 1.0 + 1e-9
    border = np.isclose(np.abs(2.0 - 2.0 * np.arange(121) / 60), 1.0)
    np.testing.assert_array_equal(touching[~border, 0], expected[~border])
    np.testing.assert_array_equal(touching[:, 1], touching[:, 0])
    first = int(np.argmax(touching[:, 0]))
    assert (ended[:first] == Outcome.UNDER_WAY).all()
    assert (ended[first:, :2] == Outcome.COLLIDED).all()
    assert (ended[:, 2] == Outcome.UNDER_WAY).all()


def test_collisions_may_be_tolerated() -> None:
    states = crash(collision=False)
    assert any(s["collided"][0, 0] for s in states)
    assert all((s["ended"][0] == Outcome.UNDER_WAY).all() for s in states)


@pytest.mark.parametrize("arrival", [True, False])
def test_arrival_is_by_horizontal_distance(arrival: bool) -> None:
    """The goal hangs 5 m above the road."""
    made = scenario(
        [vehicle((0, 0, 0), motion=constant([1.0, 0, 0]), goal={"position": [2.01, 0.3, 5], "radius": 0.5})],
        termination={"arrival": arrival},
    )
    ended = np.array([s["ended"][0, 0] for s in run(start(made), 180)])
    inside = np.hypot(2.01 - np.arange(181) / 60, 0.3) < 0.5
    first = int(np.argmax(inside))
    assert first == 97
    np.testing.assert_array_equal(
        ended, (np.arange(181) >= first) * (Outcome.ARRIVED if arrival else Outcome.UNDER_WAY)
    )


def test_a_goal_in_a_wall_is_a_collision() -> None:
    wall = {"name": "wall", "center": [2.0, 0.0, 0.2], "size": [1.0, 4.0, 1.0]}
    car = vehicle((0, 0, 0), body=BODY, motion=constant([1.0, 0, 0]), goal={"position": [2, 0, 0], "radius": 1.5})
    ended = [int(s["ended"][0, 0]) for s in run(start(scenario([car], obstacles=[wall])), 60)]
    near = vehicle((0, 0, 0), body=BODY, motion=constant([1.0, 0, 0]), goal={"position": [2, 0, 0], "radius": 1.29})
    late = [int(s["ended"][0, 0]) for s in run(start(scenario([near], obstacles=[wall])), 60)]
    assert ended[-1] == Outcome.ARRIVED
    assert late[-1] == Outcome.COLLIDED


def test_reset_clears_the_end() -> None:
    made = scenario([vehicle((0, 0, 0), motion={"kind": "driven"}, goal={"position": [0.3, 0, 0], "radius": 0.1})])
    world = start(made)
    command(world, [1.0, 0.0])
    world.advance(120)
    assert world.get_state()["ended"][0, 0] == Outcome.ARRIVED
    reset(world)
    assert world.get_state()["ended"][0, 0] == Outcome.UNDER_WAY
    world.advance(120)
    assert world.get_state()["ended"][0, 0] == Outcome.ARRIVED
