"""A vehicle sees only what it measures: hidden truth does not reach its observation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv.api.engine import Engine
from coopenv.evaluation.episodes import driven_vehicles
from coopenv.measurements.sensor import kind_of
from coopenv.measurements.table import KINDS
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.schema import neighbour_sets
from coopenv.scenario.terms import GROUPS
from tests.helpers.env_suite import SHIPPED
from tests.helpers.four_way import FOUR_WAY

OBSERVERS = ("riccati", "robust")
MOVABLE = [name for name, scenario in SHIPPED.items() if scenario.backend == "simulated" and name != "city"]
"""Environments whose vehicles a saved state can put elsewhere; highway-env puts its own back where it has them, and the
traffic of the city drives by the truth."""
FIRST_SEES_NO_VEHICLE = [
    name for name in MOVABLE if max(neighbour_sets(SHIPPED[name])[0], default=-1) < len(SHIPPED[name].landmarks)
]
"""In take_turns it measures the vehicle that follows it."""
ON_HIGHWAY = [name for name, scenario in SHIPPED.items() if scenario.backend == "highway"]
ESTIMATED = (
    *("estimate_position", "estimate_rotation", "covariance"),
    *("log_determinant", "position_std", "targets_in_view"),
)
SENT = ("outbox", "observer_outbox")
"""Prefixes of a saved state's fields with messages, of the radio and of an observer."""

EVERYTHING = {"observation.include": list(GROUPS)}


def silent(name: str, observer: str, more: dict[str, Any] | None = None) -> Scenario:
    """An environment whose cameras and other sensors measure nothing, so that nothing depends on true poses."""
    given = load_scenario(name)
    blind = {"topology.mode": "sensed", "camera.range": 1e-6, "observer.name": observer}
    blind |= {f"vehicles.{i}.camera.range": 1e-6 for i, vehicle in enumerate(given.vehicles) if vehicle.camera}
    blind |= {"sensing": "blind"} if given.sensors else {}
    return load_scenario(name, {**EVERYTHING, **blind, **(more or {})})


@pytest.mark.parametrize("observer", OBSERVERS)
@pytest.mark.parametrize("name", MOVABLE)
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
@pytest.mark.parametrize("name", ON_HIGHWAY)
def test_truth_of_highway_env_is_not_observed_sent_or_estimated(name: str, observer: str) -> None:
    """In world 1 its driven cars are elsewhere, and measure and receive nothing there."""
    pytest.importorskip("highway_env", reason="needs the extra highway")
    scenario = silent(name, observer, {"v2x.range": 1e-6})
    engine = Engine(scenario, 2, "float64")
    engine.reset([5, 5])
    driven, state, away = driven_vehicles(scenario), engine.get_state(), np.array([0.3, -0.2])
    for i in driven:
        state["position"][1, len(scenario.landmarks) + i, :2] += away
        state["programs"][1]._cars[i].position += away * (1.0, -1.0)  # its y axis points down
    engine.set_state(state)
    for _ in range(8):
        engine.step(np.zeros((2, len(scenario.vehicles), 2)))
        known = {name: engine.view(name) for name in ("observation", *ESTIMATED)}
        known |= {name: values for name, values in engine.get_state().items() if name.startswith(SENT)}
        for field, values in known.items():
            assert_allclose(values[1, driven], values[0, driven], atol=1e-9, err_msg=field)
    apart = engine.view("position_error")[1, driven] - engine.view("position_error")[0, driven]
    assert (abs(apart) > 1e-3).all()


@pytest.mark.parametrize("observer", OBSERVERS)
@pytest.mark.parametrize("name", FIRST_SEES_NO_VEHICLE)
def test_observation_does_not_move_when_everything_moves_together(name: str, observer: str) -> None:
    """Other vehicles' truth reaches a vehicle through bearings alone: scaling a scene about a camera keeps them."""
    plain = {"noise.enabled": False, "topology.mode": "fixed", "camera.miss_probability": 0.0}
    plain |= {"v2x.links": "neighbours"}  # otherwise messages of followers are observed
    scenario = load_scenario(name, {**EVERYTHING, **plain, "observer.name": observer})
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


WITH_TARGETS = [{"kind": kind, "towards": ["landmarks", "vehicles"]} for kind in KINDS if kind_of(kind).has_target]


@pytest.mark.parametrize("observer", OBSERVERS)
def test_sensors_out_of_reach_do_not_let_hidden_truth_through(observer: str) -> None:
    sensors = [{**sensor, "range": 1e-6, "bias": 0.1, "correlated": {"std": 0.1}} for sensor in WITH_TARGETS]
    scenario = silent("busy_intersection", observer, {"sensors": sensors})
    engine = Engine(scenario, 2, "float64")
    engine.reset([5, 5])
    state = engine.get_state()
    state["position"][1, len(scenario.landmarks) :] += np.array([0.3, -0.2, 0.1])
    engine.set_state(state)
    for _ in range(8):
        engine.step(np.zeros((2, len(scenario.vehicles), 2)))
        assert np.array_equal(*engine.view("observation"))


