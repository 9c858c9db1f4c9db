"""Vehicles with a driver in the scenario: as if the same policy chose their actions from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.make import make_rows
from coopenv.base.errors import CoopenvError
from coopenv.policies import decide, load_agent, restart
from coopenv.runs.exports import drive_vehicles
from coopenv.scenario import load_scenario
from tests.helpers.commands import refused

DRIVER = "stop_when_lost"  # it has a memory
FOLLOWERS = {f"vehicles.vehicle_{i}.motion.driver": DRIVER for i in (2, 3)}
SHORT = {"horizon": 6.0, "v2x.loss": 0.3}


def test_followers_of_the_scenario_drive_as_the_same_policy_from_outside() -> None:
    ours = coopenv.make_vec("scout_platoon", num_worlds=3, overrides={**FOLLOWERS, **SHORT})
    theirs = coopenv.make_vec("scout_platoon", num_worlds=3, overrides=SHORT)
    policy, rng = load_agent(DRIVER, theirs.scenario), np.random.default_rng(0)
    observed, _ = theirs.reset(seed=4)
    assert np.array_equal(observed, ours.reset(seed=4)[0])
    restart(policy, np.ones(9, dtype=bool))
    over = np.zeros(9, dtype=bool)
    for _ in range(150):  # two episodes and a half
        restart(policy, over)
        actions = decide(policy, observed)
        actions[::3] = rng.uniform([0.0, -0.3], [1.0, 0.3], (3, 2))
        observed, reward, *_, infos = theirs.step(actions)
        actions[1::3] = actions[2::3] = 0.7  # not theirs to choose
        here = ours.step(actions)
        assert np.array_equal(observed, here[0])
        assert np.array_equal(reward, here[1])
        over = infos["time"] == 0.0
    assert np.ptp(observed[1::3], axis=0).any()


def test_only_the_others_are_agents_and_a_state_holds_the_drivers() -> None:
    env = coopenv.parallel_env("scout_platoon", overrides={**FOLLOWERS, **SHORT})
    assert env.possible_agents == ["vehicle_1"]
    env.reset(seed=1)
    for _ in range(10):
        observations, rewards, *_ = env.step({"vehicle_1": np.zeros(2)})
    assert [*observations] == [*rewards] == ["vehicle_1"]
    state, runs = env.get_state(), []
    for _ in range(2):
        env.set_state(state)
        for _ in range(10):
            env.step({"vehicle_1": np.zeros(2)})
        runs.append(env.engine.view("position").copy())
    assert np.array_equal(*runs)


def test_rows_with_a_driver_are_not_learned_from() -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")
    from coopenv.api.trainers.sb3 import make_sb3_vec_env

    env = make_sb3_vec_env("scout_platoon", num_worlds=2, overrides={**FOLLOWERS, **SHORT}, seed=0)
    env.reset()
    done = np.zeros(6, dtype=int)
    for step in range(70):
        _, _, dones, _ = env.step(np.zeros((6, 2), dtype=np.float32))
        assert not env.acted.reshape(2, 3)[:, 1:].any()
        assert env.acted[0] or step
        done += dones
    assert done.tolist() == [1, 0, 0, 1, 0, 0]


def test_batches_mark_the_rows_that_act_and_show_these_alone() -> None:
    options = {"overrides": {**FOLLOWERS, **SHORT}}
    whole = coopenv.make_vec("scout_platoon", num_worlds=2, **options)
    assert whole.acting.tolist() == [True, False, False] * 2
    own = make_rows("scout_platoon", 2, acting=True, **options)
    assert own.num_envs == 2 and own.action_space.shape == (2, 2) == own.action_space.sample().shape
    for ours, theirs in zip(own.reset(seed=3), whole.reset(seed=3), strict=True):
        assert_rows(ours, theirs, whole.acting)
    actions = np.full((6, 2), 0.5)
    for _ in range(70):  # beyond the end of an episode
        for ours, theirs in zip(own.step(actions[whole.acting]), whole.step(actions), strict=True):
            assert_rows(ours, theirs, whole.acting)
    with pytest.raises(CoopenvError, match="2 is not a positive multiple of the 3 vehicles"):
        make_rows("scout_platoon", 2, **options)
    with pytest.raises(CoopenvError, match="there is nothing to drive"):
        make_rows("busy_intersection", 5, acting=True)


def assert_rows(ours: Any, theirs: Any, acting: np.ndarray) -> None:
    if isinstance(theirs, dict):
        assert [*ours] == [*theirs]
        for name in theirs:
            assert_rows(ours[name], theirs[name], acting)
    else:
        assert np.array_equal(ours, theirs[acting], equal_nan=True)


def test_a_dataset_holds_episodes_of_acting_vehicles_alone() -> None:
    scenario = load_scenario("scout_platoon", {**FOLLOWERS, "horizon": 1.0})
    episodes = drive_vehicles(scenario, load_agent("peek", scenario), 0, 2)
    assert [episode.vehicle for episode in episodes] == ["vehicle_1"] * 2


def test_an_evaluation_needs_a_vehicle_that_acts() -> None:
    with pytest.raises(CoopenvError, match="scout_platoon: every driven vehicle has a driver, there is") as caught:
        coopenv.evaluate("scout_platoon", "peek", 2, overrides={"vehicles.*.motion.driver": "constant_speed"})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vehicles.vehicle_2.motion.driver": "peekk"}, "vehicles.1.motion.driver: unknown agent 'peekk'"),
        ({"vehicles.*.motion.driver": "peek"}, "every vehicle has a driver, no agent is left"),
    ],
)
def test_drivers_that_are_not_possible(changes: dict[str, str], message: str) -> None:
    with pytest.raises(CoopenvError, match=message) as caught:
        coopenv.parallel_env("scout_platoon", overrides=changes)
    assert "\n" not in str(caught.value)


def test_a_description_refuses_an_unknown_driver() -> None:
    line = refused("describe", "open_square", "--set", "vehicles.vehicle_2.motion.driver=nobody")
    assert "vehicles.1.motion.driver: unknown agent 'nobody'; known: " in line


def test_a_prescribed_motion_takes_no_driver() -> None:
    with pytest.raises(CoopenvError, match=r"vehicles\.0\.motion.*driver"):
        load_scenario("overtaking", {"vehicles.vehicle_1.motion.driver": "peek"})
