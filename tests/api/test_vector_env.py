"""Batches: single worlds bit for bit, autoreset, wrong actions and options, saved states; actions of a single world."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import coopenv
from tests.helpers.env_suite import ALIKE, SHIPPED
from tests.helpers.four_way import FOUR_WAY

KINDS = {(made.backend, made.observer.name, made.observer.k): name for name, made in SHIPPED.items()}
"""An environment of each source and observer, which have kernels of their own."""


def actions_for(env: coopenv.CooperativeVectorEnv, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (env.num_envs, 2)).astype(np.float32)


def busy(num_worlds: int = 2, **options: Any) -> tuple[coopenv.CooperativeVectorEnv, np.ndarray]:
    """Return a batch that has been reset with seed 1, and actions of zero for its rows."""
    env = coopenv.make_vec("busy_intersection", num_worlds=num_worlds, **options)
    env.reset(seed=1)
    return env, np.zeros((env.num_envs, 2), dtype=np.float32)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        *(pytest.param(name, "float32", marks=[pytest.mark.slow] * (name in ALIKE)) for name in SHIPPED),
        *((name, "float64") for name in KINDS.values()),
    ],
)
def test_single_world_is_world_0_bit_for_bit(name: str, dtype: str) -> None:
    """And world 2 of the batch is the single world 2 of its seed."""
    batch = coopenv.make_vec(name, num_worlds=3, dtype=dtype, autoreset="disabled")
    rng = np.random.default_rng(0)
    observations, _ = batch.reset(seed=40)
    singles, names = {n: coopenv.parallel_env(name, dtype=dtype) for n in (0, 2)}, batch.scenario.vehicle_names
    for world, single in singles.items():
        first, _ = single.reset(seed=40, options={"world": world})
        alive = batch.engine.view("alive")[world]
        there = [i for i in batch.scenario.agents() if alive[i]]
        assert list(first) == [names[i] for i in there]
        assert np.array_equal(batch.world_major(observations)[world][there], np.stack(list(first.values())))
    slow = batch.scenario.backend != "simulated"  # cars are stepped on the host
    for _ in range(4 if slow else 20):
        actions = batch.world_major(actions_for(batch, rng))
        observations, rewards, terminated, truncated, infos = batch.step(actions.reshape(-1, 2))
        assert batch.observation_space.contains(observations) and rewards.dtype == np.float32
        assert terminated.dtype == truncated.dtype == bool
        for world, single in singles.items():
            alive = list(single.agents)
            results = single.step({agent: actions[world, names.index(agent)] for agent in alive})
            for agent in alive:
                row = world * batch.vehicles + names.index(agent)
                assert np.array_equal(observations[row], results[0][agent])
                assert rewards[row] == np.float32(results[1][agent])
                assert (terminated[row], truncated[row]) == (results[2][agent], results[3][agent])
                info = results[4][agent]
                for field in ("position_error", "nees", "log_determinant", "gramian_min_eigenvalue"):
                    assert infos[field][row] == info[field]
                assert {term: values[row] for term, values in infos["reward_terms"].items()} == info["reward_terms"]
                assert infos["time"][row] == pytest.approx(info["time"])
                assert infos["alive"][row]


def test_next_step_mode() -> None:
    env, zero = busy(overrides={"horizon": 0.5})
    assert env.metadata["autoreset_mode"] is env.autoreset_mode is AutoresetMode.NEXT_STEP
    first, _ = env.reset(seed=1)
    for _ in range(4):
        _, _, terminated, truncated, _ = env.step(zero)
        assert not (terminated | truncated).any()
    last, reward, terminated, truncated, _ = env.step(zero)
    assert truncated.all() and not terminated.any()
    again, reward, terminated, truncated, infos = env.step(zero)
    assert not (terminated | truncated).any() and (reward == 0).all() and infos["alive"].all()
    assert env.engine.view("tick").tolist() == [0, 0]
    assert not np.array_equal(again, last) and not np.array_equal(again, first)  # drawn anew


def test_same_step_mode() -> None:
    (env, zero), (twin, _) = (busy(overrides={"horizon": 0.5}, autoreset=mode) for mode in ("same_step", "disabled"))
    for step in range(1, 11):
        observation, reward, _, truncated, infos = env.step(zero)
        expected = twin.step(zero)
        assert np.array_equal(reward, expected[1]) and np.array_equal(truncated, expected[3])
        assert truncated.all() == (step % 5 == 0)
        assert ("final_obs" in infos) == truncated.any()
        if truncated.all():
            assert np.array_equal(infos["final_obs"], expected[0])
            assert np.array_equal(infos["_final_obs"], truncated)
            assert np.array_equal(infos["final_info"]["position_error"], expected[4]["position_error"])
            again, fresh = twin.reset()
            assert np.array_equal(observation, again)
            assert np.array_equal(infos["position_error"], fresh["position_error"])  # of the new episode


def test_disabled_mode_resets_by_mask() -> None:
    env, zero = busy(3, autoreset="disabled")
    for _ in range(3):
        before, *_ = env.step(zero)
    mask = np.zeros(env.num_envs, dtype=bool)
    mask[5:10] = True  # the rows of world 1
    after, _ = env.reset(options={"reset_mask": mask})
    assert np.array_equal(after[:5], before[:5]) and np.array_equal(after[10:], before[10:])
    assert not np.array_equal(after[5:10], before[5:10])
    assert env.engine.view("tick").tolist() == [18, 0, 18]
    by_world, _ = env.reset(options={"reset_mask": np.array([True, False, False])})
    assert env.engine.view("tick").tolist() == [0, 0, 18]
    assert np.array_equal(by_world[10:], before[10:])


def test_over_worlds_wait_in_disabled_mode() -> None:
    env, zero = busy(1, overrides={"horizon": 0.2}, autoreset="disabled")
    env.step(zero)
    at_end, _, _, truncated, _ = env.step(zero)
    still, reward, _, truncated_again, infos = env.step(zero)
    assert truncated.all() and truncated_again.all() and np.array_equal(at_end, still)
    assert (reward == 0).all() and not infos["alive"].any()


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_dead_rows(autoreset: str) -> None:
    """A vehicle terminates once, earns nothing afterwards, and its row is truncated when the world is over."""
    env = coopenv.make_vec(FOUR_WAY, num_worlds=16, autoreset=autoreset)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    dead = np.zeros(env.num_envs, dtype=bool)
    deaths = ends = 0
    for _ in range(250):
        ticks = env.engine.view("tick").copy()
        _, reward, terminated, truncated, infos = env.step(np.abs(actions_for(env, rng)))
        assert np.array_equal(infos.get("final_info", infos)["alive"], ~dead)
        assert (reward[dead] == 0).all() and not terminated[dead].any()
        over = env.world_major(truncated).any(axis=1) | env.world_major(dead | terminated).all(axis=1)
        assert np.array_equal(over, env.world_major(truncated | terminated).all(axis=1) | over)
        assert env.world_major(truncated | terminated)[over].all()
        deaths, ends = deaths + int(terminated.sum()), ends + int(over.sum())
        dead |= terminated
        dead[np.repeat(over, env.vehicles)] = False
        assert (env.engine.view("tick")[~over] >= ticks[~over]).all() or autoreset == "next_step"
    assert deaths > 10 and ends > 5


def test_results_are_fresh_arrays() -> None:
    env, zero = busy()
    first, second = env.step(zero), env.step(zero)
    for a, b in zip(first[:4], second[:4], strict=True):
        assert not np.shares_memory(a, b) and not np.shares_memory(a, env.engine.view("observation"))
    for name, value in first[4].items():
        assert not np.shares_memory(value, second[4][name])


def test_rendering() -> None:
    env = coopenv.make_vec("overtaking", num_worlds=2, render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros((env.num_envs, 2)))
    pictures = env.render()
    assert len(pictures) == env.num_envs
    assert all(picture.dtype == np.uint8 and picture.ndim == 3 for picture in pictures)
    assert pictures[0] is pictures[1] and not np.array_equal(pictures[0], pictures[2])
    env.close()


def bad(value: Any, dtype: Any = np.float32) -> np.ndarray:
    actions = np.zeros((10, 2), dtype=dtype)
    actions[7, 1] = value
    return actions


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((9, 2)), r"shape \(9, 2\), expected \(10, 2\)"),
        (np.zeros(20), r"shape \(20,\)"),
        (bad(np.nan), "action of row 7 is not finite"),
        (bad(np.inf), "action of row 7 is not finite"),
        (np.full((10, 2), "left"), "expected a float"),
        (np.zeros((10, 2), dtype=complex), "expected a float"),
    ],
)
def test_wrong_actions(actions: np.ndarray, message: str) -> None:
    with pytest.raises(coopenv.ActionError, match=message):
        busy()[0].step(actions)


def test_nan_on_the_device_counts_as_zero_for_its_vehicle() -> None:
    """Where actions cannot be checked without waiting for the device, one that is not finite counts as zero."""
    env = coopenv.make_vec(FOUR_WAY, num_worlds=2, autoreset="disabled")
    twin = coopenv.make_vec(FOUR_WAY, num_worlds=2, autoreset="disabled")
    env.reset(seed=0)
    twin.reset(seed=0)
    for batch, value in ((env, np.nan), (twin, 0.0)):
        actions = np.full((2, 4, 2), 0.5)
        actions[1, 2] = value
        batch.engine.set_actions(actions)
        batch.engine.step()
    assert np.array_equal(env.engine.view("observation"), twin.engine.view("observation"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_worlds": 0}, "num_worlds must be at least 1"),
        ({"num_worlds": 10**9}, r"num_worlds: 1000000000 would need .* GiB of memory, there are"),
        ({"num_worlds": 1, "device": "gpu"}, "unknown device 'gpu'"),
        ({"num_worlds": 1, "device": "cuda:0"}, "no CUDA device is available"),
        ({"num_worlds": 1, "dtype": "float16"}, r"unknown dtype 'float16' \(did you mean"),
        ({"num_worlds": 1, "autoreset": "nextstep!"}, "unknown autoreset"),
        ({"num_worlds": 1, "arrays": "jax"}, "unknown arrays 'jax'"),
        ({"num_worlds": 1, "threads": 0}, "threads must be at least 1"),
        ({"num_worlds": 1, "render_mode": "human"}, "unknown render_mode"),
    ],
)
def test_wrong_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(coopenv.CoopenvError, match=message):
        coopenv.make_vec("busy_intersection", **options)


def test_batch_goes_on_after_a_fork() -> None:
    env, zero = busy(64, threads=2)
    assert env.engine.world.threads == 2
    env.step(zero)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python warns of forking a process that has threads
        with multiprocessing.get_context("fork").Pool(1) as pool:
            there = pool.apply_async(_reward_of_a_step, (env.get_state(),)).get(timeout=60)
    assert np.array_equal(there, env.step(zero)[1])


def _reward_of_a_step(state: dict[str, Any]) -> np.ndarray:
    env, zero = busy(64, threads=2)
    env.set_state(state)
    return env.step(zero)[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"options": {"reset_mask": np.zeros(2, dtype=bool)}}, "at least one True"),
        ({"options": {"reset_mask": [0, 1]}}, "array of bool"),
        ({"options": {"reset_mask": np.arange(10) == 3}}, "splits world 0"),
        ({"options": {"reset_mask": np.ones(3, dtype=bool)}}, r"reset_mask has shape \(3,\)"),
        ({"seed": [1, 2, 3]}, "3 seeds for 2 worlds"),
    ],
)
def test_wrong_resets(arguments: Any, message: str) -> None:
    with pytest.raises(coopenv.CoopenvError, match=message):
        busy()[0].reset(**arguments)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", [1, -2], True])
def test_wrong_seeds(seed: Any) -> None:
    with pytest.raises(coopenv.CoopenvError, match="seed"):
        coopenv.make_vec("busy_intersection", num_worlds=2).reset(seed=seed)
    with pytest.raises(coopenv.CoopenvError, match="seed"):
        coopenv.parallel_env("busy_intersection").reset(seed=seed)


def test_states_of_other_scenarios_do_not_fit() -> None:
    (env, _), other = busy(), coopenv.make_vec("busy_intersection_mirror", num_worlds=2)
    other.reset(seed=0)
    for state, message in ((other.get_state(), "another scenario"), ({}, "another scenario"), (None, "not a mapping")):
        with pytest.raises(coopenv.CoopenvError, match=f"this state does not fit busy_intersection_v0: .*{message}"):
            env.set_state(state)


def test_counts_may_be_of_numpy() -> None:
    env = coopenv.make_vec("busy_intersection", num_worlds=np.int64(2))
    assert type(env.num_envs) is int and env.reset(seed=0)[0].shape[0] == 10
    assert gymnasium.make_vec("coopenv/BusyIntersectionRows-v0", num_envs=np.int64(10)).num_envs == 10


def restored(env: coopenv.CooperativeVectorEnv) -> coopenv.CooperativeVectorEnv:
    other = coopenv.make_vec(FOUR_WAY, num_worlds=3, overrides={"horizon": 1.0})
    other.reset(seed=4)
    other.step(np.ones((12, 2), np.float32))
    other.set_state(env.get_state())
    return other


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), restored])
def test_copies_go_on_alike_and_apart(duplicate: Callable[[Any], Any]) -> None:
    env = coopenv.make_vec(FOUR_WAY, num_worlds=3, overrides={"horizon": 1.0})
    env.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(actions_for(env, rng))
    other = duplicate(env)
    assert other.np_random.bit_generator.state == env.np_random.bit_generator.state
    actions = actions_for(env, rng)
    ours, theirs = ([each.step(actions)[:4] for _ in range(12)] for each in (env, other))
    for mine, yours in zip(ours, theirs, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(mine, yours, strict=True))


def test_dict_observations_are_the_flat_ones_by_field() -> None:
    options = {"num_worlds": 2, "overrides": {"horizon": 0.5}, "autoreset": "same_step"}
    flat, parts = (coopenv.make_vec(FOUR_WAY, observation=kind, **options) for kind in ("flat", "dict"))
    rows, named = flat.reset(seed=1)[0], parts.reset(seed=1)[0]
    for _ in range(6):
        assert parts.observation_space.contains(named)
        assert np.array_equal(np.concatenate(list(named.values()), axis=1), rows)
        rows, *_, infos = flat.step(np.zeros((8, 2), np.float32))
        named, *_, named_infos = parts.step(np.zeros((8, 2), np.float32))
        if "final_obs" in infos:
            assert np.array_equal(np.concatenate(list(named_infos["final_obs"].values()), axis=1), infos["final_obs"])


@pytest.fixture(scope="module")
def env() -> coopenv.CooperativeLocalisationEnv:
    env = coopenv.parallel_env(FOUR_WAY)
    env.reset(seed=0)
    return env


GOOD = {f"vehicle_{i}": np.zeros(2, dtype=np.float32) for i in range(1, 5)}


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({**GOOD, "vehicle_2": [np.nan, 0.0]}, "action of 'vehicle_2' is not finite"),
        ({**GOOD, "vehicle_2": [np.inf, 0.0]}, "action of 'vehicle_2' is not finite"),
        ({**GOOD, "vehicle_2": [0.0, 0.0, 0.0]}, r"action of 'vehicle_2' has shape \(3,\), expected \(2,\)"),
        ({**GOOD, "vehicle_2": 0.5}, r"action of 'vehicle_2' has shape \(\), expected \(2,\)"),
        ({**GOOD, "vehicle_2": "left"}, "action of 'vehicle_2' is not numeric"),
        ({**GOOD, "vehicle_2": None}, "action of 'vehicle_2'"),
        ({**GOOD, "vehicel_2": [0.0, 0.0]}, r"unknown agent 'vehicel_2' \(did you mean 'vehicle_2'\?\)"),
        ({agent: GOOD[agent] for agent in ("vehicle_1", "vehicle_2", "vehicle_4")}, "no action for 'vehicle_3'"),
        (np.zeros((4, 2)), "must be a dict"),
    ],
)
def test_wrong_actions_of_a_single_world(env: coopenv.CooperativeLocalisationEnv, actions: Any, message: str) -> None:
    before = env.get_state()
    with pytest.raises(coopenv.ActionError, match=message):
        env.step(actions)
    after = env.get_state()
    assert all(np.array_equal(before[key], after[key]) for key in before)


def test_out_of_range_is_clipped() -> None:
    a, b = coopenv.parallel_env(FOUR_WAY), coopenv.parallel_env(FOUR_WAY)
    a.reset(seed=1)
    b.reset(seed=1)
    far = a.step({agent: np.array([7.0, -9.0]) for agent in a.agents})
    edge = b.step({agent: np.array([1.0, -1.0]) for agent in b.agents})
    assert all(np.array_equal(far[0][agent], edge[0][agent]) for agent in far[0])
