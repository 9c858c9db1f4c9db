"""Rewards: functions of one's own, the terms of shipped environments, and scales of observations."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv.api.arguments import FIELDS, OTHERS, Step, check_function
from coopenv.base.errors import CoopenvError
from coopenv.policies import load_agent
from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import load_scenario
from sitegen.environments.sensing import DRIVERS, measured_drivers
from tests.helpers.env_suite import SHIPPED, largest_slow
from tests.helpers.four_way import FOUR_WAY

SHORT = {"horizon": 0.5, "observation.include": ["estimate", "quality"]}


def minus_error(step: Step) -> Any:
    return -step["position_error"]


def test_a_function_replaces_the_reward_of_one_world_alone() -> None:
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
def test_vehicles_under_way_earn_the_value_of_the_function(autoreset: str, dtype: str) -> None:
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
    rows = gymnasium.make_vec("coopenv/UrbanCrossingRows-v0", num_envs=4, reward=reward)
    rows.reset(seed=0)
    assert (rows.step(np.zeros((4, 2), np.float32))[1] == 7.0).all()


def test_a_step_has_the_infos_of_all_vehicles() -> None:
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


def test_a_step_is_read_only() -> None:
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
        (lambda step: step["positon_error"], "a step has no 'positon_error' .did you mean 'position_error'.*known"),
        (lambda step: step["position_error"][0], r"returned shape \(4,\) .* expected numbers of shape \(2, 4\)"),
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


def test_objects_that_are_no_functions_and_devices_without_arrays_are_refused() -> None:
    with pytest.raises(CoopenvError, match="reward: expected a function of a step, got 'mine'"):
        coopenv.parallel_env("crossing_path", reward="mine")  # type: ignore[arg-type]
    check_function(None, "cuda:0")
    with pytest.raises(CoopenvError, match="runs on the host; use device='cpu' instead of 'cuda:0'"):
        check_function(minus_error, "cuda:0")


ENVIRONMENTS = [
    name
    for name, s in SHIPPED.items()
    if s.driven and s.backend == "simulated" and s.observer.name == "robust" and measured_drivers(name) == DRIVERS
]
"""Not the laboratory's experiments: hardly anything varies in them, which are there to be driven by cars."""
EXCEPTIONS = {
    "behind_truck": {
        "message_position": "the truck, which alone is heard, is always straight ahead",
        "message_forward": "and goes the same way as the car",
    },
    "facade": {"map_in_view": "the nearest landmark stands beside the car, out of its camera's view"},
    "large_crossing": {"map_in_view": "the nearest landmarks stand beside the car, out of its camera's view"},
    "urban_crossing": {"map_in_view": "the nearest landmarks stand beside the car, out of its camera's view"},
}
"""Fields with an entry that hardly varies, and why it is there."""
TIMES = {"behind_truck": 6}  # as many worlds


class Run(NamedTuple):
    """Results of one driver; arrays have a row for every step of a vehicle that is under way."""

    observations: np.ndarray
    position_error: np.ndarray
    uncertainty: np.ndarray
    """The reward term."""
    drives_on: np.ndarray
    """True if the step gains at least 2 cm of the way and does not end the episode."""
    total: float
    """Mean return of a vehicle."""
    layout: Any


def drivers(scenario: Any) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    follow, slow = RouteFollower(scenario), RouteFollower(scenario, cruise=0.6)
    step, turn = iter(range(10**6)), np.zeros(len(follow.layout.action))
    turn[1] = 0.6
    return {
        "follow": follow,
        "slow": slow,
        "peek": load_agent("peek", scenario),
        "look around": lambda seen: np.clip(follow(seen) + turn * np.sin(0.3 * next(step)), -1.0, 1.0),
        "stand": lambda seen: np.tile(np.append([-1.0], np.zeros(len(turn) - 1)), (len(seen), 1)),
    }


