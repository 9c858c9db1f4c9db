"""The group `clearance`: how near a heard vehicle will come, against places at many instants in NumPy."""

import numpy as np

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.scenario import load_scenario

WORLDS, FAR = 8, 4.0
TIMES = np.linspace(0.0, 6.0, 3001)


def test_clearance_is_the_least_distance_on_the_two_ways_that_are_expected() -> None:
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
