"""One vehicle as an environment of Gymnasium, among vehicles that an agent drives."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import coopenv
from coopenv.api.single_vehicle import SingleVehicleEnv
from coopenv.policies import load_agent

CROSSING = "coopenv/UrbanCrossing-v0"


def paths_of(env: Any, steps: int) -> dict[str, np.ndarray]:
    """Return the paths (steps, 2) of all vehicles, the one of the action standing still."""
    places = []
    env.reset(seed=3)
    stop = np.array([-1.0, 0.0], np.float32)
    for _ in range(steps):
        env.step(stop)
        engine = env.unwrapped.world.engine
        places.append(engine.view("position")[0, -len(engine.backend.scenario.vehicles) :, :2].copy())
    return dict(zip(env.unwrapped.world.possible_agents, np.swapaxes(places, 0, 1), strict=True))


def test_the_default_is_the_last_driven_vehicle_among_route_followers() -> None:
    env = gymnasium.make(CROSSING)
    assert env.unwrapped.vehicle == "vehicle_4"  # type: ignore[attr-defined]
    found = paths_of(env, 40)
    by_name = paths_of(SingleVehicleEnv("urban_crossing", others="route_follower"), 40)
    for name, path in found.items():
        np.testing.assert_array_equal(path, by_name[name])
    assert np.linalg.norm(found["vehicle_1"][-1] - found["vehicle_1"][0]) > 2.0
    assert np.linalg.norm(found["vehicle_4"][-1] - found["vehicle_4"][20]) < 0.1


def test_others_are_an_agent_or_a_policy() -> None:
    scenario = coopenv.load_scenario("urban_crossing")
    peek = paths_of(SingleVehicleEnv("urban_crossing", others="peek"), 60)
    policy = paths_of(SingleVehicleEnv(scenario, others=load_agent("peek", scenario)), 60)
    straight = paths_of(SingleVehicleEnv("urban_crossing"), 60)
    np.testing.assert_array_equal(peek["vehicle_2"], policy["vehicle_2"])
    of_a_class = paths_of(SingleVehicleEnv("urban_crossing", others=type(load_agent("peek", scenario))), 60)
    np.testing.assert_array_equal(peek["vehicle_2"], of_a_class["vehicle_2"])
    assert not np.array_equal(peek["vehicle_2"], straight["vehicle_2"])
    with pytest.raises(coopenv.CoopenvError, match=r"unknown agent 'peak' \(did you mean 'peek'\?\)"):
        SingleVehicleEnv("urban_crossing", others="peak")
    with pytest.raises(coopenv.CoopenvError, match=r"^others: expected one agent for all other vehicles"):
        SingleVehicleEnv("urban_crossing", others={"vehicle_1": "peek"})


@pytest.mark.parametrize("key", ["action.pan", "action.longitudinal"])
def test_others_drive_on_with_every_kind_of_action(key: str) -> None:
    """Route followers choose speeds; where they cannot, others go straight on."""
    value: Any = {"limit": 1.0, "rate": 2.0} if key == "action.pan" else "acceleration"
    env = SingleVehicleEnv("urban_crossing", overrides={key: value, "horizon": 2.0})
    env.reset(seed=0)
    truncated = False
    while not truncated:
        *_, truncated, _ = env.step(env.action_space.sample())
    env.close()
