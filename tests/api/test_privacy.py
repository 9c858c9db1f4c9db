"""A vehicle sees only what it measures: hidden truth does not reach its observation."""

from __future__ import annotations

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.scenario import Scenario, load_scenario

OBSERVERS = ("riccati", "robust")


def silent(name: str, observer: str) -> Scenario:
    """An environment whose cameras see nothing, so that no measurement can depend on where anybody is."""
    return load_scenario(name, {"topology.mode": "sensed", "camera.range": 1e-6, "observer.name": observer})


@pytest.mark.parametrize("observer", OBSERVERS)
@pytest.mark.parametrize("name", coopenv.list_envs())
def test_observation_does_not_move_with_hidden_truth(name: str, observer: str) -> None:
    scenario = silent(name, observer)
    engine = Engine(scenario, 2, "float64")
    engine.reset([5, 5])
    state = engine.get_state()
    L = len(scenario.landmarks)
    for field in ("position", "start_position"):
        state[field][1, L:] += np.array([0.3, -0.2, 0.1])  # all vehicles of world 1 are elsewhere
    engine.set_state(state)
    for _ in range(20):
        engine.step(np.zeros((2, len(scenario.vehicles), 2)))
        seen = engine.view("observation")
        assert np.array_equal(seen[0], seen[1])
    assert not np.allclose(engine.view("position_error")[0], engine.view("position_error")[1])


@pytest.mark.parametrize("observer", OBSERVERS)
@pytest.mark.parametrize("name", coopenv.list_envs())
def test_observation_does_not_move_when_everything_moves_together(name: str, observer: str) -> None:
    """Other vehicles' truth reaches a vehicle through bearings alone: scaling a scene about a camera keeps them."""
    plain = {"noise.enabled": False, "topology.mode": "fixed", "camera.miss_probability": 0.0}
    scenario = load_scenario(name, {**plain, "observer.name": observer})
    engine = Engine(scenario, 2, "float64")
    engine.reset([5, 5])
    L = len(scenario.landmarks)
    state = engine.get_state()
    camera = state["position"][1, L] + state["rotation"][1, L] @ np.array(scenario.camera.position)
    # Only the first vehicle's leaders are landmarks; its followers may be anywhere without its noticing.
    state["position"][1, L + 1 :] += 0.5 * (state["position"][1, L + 1 :] - camera)
    state["start_position"][1, L + 1 :] = state["position"][1, L + 1 :]
    engine.set_state(state)
    for _ in range(10):
        engine.step(np.zeros((2, len(scenario.vehicles), 2)))
        assert np.array_equal(engine.view("observation")[0, 0], engine.view("observation")[1, 0])


@pytest.mark.parametrize("observer", OBSERVERS)
def test_truth_is_not_in_the_observation_by_value(observer: str) -> None:
    """No entry of the observation tracks the true position closer than the estimate does."""
    env = coopenv.parallel_env("busy_intersection", dtype="float64", observer=observer)
    observations, infos = env.reset(seed=0)
    scale = env.observation_layout["estimate_position"].scale
    for agent, seen in observations.items():
        truth, estimate = infos[agent]["truth"]["position"], infos[agent]["estimate"]["position"]
        shown = seen[env.observation_layout["estimate_position"].slice] * scale
        assert np.allclose(shown, estimate, atol=1e-4)
        assert not np.allclose(shown, truth, atol=0.5)


def test_observing_draws_nothing() -> None:
    """render, state and refresh leave the world as it is."""
    env = coopenv.parallel_env("urban_crossing", render_mode="rgb_array")
    env.reset(seed=0)
    before = env.get_state()
    env.state()
    env.render()
    env.engine.refresh()
    after = env.get_state()
    # a second report within a step has no progress to tell, but the world itself is untouched
    assert all(np.array_equal(before[key], after[key]) for key in before)
