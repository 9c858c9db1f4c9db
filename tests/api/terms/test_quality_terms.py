"""Terms of quality and of protection levels in observation and reward."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
import coopenv.observers.registry as registry
from coopenv.observers import Estimate, register
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.four_way import FOUR_WAY

QUALITY = ("position_uncertainty", "position_error_per_metre")
OVER_A_WAY = {"observer.gramian_distance": 8.0}
PLACES = {FOUR_WAY: OVER_A_WAY, f"{FOUR_WAY}, nobody sees far": {"camera.range": 3.0, **OVER_A_WAY}}
DRIVERS = ("stand still", "creep", "constant speed", "give way", "weave")


OVERRIDES = {
    "observer.name": "robust",
    "reward.weights.uncertainty": 0.0,
    "reward.weights.visibility": 0.0,
    "reward.privileged": True,
}


def scenario_of(place: str) -> Scenario:
    return load_scenario(place.partition(",")[0], {**OVERRIDES, **PLACES[place]})


def driver(name: str, scenario: Scenario) -> Any:
    """Return a policy of observations (rows, D); towards the goal unless it says otherwise."""
    steady = {"stand still": [-1.0, 0.0], "creep": [-0.8, 0.0], "constant speed": [1.0, 0.0]}
    if name in steady:
        return lambda observations: np.tile(steady[name], (len(observations), 1))
    drive = RouteFollower(scenario)
    if name == "give way":
        return drive
    phase, weave = iter(range(10**6)), np.array([0.0, 0.5])
    return lambda observations: np.clip(drive(observations) + weave * np.sin(0.4 * next(phase)), -1.0, 1.0)


class Drive(NamedTuple):
    """Results of one driver: arrays (steps, worlds, vehicles), and flags of the entries that count."""

    counts: np.ndarray
    terms: dict[str, np.ndarray]
    reward: np.ndarray
    furthest: np.ndarray
    values: dict[str, np.ndarray]

    def total(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.counts, values, 0.0).sum(axis=0)


VALUES = ("position_std", "position_error", "log_determinant", "ended", "furthest")


@cache
def drive(place: str, name: str) -> Drive:
    scenario = scenario_of(place)
    changes = {**OVERRIDES, **PLACES[place]}
    envs = coopenv.make_vec(place.partition(",")[0], num_worlds=3, autoreset="disabled", overrides=changes)
    engine, policy = envs.engine, driver(name, scenario)
    observations, _ = envs.reset(seed=3)
    steps: list[list[np.ndarray]] = [[engine.view(field).copy() for field in (*VALUES, "alive", "terms", "reward")]]
    while not engine.view("over").all():
        observations = envs.step(policy(observations))[0]
        steps.append([engine.view(field).copy() for field in (*VALUES, "alive", "terms", "reward")])
    *values, alive, terms, reward = map(np.array, zip(*steps, strict=True))
    alive[0] = False  # a reset earns nothing
    of_name = dict(zip(engine.reward_terms, np.moveaxis(terms, -1, 0), strict=True))
    named = dict(zip(VALUES, values, strict=True))
    return Drive(alive, of_name, reward, named["furthest"], named)


def lengths(scenario: Scenario) -> np.ndarray:
    """Return how long the vehicles' straight ways are, m."""
    starts = np.array([vehicle.initial_pose.position for vehicle in scenario.vehicles])
    goals = np.array([vehicle.goal.position for vehicle in scenario.vehicles if vehicle.goal])
    return np.asarray(np.linalg.norm((goals - starts)[:, :2], axis=1))


@pytest.mark.parametrize("name", DRIVERS)
@pytest.mark.parametrize("place", PLACES)
def test_terms_are_the_excess_times_the_metres_gained_and_the_cap_for_those_never_driven(place: str, name: str) -> None:
    scenario, run = scenario_of(place), drive(place, name)
    gained = np.diff(run.furthest, axis=0)
    length = lengths(scenario)
    last = run.counts[1:] & ~np.append(run.counts[2:], np.zeros_like(run.counts[:1]), axis=0)
    missed = np.where(last & (run.values["ended"][1:] != 1), length - run.furthest[1:], 0.0)
    for term, measure in zip(QUALITY, ("position_std", "position_error"), strict=True):
        excess = np.clip(run.values[measure][1:] - 0.02, 0.0, 1.0)
        expected = -(excess * gained + missed)
        counts = run.counts[1:]
        np.testing.assert_allclose(run.terms[term][1:][counts], expected[counts], atol=2e-5)
        total = run.total(run.terms[term])
        assert (run.terms[term][run.counts] <= 0.0).all() and (total >= -length - 1e-4).all()
    assert gained.min() >= 0.0 and gained.max() <= 2 * 0.1 + 1e-4  # m in a decision at 1 m/s
    assert (run.furthest <= length + 1e-4).all()


