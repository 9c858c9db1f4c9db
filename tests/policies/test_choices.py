"""Choices above steering: the alphabet, whom a helper serves, and batches whose actions are letters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.vector_env import RecordVehicleEpisodes
from coopenv.base.errors import ActionError, CoopenvError
from coopenv.policies import load_agent
from coopenv.policies.choice_rows import ChoiceRows
from coopenv.policies.choices import KEPT, Choices
from coopenv.scenario import load_scenario
from examples.two_streets.oldest_sight import OldestSight


class Recorded(OldestSight):
    """Keeps the letters of every decision."""

    def __init__(self, scenario: coopenv.Scenario) -> None:
        super().__init__(scenario)
        self.letters: list[np.ndarray] = []

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        driven = super().drive(observations)
        self.letters.append(self.memory(observations)[1].copy())
        return driven


def seen_by_others(name: str) -> dict[str, Any]:
    """Return overrides by which vehicles observe who measures them."""
    return {"observation.include": (*load_scenario(name).observation.include, "seen")}


def batch() -> coopenv.CooperativeVectorEnv:
    overrides = {"horizon": 6.0, **seen_by_others("lighthouse")}
    return coopenv.make_vec("lighthouse", num_worlds=3, autoreset="disabled", overrides=overrides)


def test_without_a_choice_vehicles_follow_their_routes() -> None:
    env = batch()
    drivers = Choices(env.scenario), load_agent("route_follower", env.scenario)
    observations, _ = env.reset(seed=3)
    for _ in range(20):
        mine, other = (driver(observations) for driver in drivers)
        np.testing.assert_array_equal(mine, other)
        observations = env.step(mine)[0]


def test_letters_in_place_of_actions_are_the_same_drive() -> None:
    """What a rule has chosen, as letters, leads to the same observations, rewards and ends, bit for bit."""
    env, rows = batch(), ChoiceRows(batch())
    rule = Recorded(env.scenario)
    observations, _ = env.reset(seed=3)
    mine, _ = rows.reset(seed=3)
    assert rule.kept == round(KEPT * env.scenario.rates.decision) and rows.single_action_space.n == len(rule.alphabet)
    over = False
    while not over:
        earned = np.zeros(env.num_envs)
        for _ in range(rule.kept):
            observations, reward, *_ = env.step(rule(observations))
            earned += reward
        mine, rewards, terminated, truncated, infos = rows.step(rule.letters[-1])
        over = bool((terminated | truncated).all())
        np.testing.assert_array_equal(infos["final_obs"] if over else mine, observations)
        np.testing.assert_allclose(rewards, earned)
    chosen = np.stack(rule.letters)
    assert (chosen[:, 0] >= rule.first_served).any() and (
        chosen[:: rule.kept] == chosen[rule.kept - 1 :: rule.kept]
    ).all()
    assert infos["_final_obs"].all() and not np.array_equal(mine, observations), "a new episode has begun"


def test_a_helper_serves_the_vehicle_that_has_not_measured_it_for_longest() -> None:
    scenario = load_scenario("scout_platoon", seen_by_others("scout_platoon"))
    rule, size = OldestSight(scenario), observation_size(scenario)
    np.testing.assert_array_equal(rule.serves, [[True, True], [False, False], [False, False]])
    observations = np.zeros((3, size), dtype=np.float32)
    layout = rule.layout

    def write(name: str, values: list[float]) -> None:
        observations[0, layout[name].slice] = values

    nobody = rule.choose(observations, np.zeros(3, dtype=int))
    assert nobody.tolist() == [0, 0, 0], "no message is at hand"
    write("message_mask", [1.0, 1.0])
    write("seen_age", [0.2, 0.8])
    first = rule.choose(observations, np.zeros(3, dtype=int))
    assert first.tolist() == [rule.first_served + 1, 0, 0]
    write("seen_age", [0.9, 0.0])
    assert rule.choose(observations, first)[0] == rule.first_served


def test_a_helper_drives_to_a_place_beside_the_way_of_the_vehicle_that_it_serves() -> None:
    """The served vehicle is ahead to the left and drives as the helper does: 3 m aside, and 2 m behind or ahead."""
    scenario = load_scenario("scout_platoon")
    driver = Choices(scenario)
    observations = np.zeros((3, observation_size(scenario)), dtype=np.float32)
    speeds = []
    for along in (-2.0, 0.0, 4.0):
        for name, values in (("message_position", [along, 3.0]), ("message_forward", [1.0, 0.0])):
            field = driver.layout[name]
            entries = np.zeros((2, 2))
            entries[0] = values
            observations[0, field.slice] = (entries / field.scale).ravel()
        observations[0, driver.layout["message_mask"].slice] = [1.0, 0.0]
        letters = np.array([driver.first_served, 0, 0])
        speed, turn = driver.follow(np.concatenate([observations, driver.leaps(observations)], axis=1), letters)
        assert turn[0] > 0.1 and turn[1] == 0.0
        speeds.append(speed[0])
    assert speeds[0] <= speeds[1] <= speeds[2] == pytest.approx(driver.cruise)


def observation_size(scenario: coopenv.Scenario) -> int:
    return Choices(scenario).layout.size


def test_episodes_that_end_within_a_step_are_counted_as_by_single_decisions() -> None:
    """The horizon is no multiple of the time of a choice."""
    options = {"num_worlds": 2, "autoreset": "disabled", "overrides": {"horizon": 10.2}}
    plain, batched = (coopenv.make_vec("lighthouse", **options) for _ in range(2))
    single, rows = RecordVehicleEpisodes(plain), RecordVehicleEpisodes(ChoiceRows(batched))  # type: ignore[arg-type]
    driver, (observations, _) = Choices(plain.scenario), single.reset(seed=4)
    rows.reset(seed=4)
    expected, found = [], []
    for _ in range(102):
        observations, _, _, _, infos = single.step(driver(observations))
        expected += [infos["episode"]] if "episode" in infos else []
    for _ in range(21):
        _, _, terminated, truncated, infos = rows.step(np.zeros(rows.num_envs, dtype=int))
        np.testing.assert_array_equal(infos.get("_final_obs", np.zeros(rows.num_envs)), terminated | truncated)
        found += [infos["episode"]] if "episode" in infos else []
    (mine,), (other,) = found, expected
    np.testing.assert_allclose(mine["r"], other["r"], rtol=1e-6)
    for name, sums in mine["reward_terms"].items():
        np.testing.assert_allclose(sums, other["reward_terms"][name], rtol=1e-6, atol=1e-6, err_msg=name)


def test_mistakes_are_one_line() -> None:
    with pytest.raises(CoopenvError, match=r"ChoiceRows resets worlds itself: make_vec\(autoreset='disabled'"):
        ChoiceRows(coopenv.make_vec("lighthouse", num_worlds=1))
    with pytest.raises(CoopenvError, match="flat observations"):
        ChoiceRows(coopenv.make_vec("lighthouse", num_worlds=1, autoreset="disabled", observation="dict"))
    rows = ChoiceRows(batch())
    with pytest.raises(CoopenvError, match=r"ChoiceRows\.step\(\) called before reset\(\)"):
        rows.step(np.zeros(6, dtype=int))
    rows.reset(seed=0)
    for letters in (np.zeros(6), np.full(6, rows.single_action_space.n), np.zeros(5, dtype=int)):
        with pytest.raises(ActionError, match=r"^expected \(6,\) whole numbers from 0 to \d+, one letter per row$"):
            rows.step(letters)
    with pytest.raises(ValueError, match="the observation lacks message_position"):
        Choices(load_scenario("facade"))
