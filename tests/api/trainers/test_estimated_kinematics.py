"""Policies of highway-env on estimated kinematics."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv import CoopenvError

pytest.importorskip("highway_env", reason="needs the extra highway")

from estimated_kinematics import EstimatedKinematics
from gymnasium.utils.env_checker import check_env
from highway_env.envs.highway_env import HighwayEnv
from highway_env.envs.intersection_env import IntersectionEnv, MultiAgentIntersectionEnv
from highway_env.envs.roundabout_env import RoundaboutEnv

PLAIN = [(IntersectionEnv, "highway_intersection"), (RoundaboutEnv, "highway_roundabout")]
EXACT = {
    "noise.enabled": False,
    "vehicle_defaults.initial_estimate": {"position_radius": 0.0, "orientation_angle": 0.0},
    "observer.name": "dead_reckoning",
    "v2x": {"delay": 0, "loss": 0.0, "range": 1e4},
}
"""Estimates are the truth, but they come by odometry and radio."""


def wrapped(kind: Any = IntersectionEnv, scenario: str = "highway_intersection", **options: Any) -> EstimatedKinematics:
    return EstimatedKinematics(kind(options.pop("config", None)), scenario, **options)


def episode(env: Any, seed: int, steps: int = 6, action: int = 1) -> list[Any]:
    record: list[Any] = [env.reset(seed=seed)]
    while len(record) <= steps and not (len(record[-1]) == 5 and (record[-1][2] or record[-1][3])):
        record.append(env.step(action))
    return record


@pytest.mark.parametrize("lane_keeping", [False, True])
@pytest.mark.parametrize(("kind", "scenario"), PLAIN)
def test_estimates_that_are_the_truth_are_observed_as_such(kind: Any, scenario: str, lane_keeping: bool) -> None:
    env = wrapped(kind, scenario, overrides=EXACT, lane_keeping=lane_keeping)
    for plain, sensed in zip(episode(kind(), 0, 4), episode(env, 0, 4), strict=True):
        seen, true = (
            rows[np.argsort(rows[:, 1] + 0.37 * rows[:, 2])] for rows in (sensed[0], plain[0])
        )  # some are equally far away
        assert_allclose(
            seen[:, [0, 1, 2, *range(5, seen.shape[1])]], true[:, [0, 1, 2, *range(5, seen.shape[1])]], atol=5e-3
        )
        assert_allclose(seen[:, 3:5], true[:, 3:5], atol=0.04)  # of the last odometry sample, one step of braking old
        assert sensed[-1]["localisation"]["position_error"] < 1e-3
        assert len(sensed[-1]["connected"]) == 2


def test_the_agent_is_observed_at_its_estimate() -> None:
    env, plain = wrapped(), IntersectionEnv()
    for sensed, true in zip(episode(env, 5), episode(plain, 5), strict=True):
        reported = sensed[-1]["localisation"]
        assert_allclose(sensed[0][0, 1:3] * 100.0, reported["position"], atol=5e-3)
        assert_allclose(sensed[0][0, 5:7], [np.cos(reported["heading"]), np.sin(reported["heading"])], atol=1e-5)
        off = np.linalg.norm((sensed[0][0, 1:3] - true[0][0, 1:3]) * 100.0)
        assert off == pytest.approx(reported["position_error"], abs=0.1) and off > 1e-3  # errors have a height as well
        assert np.linalg.eigvalsh(reported["position_covariance"]).min() > 0.0


def test_estimates_do_not_move_the_truth() -> None:
    env, plain = wrapped(sensing="blind"), IntersectionEnv()
    episode(env, 5)
    episode(plain, 5)
    for car, same in zip(env.highway.road.vehicles, plain.road.vehicles, strict=True):
        assert np.array_equal(car.position, same.position) and car.lane_index == same.lane_index


def test_others_are_as_seen_from_the_agent() -> None:
    env, plain = wrapped(connected=0, sensing="blind"), IntersectionEnv()
    for sensed, true in zip(episode(env, 5, 3), episode(plain, 5, 3), strict=True):
        assert sensed[-1]["connected"] == ()
        places = []
        for rows in (sensed[0], true[0]):
            x, y, c, s = rows[0, [1, 2, 5, 6]]
            there = rows[rows[:, 0] == 1.0][1:]
            there = there[np.abs(there[:, 1:3]).max(axis=1) < 0.9]
            places.append((there[:, 1:3] - (x, y)) @ np.array([[c, -s], [s, c]]))
            assert len(there) > 1
        assert min(np.abs(places[0] - place).max() for place in [places[1]] if len(place) == len(places[0])) < 1e-4


def test_without_bearings_errors_grow() -> None:
    errors = {}
    for sensing in ("ideal", "sensed", "blind"):
        ends = [episode(wrapped(sensing=sensing), seed, 4)[-1][-1]["localisation"] for seed in range(2)]
        errors[sensing] = np.mean([end["position_error"] for end in ends])
        assert all((end["visible"] == ()) == (sensing == "blind") for end in ends)
    assert errors["ideal"] < errors["sensed"] < 0.2 < 1.0 < errors["blind"]


def test_there_may_be_more_traffic_than_the_scenario_expects() -> None:
    env = wrapped(HighwayEnv, config={"vehicles_count": 50}, overrides={"highway.most_vehicles": 8})
    record = episode(env, 0, 2)
    assert len(env.highway.road.vehicles) > 40
    assert all(np.isfinite(step[-1]["localisation"]["position_error"]) for step in record)


def test_lane_keeping_may_act_on_the_estimate() -> None:
    aside = {}
    for lane_keeping in (False, True):
        env = wrapped(sensing="blind", lane_keeping=lane_keeping)
        episode(env, 3, 2)
        aside[lane_keeping] = abs(float(env.highway.vehicle.position[0]) - 2.0)
    assert aside[False] < 0.01 and aside[True] > 0.3


@pytest.mark.parametrize("observer", ["riccati", pytest.param("mekf", marks=pytest.mark.slow)])
def test_any_observer_and_any_observation(observer: str) -> None:
    config = {"observation": {"type": "OccupancyGrid", "features": ["presence", "vx", "vy"]}}
    env = wrapped(config=config, overrides={"observer.name": observer})
    last = episode(env, 2, 3)[-1]
    assert last[0].shape == env.observation_space.shape and last[0][0].sum() > 0.0
    assert last[-1]["localisation"]["position_error"] < 1.0


def test_the_wrapper_passes_the_check_of_gymnasium() -> None:
    check_env(wrapped(), skip_render_check=True)
    env, other = wrapped(), wrapped()
    first = episode(env, 7, 4)
    for again in (episode(wrapped(), 7, 4), episode(env, 7, 4)):
        assert all(np.array_equal(a[0], b[0]) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0][0], other.reset(seed=8)[0])


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: wrapped(sensing="blnd"), "sensing: Input should be .*, got 'blnd'"),
        (lambda: wrapped(connected=-1), "connected must be a whole number and not negative, got -1"),
        (lambda: wrapped(scenario="urban_crossing"), 'urban_crossing has not backend = "highway"'),
        (lambda: EstimatedKinematics(gymnasium.make("CartPole-v1")), "environments of highway-env, not CartPoleEnv"),
        (lambda: wrapped(MultiAgentIntersectionEnv).reset(), "takes environments with one agent, this one has 2"),
    ],
)
def test_mistakes_are_one_line(make: Any, why: str) -> None:
    with pytest.raises(CoopenvError, match=why):
        make()
