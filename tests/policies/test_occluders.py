"""What a driver believes to be hidden, against the depth of lines of sight in boxes."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopenv.api.terms.layout import observation_layout
from coopenv.policies import load_agent
from coopenv.policies.look_ahead import LookAhead
from coopenv.policies.prediction import Occluder, Occluders, unhidden
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.square import GROUPS, square
from tests.oracles.geometry import is_occluded

HOUSE = {"name": "house", "center": [2.0, 1.0, 1.0], "size": [2.0, 1.0, 2.0], "yaw": 0.4}


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def fields(**given: Any) -> Any:
    return lambda name: np.asarray(given[name], dtype=float)


def test_boxes_hide_what_the_oracle_says() -> None:
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
    scenario = square(observation={"include": GROUPS}, obstacles=[HOUSE])
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


def behind_the_truck() -> tuple[Scenario, np.ndarray]:
    """Return two observations of a car that is lost: of landmarks ahead and to the left; a truck is heard in one."""
    scenario = load_scenario("behind_truck")
    layout = observation_layout(scenario)
    fields: dict[str, Any] = {
        **{name: 0.0 for name in ("position_std", "axis_std", "heading_std")},  # 1 m and 1 rad: it is lost
        "map_position": [[3.0, 0.2], [3.0, -0.2], [3.5, 0.0], [4.0, 0.1], [0.7, 2.9], [0.9, 2.7]],
        "message_position": [[0.9, 0.0]],
        "message_forward": [[1.0, 0.0]],
    }
    rows = np.zeros((2, layout.size), dtype=np.float32)
    for k, heard in enumerate((0.0, 1.0)):
        for field, values in {**fields, "message_mask": [heard]}.items():
            rows[k, layout[field].slice] = ((np.array(values) - layout[field].center) / layout[field].scale).ravel()
    return scenario, rows


def test_peek_turns_to_what_the_truck_does_not_hide() -> None:
    scenario, rows = behind_the_truck()
    straight, aside = load_agent("peek", scenario)(rows)[:, 1]
    assert abs(straight) < 0.3 and aside > 0.6  # to the left


def test_a_plan_straight_on_is_worth_less_behind_a_truck() -> None:
    scenario, rows = behind_the_truck()
    free, hidden = LookAhead(scenario).costs(rows)[:, 0]
    assert hidden > free + 1.0
