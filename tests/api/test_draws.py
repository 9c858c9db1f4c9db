"""Draws of worlds, as agents and trainers meet them: absent vehicles, options of resets, new routes under way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from coopenv import CoopenvError
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.api.single_vehicle import SingleVehicleEnv
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.runs import Rollout
from coopenv.runs.rollouts import outcome_line
from coopenv.scenario import Scenario
from coopenv.scenario.difficulty import PARAMETERS
from tests.helpers.builders import constant, landmark, scenario, vehicle
from tests.helpers.four_way import FOUR_WAY

HALF = {"vehicles.*.presence": 0.5}
DRIVEN = {"kind": "driven", "initial_speed": 0.5}


def sometimes(**more: Any) -> Scenario:
    """Three cars, each there in half of the worlds."""
    cars = [vehicle((0.0, 3.0 * k, 0.0), motion=DRIVEN, presence=0.5) for k in range(3)]
    return scenario(cars, horizon=1.0, **more)


def batch(made: Scenario, worlds: int = 64, **options: Any) -> CooperativeVectorEnv:
    return CooperativeVectorEnv(made, "test", num_worlds=worlds, **options)


def test_absent_vehicles_are_no_agents() -> None:
    env = CooperativeLocalisationEnv(sometimes(), "test")
    counts = set()
    for seed in range(40):
        observations, infos = env.reset(seed=seed)
        ended = env.engine.view("ended")[0]
        there = [agent for agent, value in zip(env.possible_agents, ended, strict=True) if value == 0]
        assert env.agents == list(observations) == list(infos) == there
        counts.add(len(there))
        while env.agents:
            _, rewards, _, truncated, _ = env.step({a: np.zeros(2, np.float32) for a in env.agents})
            assert list(rewards) == there
        assert all(truncated.values())
    assert counts == {1, 2, 3}
    parallel_api_test(env, num_cycles=50)


def test_the_vehicle_of_a_single_environment_is_there() -> None:
    env = SingleVehicleEnv(FOUR_WAY, vehicle="vehicle_3", overrides=HALF)
    for seed in range(12):
        _, info = env.reset(seed=seed)
        assert info["outcome"] == "under way"
        assert "vehicle_3" in env.world.agents


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_rows_of_absent_vehicles_are_never_alive_and_never_terminate(autoreset: str) -> None:
    env = batch(sometimes(reward={"weights": {"time": 1.0}}), autoreset=autoreset)
    env.reset(seed=3)
    patterns = set()
    for _ in range(35):
        absent = env.engine.view("ended").reshape(-1) == -1
        _, reward, terminated, truncated, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
        step = infos.get("final_info", infos)
        over = env.world_major(truncated).any(axis=1)
        same = ~np.repeat(over, 3) if autoreset == "next_step" else np.ones(env.num_envs, bool)
        gone = absent & same & (step["ended"] == -1)
        assert gone.any() or not same.any()
        assert not (step["alive"] | terminated)[gone].any()
        assert not reward[gone].any()
        patterns.add(absent.tobytes())
    assert len(patterns) > 2


def test_options_reach_every_interface() -> None:
    made = sometimes(randomisation={"camera_range": [0.5, 1.0]}, difficulty={"v2x_loss": [0.0, 2.0]})
    column = list(PARAMETERS).index("camera_range")
    one = CooperativeLocalisationEnv(made, "test")
    one.reset(seed=1, options={"parameters": {"camera_range": 0.25}, "difficulty": "easy"})
    assert one.engine.view("parameter")[0, column] == pytest.approx(0.25)
    one.reset()
    assert one.engine.view("parameter")[0, column] == pytest.approx(0.25)
    assert one.engine.view("difficulty")[0] == 0.0
    one.reset(options={"parameters": {"camera_range": None}, "difficulty": None})
    assert one.engine.view("parameter")[0, column] >= 0.5
    assert one.engine.view("difficulty")[0] == 0.5


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_settings_hold_for_automatic_resets(autoreset: str) -> None:
    made = sometimes(randomisation={"camera_range": [0.5, 1.0]}, difficulty={"v2x_loss": [0.0, 2.0]})
    env = batch(made, 4, autoreset=autoreset)
    column = list(PARAMETERS).index("camera_range")
    factors = np.array([0.1, 0.2, 0.3, 0.4])
    env.reset(seed=0, options={"parameters": {"camera_range": factors}, "difficulty": factors})
    episodes = env.engine.view("episode").copy()
    for _ in range(25):
        env.step(np.zeros((12, 2), np.float32))
    assert (env.engine.view("episode") > episodes + 1).all()
    np.testing.assert_allclose(env.engine.view("parameter")[:, column], factors, rtol=1e-6)
    np.testing.assert_allclose(env.engine.view("difficulty"), factors, rtol=1e-6)


def test_settings_of_a_masked_reset_are_of_its_worlds() -> None:
    env = batch(sometimes(), 3, autoreset="disabled")
    env.reset(seed=0)
    column = list(PARAMETERS).index("slip")
    env.reset(options={"reset_mask": np.array([True, False, True]), "parameters": {"slip": 2.0}})
    np.testing.assert_allclose(env.engine.view("parameter")[:, column], [2.0, 1.0, 2.0])
    np.testing.assert_allclose(env.engine.view("parameter_set")[:, column], [2.0, -1.0, 2.0])


WRONG = [
    ({"parameters": {"camera_rnage": 1.0}}, r"unknown parameter 'camera_rnage' \(did you mean 'camera_range'\?\)"),
    ({"parameters": 3}, "option 'parameters' must be a dict, got int"),
    ({"parameters": {"slip": -1.0}}, "parameter 'slip' must be from 0 to 100, got -1.0"),
    ({"parameters": {"slip": np.nan}}, "parameter 'slip' must be from 0 to 100"),
    ({"parameters": {"slip": "much"}}, "parameter 'slip' must be from 0 to 100, got 'much'"),
    ({"parameters": {"slip": [1.0, 2.0, 3.0]}}, r"parameter 'slip' has shape \(3,\), expected a number or one per"),
    ({"parameters": {"camera_range": 0.0}}, "parameter 'camera_range' must be from 0.001 to 100"),
    ({"parameters": {"traffic_pace": 2.0}}, "parameter 'traffic_pace' must be from 0 to 1, got 2.0"),
    ({"difficulty": 1.5}, "option 'difficulty' must be from 0 to 1, got 1.5"),
    ({"difficulty": "heard"}, r"unknown difficulty 'heard' \(did you mean 'hard'\?\); known: easy, normal, hard"),
    ([1], "options must be a dict"),
    ({"dificulty": 1}, r"unknown option 'dificulty' \(did you mean 'difficulty'\?\)"),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_wrong_options_are_one_error_in_all_interfaces(options: Any, message: str) -> None:
    made = sometimes()
    one = SingleVehicleEnv(FOUR_WAY)
    for env in (CooperativeLocalisationEnv(made, "test"), batch(made, 2), one):
        with pytest.raises(CoopenvError, match=message):
            env.reset(seed=0, options=options)


def test_arrivals_pay_each_and_progress_goes_on_along_the_next_route() -> None:
    """The sum of progress is the way driven, whatever the number of routes."""
    routes = [{"name": f"r{k}", "waypoints": [[3.0 * k, 0], [3.0 * k + 3.0, 0]]} for k in range(5)]
    routes.append({"name": "on", "waypoints": [[15, 0], [90, 0], [90, 90], [15, 90], [15, 0.1]], "corner_radius": 5.0})
    made = scenario(
        [{"routes": ["r0"], "motion": DRIVEN, "goal": {"radius": 0.4}}],
        routes=routes,
        termination={"after_arrival": "continue"},
        reward={"weights": {"progress": 1.0, "arrival": 10.0}, "privileged": True},
        horizon=8.0,
        topology={"mode": "fixed"},
    )
    env = CooperativeLocalisationEnv(made, "test", dtype="float64")
    env.reset(seed=0)
    terms = {"progress": 0.0, "arrival": 0.0}
    while env.agents:
        _, _, _, truncated, infos = env.step({"vehicle_1": np.array([1.0, 0.0], np.float32)})
        for name in terms:
            terms[name] += infos["vehicle_1"]["reward_terms"][name]
        assert infos["vehicle_1"]["outcome"] == "under way"
    assert truncated["vehicle_1"]
    driven = float(env.engine.view("position")[0, -1, 0])
    assert driven > 9.0
    assert terms["arrival"] == env.engine.view("arrivals")[0, 0] >= 3
    assert terms["progress"] == pytest.approx(driven, abs=1e-4)


def test_drawn_landmarks_stand_in_the_truth_of_the_state() -> None:
    group = {"name": "g", "count": 3, "boxes": [{"center": [0, 5], "half": [3, 1]}], "height": [0.5, 1.0]}
    made = scenario([vehicle()], landmarks=[landmark("A", (1, 1, 1))], landmark_groups=[group])
    env = CooperativeLocalisationEnv(made, "test")
    env.reset(seed=0)
    first = env.engine.view("position")[0, :4].copy()
    sensed = env.engine.world.sensed(0, 0).landmarks
    np.testing.assert_allclose(sensed, first, rtol=1e-6)
    env.reset(seed=1)
    second = env.engine.view("position")[0, :4]
    np.testing.assert_array_equal(first[0], second[0])
    assert (np.abs(first[1:] - second[1:]).max(axis=1) > 1e-3).all()


def test_a_run_names_absent_vehicles() -> None:
    run = Rollout(sometimes(), seed=1)
    assert len(list(run.play())) == 61
    words = [ending.outcome for ending in run.endings()]
    assert words.count("absent") == 2
    assert "2 absent" in outcome_line(run)


@pytest.mark.parametrize("observer", ["riccati", "robust", pytest.param("mekf", marks=pytest.mark.slow)])
def test_observers_know_where_landmarks_have_been_drawn(observer: str) -> None:
    """Embedded and on the host: without noise the estimate goes to the truth, whatever the map."""
    group = {"name": "g", "count": 6, "boxes": [{"center": [0, 0], "half": [6, 6]}], "height": [0.5, 3.0]}
    belief = {"position_radius": 0.5, "orientation_angle": 0.2}
    car = {**vehicle((0, 0, 0.5), motion=constant([1.0, 0, 0], [0, 0, 0.3])), "initial_estimate": belief}
    made = scenario([car], landmarks=[], landmark_groups=[group], observer={"name": observer}, horizon=6.0)
    env = CooperativeLocalisationEnv(made, "test", dtype="float64")
    for seed in (0, 1):
        _, infos = env.reset(seed=seed)
        assert infos["vehicle_1"]["position_error"] > 0.1
        while env.agents:
            *_, infos = env.step({"vehicle_1": np.zeros(2, np.float32)})
        assert infos["vehicle_1"]["position_error"] < 0.02