def test_a_tick_holds_of_the_truth_no_more_than_its_measurements() -> None:
    """A world that is moved as a whole gives the same ticks: only measured positions, and the map, move with it."""
    sensors = [*WITH_TARGETS, {"kind": "attitude"}, {"kind": "position", "rate": 10.0}]
    engine = Engine(load_scenario("busy_intersection", {"sensors": sensors}), 2, "float64")
    engine.reset([5, 5])
    state, away = engine.get_state(), np.array([7.0, -5.0, 2.0])
    for name in ("position", "start_position"):
        state[name][1] += away
    engine.set_state(state)
    for k in range(1, 9):
        engine.world.advance(1)
        here, there = (engine.world.sensed(w, k) for w in range(2))  # type: ignore[attr-defined]
        for name, values in here.measured().items():
            moved = away if name == "landmarks" else 0.0
            assert_allclose(getattr(there, name), values + moved, atol=1e-9, err_msg=name)
        for name, values in here.readings.items():
            moved = away if name == "position" else 0.0
            assert_allclose(there.readings[name], values + moved, atol=1e-9, err_msg=name)
        assert there.messages == {} and there.truth is None


def explained(inputs: np.ndarray, outputs: np.ndarray, fit: int) -> np.ndarray:
    """Return the share of the variance of each output that a linear regression on the first `fit` rows explains."""
    inputs = np.column_stack([inputs, np.ones(len(inputs))])
    inputs = inputs[:, np.append(np.ptp(inputs[:, :-1], axis=0) > 1e-6, True)]
    weights = np.linalg.lstsq(inputs[:fit], outputs[:fit], rcond=1e-6)[0]
    residual = outputs[fit:] - inputs[fit:] @ weights
    return np.asarray(1.0 - residual.var(axis=0) / outputs[fit:].var(axis=0))


def test_without_bearings_an_observation_explains_no_error_beyond_the_estimate() -> None:
    """Estimates outside the start box are wrong; no other part of an observation correlates with the error."""
    blind = {"camera.range": 1e-6, "observer.name": "robust", "observation.planar": True}
    envs = coopenv.make_vec(FOUR_WAY, num_worlds=1000, overrides={**EVERYTHING, **blind})
    own = slice(0, None, len(envs.scenario.vehicles))  # one vehicle of every world
    observations, _ = envs.reset(seed=0)
    for steps in (0, 20):
        for _ in range(steps):
            observations = envs.step(np.tile([0.0, 0.0], (len(observations), 1)))[0]
        engine = envs.engine
        estimate = np.einsum(
            "wij,wj->wi", engine.view("estimate_rotation")[:, 0], engine.view("estimate_position")[:, 0]
        )
        error = (engine.view("position")[:, len(envs.scenario.landmarks)] - estimate)[:, :2]
        heading = engine.view("estimate_rotation")[:, 0, :2, 0]
        prior = explained(np.column_stack([estimate, heading]), error, 700)
        everything = explained(observations[own].astype(float), error, 700)
        assert (everything < prior + 0.1).all(), (prior, everything)


@pytest.mark.parametrize("observer", OBSERVERS)
def test_truth_is_not_in_the_observation_by_value(observer: str) -> None:
    """Over three seconds no vector of an observation is nearer to a vehicle's true position than its estimate is."""
    env = coopenv.parallel_env("busy_intersection_tracking", dtype="float64", observer=observer)
    steps = [env.reset(seed=0)]
    for _ in range(30):
        observations, _, _, _, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
        steps.append((observations, infos))
    vectors = [field for field in env.observation_layout.values() if field.shape[-1] == 3]
    assert len(vectors) > 5
    for owner in env.agents:
        truth, estimate = (
            np.array([infos[owner][kind]["position"] for _, infos in steps]) for kind in ("truth", "estimate")
        )
        error = rms_distance(estimate, truth)
        assert error > 1e-3
        for agent in env.agents:
            seen = np.array([observations[agent] for observations, _ in steps])
            for field in vectors:
                shown = seen[:, field.slice].reshape(len(steps), -1, 3) * field.scale
                nearest = min(rms_distance(shown[:, n], truth) for n in range(shown.shape[1]))
                assert nearest > 0.999 * error, (agent, owner)
        own = np.array([observations[owner] for observations, _ in steps])
        place = env.observation_layout["estimate_position"]
        assert np.allclose(own[:, place.slice] * place.scale, estimate, atol=1e-4)


def rms_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square distance in m of two paths (K, 3)."""
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=-1))))