@cache
def run(name: str, driver: str, times: int = 1) -> Run:
    """Drive 32 vehicles, in 16 worlds at most, or `times` as many."""
    worlds = times * min(16, 32 // len(SHIPPED[name].vehicles))
    envs = coopenv.make_vec(name, num_worlds=worlds, autoreset="disabled")
    engine, policy = envs.engine, drivers(envs.scenario)[driver]
    term = engine.reward_terms.index("position_uncertainty")
    observations, _ = envs.reset(seed=3)
    rows, errors, terms, drives, total = [observations], [], [], [], 0.0
    way = engine.view("furthest").copy()
    while not engine.view("over").all():
        observations = envs.step(policy(observations))[0]
        alive = engine.view("alive").copy()
        gained, way = engine.view("furthest") - way, engine.view("furthest").copy()
        on = (gained > 0.02) & ~engine.view("terminated") & ~engine.view("truncated")
        rows.append(observations[alive.ravel()])
        errors.append(engine.view("position_error")[alive])
        terms.append(engine.view("terms")[..., term][alive])
        drives.append(on[alive])
        total += float(engine.view("reward")[alive].sum())
    joined = [np.concatenate(parts) for parts in (rows, errors, terms, drives)]
    return Run(*joined, total / alive.size, envs.observation_layout)


@pytest.mark.parametrize("name", largest_slow(ENVIRONMENTS))
def test_scales_give_every_entry_a_deviation_between_a_tenth_and_one(name: str) -> None:
    runs = [run(name, driver) for driver in ("follow", "slow", "look around", "peek")]
    entries = np.concatenate([each.observations for each in runs])
    deviations = entries.std(axis=0)
    assert deviations.max() <= 1.0
    least = {title: deviations[field.slice].min() for title, field in runs[0].layout.items()}
    exceptions = EXCEPTIONS.get(name, {})
    assert not [title for title, std in least.items() if std < 0.1 and title not in exceptions]
    assert not [title for title in exceptions if least[title] > 0.12], "an exception without its reason"


@pytest.mark.parametrize("name", largest_slow(ENVIRONMENTS, *TIMES))
def test_the_price_of_uncertainty_goes_with_the_true_error(name: str) -> None:
    """Pearson over the steps in which a vehicle drives on, of all vehicles and worlds under one driver.

    Steps of a world are much alike: of 24 worlds of `behind_truck` it is 0.4 to 0.5, of 192 it is 0.68.
    """
    for driver in ("follow", "look around"):
        found = run(name, driver, times=TIMES.get(name, 1))
        price, error = -found.uncertainty[found.drives_on], found.position_error[found.drives_on]
        assert np.corrcoef(price, error)[0, 1] >= 0.5, driver


@pytest.mark.parametrize("name", largest_slow(ENVIRONMENTS))
def test_standing_still_earns_least(name: str) -> None:
    """Of those who stay on the road: who leaves it at full lock has an end of its own, and pays for that."""
    still = run(name, "stand").total
    assert all(run(name, driver).total > still for driver in ("follow", "slow", "look around"))


@cache
def returns_of(team: str, own_share: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rewards, flags of termination and of being alive, (steps, 2, 4), of worlds that `peek` drives."""
    scenario = load_scenario("open_square", {"reward.team": team, "reward.own_share": own_share, "horizon": 30.0})
    env = coopenv.make_vec(scenario, num_worlds=2, autoreset="disabled")
    policy, (observation, _) = load_agent("peek", scenario), env.reset(seed=1)
    steps = []
    for _ in range(300):
        actions = policy(observation).astype(np.float32)
        observation, reward, terminated, truncated, infos = env.step(actions)
        steps.append((reward, terminated, infos["alive"]))
        if (terminated | truncated).reshape(2, 4).any(axis=1).all() and team != "own":
            break
    env.close()
    return tuple(np.array(part).reshape(-1, 2, 4) for part in zip(*steps, strict=True))  # type: ignore[return-value]


@pytest.mark.parametrize("team", ["mean", "min"])
def test_a_team_has_one_reward_and_one_end(team: str) -> None:
    own, _, under_way = returns_of("own")
    shared, terminated, alive = returns_of(team)
    count = len(shared)
    assert (shared == shared[..., :1]).all() and (terminated == terminated[..., :1]).all()
    wanted = own[:count].mean(axis=-1)
    if team == "min":
        wanted = np.min(own[:count], axis=-1, where=under_way[:count] == 1, initial=np.inf)
        wanted = np.where(np.isinf(wanted), 0.0, wanted)
    np.testing.assert_allclose(shared[..., 0], wanted, atol=1e-5)
    last = np.argmax(terminated[..., 0], axis=0)
    assert terminated[..., 0].sum() == 2 and (under_way[last, np.arange(2)].sum(axis=-1) >= 1).all()
    assert not under_way[count:].any() and (alive.sum(axis=0) == last[:, None] + 1).all()


def test_a_share_of_the_reward_is_the_vehicles_own() -> None:
    (own, *_), (team, *_), (mixed, *_) = returns_of("own"), returns_of("mean"), returns_of("mean", 0.25)
    np.testing.assert_allclose(mixed, 0.25 * own[: len(mixed)] + 0.75 * team, atol=1e-5)


def test_a_team_shares_the_rewards_of_a_function() -> None:
    changes = {"reward.team": "mean", "reward.own_share": 0.5}
    env = coopenv.parallel_env(FOUR_WAY, overrides=changes, reward=lambda step: np.array([[1.0, 2.0, 3.0, 6.0]]))
    env.reset(seed=0)
    rewards = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})[1]
    assert list(rewards.values()) == [2.0, 2.5, 3.0, 4.5]


def test_a_team_reward_needs_a_team() -> None:
    with pytest.raises(coopenv.CoopenvError, match=r"reward\.own_share: only with reward\.team = 'mean' or 'min'"):
        load_scenario("open_square", {"reward.own_share": 0.5})
    with pytest.raises(coopenv.CoopenvError, match=r"reward\.team: 'mean' needs at least two driven vehicles, got 1"):
        load_scenario("facade", {"reward.team": "mean"})
