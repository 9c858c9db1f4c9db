"""A reward that is a function in Python, on every face."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv.api.arguments import FIELDS, OTHERS, Step, check_function
from coopenv.base.errors import CoopenvError
from tests.helpers.four_way import FOUR_WAY

SHORT = {"horizon": 0.5, "observation.include": ["estimate", "quality"]}


def minus_error(step: Step) -> Any:
    return -step["position_error"]


def test_it_replaces_the_reward_of_one_world_and_only_that() -> None:
    plain = coopenv.parallel_env(FOUR_WAY, overrides=SHORT)
    own = pickle.loads(pickle.dumps(coopenv.parallel_env(FOUR_WAY, overrides=SHORT, reward=minus_error)))
    starts = [env.reset(seed=2) for env in (plain, own)]
    assert_allclose(starts[0][0]["vehicle_1"], starts[1][0]["vehicle_1"])
    while plain.agents:
        actions = {agent: np.full(2, 0.5, np.float32) for agent in plain.agents}
        (seen, rewards, *flags, infos), other = plain.step(actions), own.step(actions)
        assert all(np.array_equal(seen[agent], other[0][agent]) for agent in seen)
        assert flags == list(other[2:4])
        assert rewards != other[1] == {a: pytest.approx(-info["position_error"]) for a, info in infos.items()}
        assert infos["vehicle_1"]["reward_terms"] == other[4]["vehicle_1"]["reward_terms"]


@pytest.mark.parametrize("autoreset", ["next_step", "same_step", "disabled"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_batch_earns_what_the_function_says_where_it_is_alive(autoreset: str, dtype: str) -> None:
    calls = []

    def reward(step: Step) -> np.ndarray:
        calls.append(step["time"][:, 0].tolist())
        assert step["truth"]["position"].dtype == dtype
        return 1.0 + step["time"] + 0.0 * step["position_error"]

    envs = coopenv.make_vec(FOUR_WAY, num_worlds=2, dtype=dtype, autoreset=autoreset, overrides=SHORT, reward=reward)
    envs.reset(seed=0)
    earned = []
    for _ in range(7 if autoreset != "disabled" else 5):
        rewards = envs.step(np.zeros(envs.action_space.shape, np.float32))[1]
        assert rewards.dtype == np.float32
        earned.append(float(rewards[0]))
    through = [1.1, 1.2, 1.3, 1.4, 1.5]
    expected = {"next_step": [*through, 0.0, 1.1], "same_step": [*through, 1.1, 1.2], "disabled": through}
    assert earned == pytest.approx(expected[autoreset])
    assert len(calls) == len(earned)  # once in a step, in none for a reset


def test_vehicles_that_have_ended_earn_nothing() -> None:
    """All but the first touch their goals at once."""
    goals = {f"vehicles.{i}.goal.radius": 1000.0 for i in (1, 2, 3)}
    envs = coopenv.make_vec(FOUR_WAY, num_worlds=1, overrides=goals, reward=lambda step: 3.0 + step["ended"])
    envs.reset(seed=0)
    earned = [envs.step(np.zeros(envs.action_space.shape, np.float32))[1].tolist() for _ in range(2)]
    assert earned == [[3.0, 4.0, 4.0, 4.0], [3.0, 0.0, 0.0, 0.0]]


def test_gymnasium_hands_it_on() -> None:
    def reward(step: Step) -> np.ndarray:
        return np.full(step["alive"].shape, 7.0)

    one = gymnasium.make("coopenv/UrbanCrossing-v0", reward=reward)
    one.reset(seed=0)
    assert one.step(np.zeros(2, np.float32))[1] == 7.0
    rows = gymnasium.make_vec("coopenv/UrbanCrossing-v0", num_envs=4, reward=reward)
    rows.reset(seed=0)
    assert (rows.step(np.zeros((4, 2), np.float32))[1] == 7.0).all()


def test_a_step_is_the_infos_of_everybody() -> None:
    steps: list[dict[str, Any]] = []

    def keep(step: Step) -> np.ndarray:
        steps.append({name: step[name] for name in step})
        assert set(step) == {*FIELDS, *OTHERS} and "time" in step and "tmie" not in step
        return np.zeros(step["alive"].shape)

    env = coopenv.parallel_env(FOUR_WAY, dtype="float64", reward=keep)
    env.reset(seed=0)
    actions = {agent: np.array([0.25, -2.0]) for agent in env.agents}
    observations, _, _, _, infos = env.step(actions)
    (step,) = steps
    for i, (agent, info) in enumerate(infos.items()):
        for name in ("position_error", "orientation_error", "nees", "log_determinant", "gramian_min_eigenvalue"):
            assert step[name][0, i] == info[name]
        for part in ("truth", "estimate"):
            assert all(np.array_equal(step[part][key][0, i], value) for key, value in info[part].items())
        assert {name: values[0, i] for name, values in step["reward_terms"].items()} == info["reward_terms"]
        visible = [name for name, seen in zip(env.scenario.target_names, step["visible"][0, i], strict=True) if seen]
        assert tuple(visible) == info["visible"] and step["targets_in_view"][0, i] == len(visible)
        assert step["time"][0, 0] == info["time"] and step["ended"][0, i] == 0
        assert np.array_equal(step["observation"][0, i], observations[agent])
        assert step["action"][0, i].tolist() == [0.25, -1.0]


def test_nobody_writes_into_the_world() -> None:
    def careless(step: Step) -> np.ndarray:
        error: np.ndarray = step["position_error"]
        error *= -1.0
        return error

    envs = coopenv.make_vec("crossing_path", num_worlds=1, reward=careless)
    envs.reset(seed=0)
    with pytest.raises(CoopenvError, match=r"reward function careless: ValueError: .*read-only"):
        envs.step(np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (
            lambda step: step["positon_error"],
            "a step has no 'positon_error' .did you mean 'position_error'.*known: obs",
        ),
        (
            lambda step: step["position_error"][0],
            r"returned shape \(4,\) .* expected numbers of shape \(2, 4\), worlds x",
        ),
        (lambda step: 1.0, r"returned shape \(\)"),
        (lambda step: None, "returned shape .* and dtype object"),
        (lambda step: np.full((2, 4), "a"), "and dtype <U1"),
        (lambda step: step["position_error"] * np.nan, "nan for vehicle_1 of world 0, expected a number"),
        (lambda step: 1.0 / (step["time"] * 0.0) + step["alive"], "inf for vehicle_1 of world 0"),
        (lambda: 1.0, "TypeError: .* takes 0 positional arguments"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_mistakes_are_one_line(reward: Any, message: str) -> None:
    envs = coopenv.make_vec(FOUR_WAY, num_worlds=2, reward=reward)
    envs.reset(seed=0)
    with pytest.raises(CoopenvError, match=f"reward function <lambda>: .*{message}") as caught:
        envs.step(np.zeros(envs.action_space.shape, np.float32))
    assert str(caught.value).isprintable()


def test_what_is_no_function_is_refused_and_a_gpu_has_no_arrays_for_one() -> None:
    with pytest.raises(CoopenvError, match="reward: expected a function of a step, got 'mine'"):
        coopenv.parallel_env("crossing_path", reward="mine")  # type: ignore[arg-type]
    check_function(None, "cuda:0")
    with pytest.raises(CoopenvError, match="runs on the host; use device='cpu' instead of 'cuda:0'"):
        check_function(minus_error, "cuda:0")