@pytest.mark.parametrize("name", DRIVERS[1:])
@pytest.mark.parametrize("place", PLACES)
def test_driving_scores_above_standing_still_at_any_weight(place: str, name: str) -> None:
    run, still = drive(place, name), drive(place, DRIVERS[0])
    farther = run.furthest[-1] > still.furthest[-1] + 1.0
    assert farther.mean() > 0.5
    for term in QUALITY:
        alone = run.total(run.terms[term]), still.total(still.terms[term])
        assert (alone[0] > alone[1])[farther].all()  # and so at any weight, if there is no other term
        for weight in 10.0 ** np.arange(-2, 4):
            returns = [of.total(of.reward + weight * of.terms[term]).mean() for of in (run, still)]
            assert returns[0] > returns[1], weight


@pytest.mark.parametrize("name", DRIVERS)
def test_information_gain_is_what_the_end_has_more_than_the_start(name: str) -> None:
    run = drive(FOUR_WAY, name)
    potential = -run.values["log_determinant"] / 6
    steps = run.counts.sum(axis=0)
    end = np.take_along_axis(potential, steps[None], axis=0)[0]
    np.testing.assert_allclose(run.total(run.terms["information_gain"]), end - potential[0], atol=1e-3)


@pytest.mark.parametrize("place", PLACES)
def test_the_shortfall_of_observability_is_bounded_and_worst_for_standing_still(place: str) -> None:
    lengths_of, still = lengths(scenario_of(place)), drive(place, DRIVERS[0])
    for name in DRIVERS[1:]:
        run = drive(place, name)
        values = run.terms["observability_shortfall"]
        assert (values[run.counts] <= 0.0).all() and (run.total(values) >= -4.0 * lengths_of - 1e-3).all()
        farther = run.furthest[-1] > still.furthest[-1] + 1.0
        assert (run.total(values) > still.total(still.terms["observability_shortfall"]))[farther].all()


def test_a_vehicle_without_a_goal_pays_nothing() -> None:
    weights = {f"reward.weights.{name}": 1.0 for name in QUALITY}
    envs = coopenv.make_vec("busy_intersection", num_worlds=1, overrides={**weights, "reward.privileged": True})
    envs.reset(seed=0)
    assert not np.any(envs.step(np.zeros(envs.action_space.shape))[1])


INF = float("inf")
GROUP = {"observation.include": ["protection"], "noise.enabled": False}


@pytest.fixture
def stated(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Yield a list whose only entry `stating` states as its protection level."""
    level: list[Any] = [None]

    class Stating(DeadReckoning):
        def update(self, tick: Any) -> Estimate:
            return replace(super().update(tick), protection_level=level[0])

    monkeypatch.setattr(registry, "_registered", {})
    register("stating", Stating)
    yield level


@pytest.mark.parametrize(
    ("level", "position", "angle"),
    [
        ((10.0**-0.5, 10.0**-1.5), 0.0, 0.0),
        ((1.0, 0.01), 1 / 3, -1 / 3),
        ((10.0, 1.0), 1.0, 1.0),
        ((1e-9, 1e-9), -1.0, -1.0),
        ((INF, INF), 1.0, 1.0),
        (None, 1.0, 1.0),
    ],
)
def test_values_and_infos(stated: list[Any], level: Any, position: float, angle: float) -> None:
    stated[0] = level
    known = level or (INF, INF)
    env = coopenv.parallel_env("busy_intersection", observer="stating", overrides=GROUP)
    _, infos = env.reset(seed=0)
    assert infos["vehicle_1"]["protection_level"] == [INF, INF]
    observations, _, _, _, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    for agent, seen in observations.items():
        assert_allclose(seen, [position, angle], atol=1e-6)
        assert infos[agent]["protection_level"] == list(known)
    envs = coopenv.make_vec("busy_intersection", num_worlds=2, overrides={**GROUP, "observer.name": "stating"})
    envs.reset(seed=0)
    rows, *_, infos = envs.step(np.zeros((envs.num_envs, 2), np.float32))
    assert_allclose(rows, np.tile([position, angle], (envs.num_envs, 1)), atol=1e-6)
    assert_allclose(infos["protection_level"], np.tile(known, (envs.num_envs, 1)))
