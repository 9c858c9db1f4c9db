"""The wrappers and checks that users bring along work unchanged on every face; infos that are numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers import vector as wrappers
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pettingzoo.test import parallel_api_test
from pettingzoo.utils.wrappers import RecordVideoParallel
from plain_infos import NUMBERS, PlainInfos
from true_ends import TrueEnds

import coopenv
from coopenv.api.vector_env import RecordVehicleEpisodes
from tests.helpers.env_suite import first_episodes
from tests.helpers.four_way import FOUR_WAY

CROSSING = "coopenv/UrbanCrossing-v0"
ROWS = "coopenv/UrbanCrossingRows-v0"


def batch(**options: Any) -> coopenv.CooperativeVectorEnv:
    return coopenv.make_vec(FOUR_WAY, num_worlds=3, **options)


def wide_turns(env: gymnasium.vector.VectorEnv) -> np.ndarray:
    """Return actions under which vehicles hit walls, each at a time of its own, or come to the horizon."""
    return np.column_stack([np.ones(env.num_envs), np.linspace(0.0, 0.5, env.num_envs)]).astype(np.float32)


# Gymnasium, one vehicle


def test_time_limit_and_statistics_of_one_vehicle() -> None:
    env = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make(CROSSING, max_episode_steps=7))
    env.reset(seed=0)
    total, done = 0.0, False
    while not done:
        _, reward, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
        total, done = total + reward, terminated or truncated
    assert truncated
    assert info["episode"]["l"] == 7
    assert info["episode"]["r"] == pytest.approx(total)


def test_time_aware_observation_knows_the_horizon() -> None:
    env = gymnasium.make(CROSSING)
    scenario = coopenv.load_scenario("urban_crossing")
    assert env.spec is not None
    assert env.spec.max_episode_steps == round(scenario.horizon * scenario.rates.decision)
    aware = gymnasium.wrappers.TimeAwareObservation(env)
    assert aware.observation_space.contains(aware.reset(seed=0)[0])


@pytest.mark.parametrize("horizon", [1.05, 1.25])  # in the midst of a decision
def test_the_spec_has_the_length_of_an_episode(horizon: float) -> None:
    def never(observations: np.ndarray) -> np.ndarray:
        raise AssertionError("nobody else is here")

    env = gymnasium.make("coopenv/Facade-v0", overrides={"horizon": horizon}, others=never)
    env.reset(seed=0)
    steps = 1
    while not env.step(np.zeros(2, dtype=np.float32))[3]:
        steps += 1
    assert env.spec is not None and steps == env.spec.max_episode_steps
    assert env.unwrapped.world.engine.view("truncated").all()  # type: ignore[attr-defined]


# PettingZoo


def test_agents_are_a_copy_and_unknown_ones_are_named() -> None:
    env = coopenv.parallel_env(FOUR_WAY)
    env.reset(seed=0)
    env.agents.append("x")
    assert env.agents == env.possible_agents
    with pytest.raises(coopenv.CoopenvError, match=r"unknown agent 'vehicle1' \(did you mean 'vehicle_1'"):
        env.observation_space("vehicle1")
    with pytest.raises(coopenv.CoopenvError, match="unknown agent 'car'; known: vehicle_1"):
        env.action_space("car")


def test_a_generator_for_wrappers_follows_the_seed() -> None:
    env = coopenv.parallel_env(FOUR_WAY)
    env.reset(seed=3)
    first = env.np_random.random()
    env.reset()
    assert env.np_random.random() != first
    env.reset(seed=3)
    assert env.np_random.random() == first


def test_aec_goes_through_the_same_states_as_the_parallel_face() -> None:
    turns, together = pettingzoo.make("aec", CROSSING), pettingzoo.make("parallel", CROSSING)
    turns.reset(seed=5)
    observations, _ = together.reset(seed=5)
    for _ in range(3):
        for agent in list(turns.agents):
            observation, *_ = turns.last()
            assert turns.agent_selection == agent
            assert np.array_equal(observation, observations[agent])
            turns.step(np.full(2, 0.1, dtype=np.float32))
        observations, *_ = together.step({agent: np.full(2, 0.1, dtype=np.float32) for agent in together.agents})
    assert np.array_equal(turns.state(), together.state())


# Gymnasium, all vehicles of a batch


def test_make_vec_by_name() -> None:
    env = gymnasium.make_vec(ROWS, num_envs=8)
    assert env.num_envs == 8 and env.unwrapped.num_worlds == 2
    assert env.observation_space.shape == (8, *env.single_observation_space.shape)
    with pytest.raises(coopenv.CoopenvError, match="not a positive multiple of the 4 vehicles"):
        gymnasium.make_vec(ROWS, num_envs=9)


def test_a_vector_of_an_id_has_one_vehicle_of_each_world_and_small_infos() -> None:
    def step(**options: Any) -> tuple[Any, dict[str, Any]]:
        env = gymnasium.make_vec(CROSSING, num_envs=3, **options)
        observations, _ = env.reset(seed=[5, 6, 7])
        *_, infos = env.step(np.zeros((3, 2), np.float32))
        env.close()
        return observations, infos

    observations, infos = step()
    for seed, row in zip((5, 6, 7), observations, strict=True):
        np.testing.assert_array_equal(row, gymnasium.make(CROSSING).reset(seed=seed)[0])
    assert {"position_error", "nees", "time"} <= {*infos} and not {"truth", "estimate", "reward_terms"} & {*infos}
    assert all(values.dtype.kind in "biufO" for values in infos.values())
    np.testing.assert_array_equal(step(vectorization_mode="sync")[1]["nees"], infos["nees"])
    assert {"truth", "estimate", "reward_terms"} <= {*step(details=True)[1]}


@pytest.mark.parametrize("autoreset", ["next_step", "same_step", "disabled"])
def test_action_and_observation_wrappers(autoreset: str) -> None:
    env = wrappers.RescaleAction(batch(autoreset=autoreset), np.float32(0.0), np.float32(1.0))
    twin: gymnasium.vector.VectorEnv = wrappers.ClipAction(batch(autoreset=autoreset))
    if autoreset != "same_step":  # Gymnasium's observation wrappers do not touch final_obs, and so refuse this mode
        twin = wrappers.FlattenObservation(twin)
    assert np.array_equal(env.reset(seed=1)[0], twin.reset(seed=1)[0])
    actions = wide_turns(env)
    for _ in range(5):
        first, second = env.step((actions + 1.0) / 2.0), twin.step(actions)
        assert np.allclose(first[0], second[0], atol=1e-5)
        assert np.allclose(first[1], second[1], atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*Overwriting existing videos")
@pytest.mark.parametrize("vehicles", ["one", "all", "a batch"])
def test_record_video(vehicles: str, tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="RecordVideo needs the extra 'video'")
    if vehicles == "one":
        env: Any = RecordVideo(gymnasium.make(CROSSING, render_mode="rgb_array"), str(tmp_path), video_length=3)
    elif vehicles == "all":
        short = coopenv.parallel_env(FOUR_WAY, render_mode="rgb_array", overrides={"horizon": 0.3})
        env = RecordVideoParallel(short, str(tmp_path))
    elif hasattr(wrappers, "RecordVideo"):
        rows = coopenv.make_vec(FOUR_WAY, num_worlds=1, render_mode="rgb_array")
        env = wrappers.RecordVideo(rows, str(tmp_path), video_length=3)
    else:
        pytest.skip("this Gymnasium records no batches")
    env.reset(seed=0)
    for _ in range(4):
        if vehicles != "all":
            env.step(env.action_space.sample())
        elif env.agents:
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    env.close()
    (video,) = tmp_path.iterdir()
    assert video.suffix == ".mp4" and video.stat().st_size > 1000


# Statistics of vehicles' episodes


DECISIONS = 60
OPTIONS = {"num_worlds": 6, "overrides": {"horizon": DECISIONS / 10}}


@pytest.mark.parametrize("autoreset", ["next_step", "same_step", "disabled"])
def test_true_episodes_only(autoreset: str) -> None:
    plain = coopenv.make_vec(FOUR_WAY, autoreset="disabled", **OPTIONS)
    returned, length, _ = first_episodes(plain, 5, DECISIONS, lambda observation: wide_turns(plain))
    assert length.min() < DECISIONS and length.max() == DECISIONS
    env = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, autoreset=autoreset, **OPTIONS), buffer_length=1000)
    env.reset(seed=5)
    weights = env.unwrapped.scenario.reward.by_name
    first_return, first_length = np.full(env.num_envs, np.nan), np.zeros(env.num_envs)
    for _ in range(2 * DECISIONS + 2):
        _, _, terminated, truncated, infos = env.step(wide_turns(env.unwrapped))
        if "episode" in infos:
            of, episode_info = infos["_episode"], infos["episode"]
            fresh = of & np.isnan(first_return)
            first_return[fresh], first_length[fresh] = episode_info["r"][fresh], episode_info["l"][fresh]
            weighted = sum(weights[name] * total for name, total in episode_info["reward_terms"].items())
            assert weighted[of] == pytest.approx(episode_info["r"][of], abs=1e-3)
            assert not episode_info["r"][~of].any()
        over = env.unwrapped.world_major(terminated | truncated).all(axis=1)
        if autoreset == "disabled" and over.any():
            env.reset(options={"reset_mask": over})
    assert first_return == pytest.approx(returned, abs=1e-3)
    assert np.array_equal(first_length, length)
    assert env.episode_count == len(env.return_queue) >= 2 * env.num_envs
    assert max(env.length_queue) == DECISIONS and min(env.length_queue) > 0


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_statistics_of_gymnasium_are_true_over_true_ends(autoreset: str) -> None:
    if autoreset == "same_step" and tuple(map(int, gymnasium.__version__.split(".")[:2])) < (1, 4):
        pytest.skip("the wrapper of older Gymnasium loses the first reward after a reset in this mode")
    own = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, autoreset=autoreset, **OPTIONS), buffer_length=1000)
    env = RecordEpisodeStatistics(TrueEnds(own), buffer_length=1000, stats_key="gymnasium")
    env.reset(seed=5)
    for _ in range(2 * DECISIONS + 2):
        _, _, terminated, truncated, infos = env.step(wide_turns(env.unwrapped))
        if "final_obs" in infos:
            assert np.array_equal(infos["_final_obs"], terminated | truncated)
    assert env.episode_count == own.episode_count >= 2 * env.num_envs
    assert list(env.return_queue) == pytest.approx(list(own.return_queue), abs=1e-3)


def test_a_reset_begins_anew() -> None:
    env = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, **OPTIONS))
    env.reset(seed=5)
    for _ in range(7):
        env.step(np.zeros((env.num_envs, 2), np.float32))
    env.reset()
    for _ in range(DECISIONS):
        *_, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
    assert set(infos["episode"]["l"][infos["_episode"]]) == {DECISIONS}


def test_tensors_are_refused() -> None:
    pytest.importorskip("torch", reason="needs the extra 'train'")
    with pytest.raises(coopenv.CoopenvError, match=r"needs NumPy arrays: make_vec\(arrays='numpy'\)"):
        RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, arrays="torch", **OPTIONS))


def test_infos_are_numbers_and_hold_no_truth() -> None:
    env, full = PlainInfos(coopenv.parallel_env(FOUR_WAY)), coopenv.parallel_env(FOUR_WAY)
    observations, infos = env.reset(seed=3)
    expected, complete = full.reset(seed=3)
    for _ in range(20):
        assert set(infos) == set(env.agents)
        for agent, info in infos.items():
            assert tuple(info) == NUMBERS
            assert all(type(value) is float for value in info.values())
            assert info["nees"] == complete[agent]["nees"]
            assert np.array_equal(observations[agent], expected[agent])
        actions = {agent: np.full(2, 0.1, dtype=np.float32) for agent in env.agents}
        observations, _, _, _, infos = env.step(actions)
        expected, _, _, _, complete = full.step(actions)


def test_events_show_once_and_actions_of_the_dead_are_dropped() -> None:
    env = PlainInfos(coopenv.parallel_env(FOUR_WAY))
    env.reset(seed=0)
    turns = {agent: np.array([1.0, 0.2 + 0.1 * i], dtype=np.float32) for i, agent in enumerate(env.possible_agents)}
    collided = dict.fromkeys(env.possible_agents, 0.0)
    while env.agents:
        _, _, terminated, _, infos = env.step(turns)  # for all, the dead included
        for agent, info in infos.items():
            assert (info["arrived"] + info["collided"] == 1.0) == terminated[agent]
            collided[agent] += info["collided"]
    assert set(collided.values()) == {1.0}


def test_conforms() -> None:
    env = PlainInfos(coopenv.parallel_env(FOUR_WAY))
    parallel_api_test(env, num_cycles=100)
    env.reset(seed=0)
    assert env.state_space.contains(env.state())
    with pytest.raises(coopenv.ActionError, match="no action for 'vehicle_1'"):
        env.step({})
