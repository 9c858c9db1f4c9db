"""What becomes of a vehicle that has arrived: it parks, leaves, or goes on along another route."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from coopenv import ScenarioError
from coopenv.estimation.outcomes import Outcome, Sight
from tests.helpers.builders import command, run, scenario, start, vehicle

BODY = {"size": [0.5, 0.25, 0.25]}
DRIVEN = {"kind": "driven"}
CHASE = [
    vehicle((0.0, 0.0, 0.0), body=BODY, motion=DRIVEN, goal={"position": [1.5, 0, 0], "radius": 0.3}),
    vehicle((-1.5, 0.0, 0.0), body=BODY, motion=DRIVEN, goal={"position": [9.0, 0, 0], "radius": 0.3}),
]


def chase(after: str) -> list[dict[str, np.ndarray]]:
    """Return the states of a pair of which the leader's goal lies in the follower's way."""
    made = scenario(
        CHASE, termination={"after_arrival": after}, topology={"mode": "sensed", "acyclic": False}, horizon=30.0
    )
    world = start(made)
    command(world, [0.0, 0.0])
    return run(world, 480)


@pytest.mark.parametrize("after", ["park", "leave"])
def test_a_follower_hits_who_parks_and_passes_who_leaves(after: str) -> None:
    states = chase(after)
    ended = np.array([state["ended"][0] for state in states])
    first = int(np.argmax(ended[:, 0] == Outcome.ARRIVED))
    assert first > 0
    assert (ended[first:, 0] == Outcome.ARRIVED).all()
    assert (ended[-1, 1] == Outcome.COLLIDED) == (after == "park")
    present = np.array([state["present"][0, -2] for state in states])
    np.testing.assert_array_equal(present, (np.arange(481) <= first) | (after == "park"))
    seen = np.array([state["sight"][0, 1, -2] == Sight.VISIBLE for state in states])
    np.testing.assert_array_equal(seen, present == 1)
    sent = np.array([state["outbox_tick"][0, 0].max() for state in states])
    assert (sent[first + 3 :] <= first).all() == (after == "leave")
    assert [state["arrivals"][0, 0] for state in states] == [0] * first + [1] * (481 - first)


SQUARE = [
    {"name": "south", "waypoints": [[0, 0], [4, 0]]},
    {"name": "east", "waypoints": [[4, 0], [4.1, 0], [8, 0]]},
    {"name": "north", "waypoints": [[4, 0], [7, 0]], "lateral_spread": 0.1},
    {"name": "back", "waypoints": [[8, 0], [11, 0]]},
    {"name": "home", "waypoints": [[7, 0], [11.2, 0]]},
    {"name": "far", "waypoints": [[11, 0], [30, 0]]},
]


def walker(**more: Any) -> Any:
    one = {"routes": ["south"], "motion": {"kind": "driven", "initial_speed": 1.0}, "goal": {"radius": 0.4}, **more}
    routes = [
        *SQUARE,
        {"name": "last", "waypoints": [[30, 0], [60, 0]]},
        {"name": "end", "waypoints": [[60, 0], [90, 0]]},
    ]
    loop = {"name": "loop", "waypoints": [[90, 0], [99, 0], [99, 9], [90, 9], [90, 0.3]], "corner_radius": 1.0}
    return scenario([one], routes=[*routes, loop], termination={"after_arrival": "continue"}, horizon=60.0)


def test_a_vehicle_that_continues_draws_what_starts_where_it_has_arrived() -> None:
    made = walker()
    names = [route.name for route in made.routes]
    world = start(made, range(400))
    command(world, [1.0, 0.0])
    second, arrivals = np.full(400, -1), np.zeros(400, int)
    for state in run(world, 600):
        changed = (state["arrivals"][:, 0] == 1) & (second < 0)
        second[changed] = state["route_drawn"][changed, 0]
        assert (np.diff(np.stack([arrivals, state["arrivals"][:, 0]]), axis=0) >= 0).all()
        arrivals = state["arrivals"][:, 0]
        assert (state["ended"] == Outcome.UNDER_WAY).all()
    east, north = names.index("east"), names.index("north")
    assert {*second.tolist()} == {east, north}
    assert stats.binomtest(int((second == east).sum()), 400, 0.5).pvalue > 1e-3
    assert arrivals.min() >= 2
    goal, count = state["goal"][:, 0, :2], state["route_count"][:, 0]
    np.testing.assert_array_equal(state["route"][np.arange(400), 0, count - 1, :2], goal)


def test_next_routes_restrict_what_follows() -> None:
    names = [route.name for route in walker().routes]
    world = start(walker(next_routes=[name for name in names if name != "north"]), range(50))
    command(world, [1.0, 0.0])
    states = run(world, 300)
    assert {*states[-1]["route_drawn"][:, 0].tolist()} == {names.index("east")}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"termination": {"after_arrival": "leave", "arrival": False}}, "termination.arrival: must be true"),
        ({"termination": {"after_arrival": "vanish"}}, "termination.after_arrival"),
        ({"termination": {"after_arrival": "continue"}}, r"vehicles.0.routes: needed by a vehicle with a goal"),
    ],
)
def test_wrong_settings(sections: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario(CHASE, **sections)


def test_a_route_without_a_sequel_is_refused() -> None:
    one = {"routes": ["south"], "motion": DRIVEN}
    with pytest.raises(ScenarioError, match=r"within 0.5 m of the end of route 'far'"):
        scenario([one], routes=SQUARE, termination={"after_arrival": "continue"})
    with pytest.raises(ScenarioError, match=r"vehicles.0.next_routes: unknown route 'sout' \(did you mean 'south'\?\)"):
        scenario([{**one, "next_routes": ["sout"]}], routes=SQUARE)
