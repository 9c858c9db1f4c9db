"""Wrong actions get one clear line, and nothing moves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from tests.helpers.four_way import FOUR_WAY


@pytest.fixture(scope="module")
def env() -> coopenv.CooperativeLocalisationEnv:
    env = coopenv.parallel_env(FOUR_WAY)
    env.reset(seed=0)
    return env


def good() -> dict[str, Any]:
    return {f"vehicle_{i}": np.zeros(2, dtype=np.float32) for i in range(1, 5)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vehicle_2": [np.nan, 0.0]}, "action of 'vehicle_2' is not finite"),
        ({"vehicle_2": [np.inf, 0.0]}, "action of 'vehicle_2' is not finite"),
        ({"vehicle_2": [0.0, 0.0, 0.0]}, r"action of 'vehicle_2' has shape \(3,\), expected \(2,\)"),
        ({"vehicle_2": 0.5}, r"action of 'vehicle_2' has shape \(\), expected \(2,\)"),
        ({"vehicle_2": "left"}, "action of 'vehicle_2' is not numeric"),
        ({"vehicle_2": None}, "action of 'vehicle_2'"),
        ({"vehicel_2": [0.0, 0.0]}, r"unknown agent 'vehicel_2' \(did you mean 'vehicle_2'\?\)"),
    ],
)
def test_wrong_actions(env: coopenv.CooperativeLocalisationEnv, change: dict[str, Any], message: str) -> None:
    before = env.get_state()
    with pytest.raises(coopenv.ActionError, match=message):
        env.step({**good(), **change})
    after = env.get_state()
    assert all(np.array_equal(before[key], after[key]) for key in before)


def test_missing_action(env: coopenv.CooperativeLocalisationEnv) -> None:
    actions = good()
    del actions["vehicle_3"]
    with pytest.raises(coopenv.ActionError, match="no action for 'vehicle_3'"):
        env.step(actions)


def test_all_at_once_is_not_a_dict(env: coopenv.CooperativeLocalisationEnv) -> None:
    with pytest.raises(coopenv.ActionError, match="must be a dict"):
        env.step(np.zeros((4, 2)))  # type: ignore[arg-type]


def test_step_before_reset() -> None:
    with pytest.raises(coopenv.CoopenvError, match="before reset"):
        coopenv.parallel_env(FOUR_WAY).step(good())


def test_out_of_range_is_clipped() -> None:
    a, b = coopenv.parallel_env(FOUR_WAY), coopenv.parallel_env(FOUR_WAY)
    a.reset(seed=1)
    b.reset(seed=1)
    far = a.step({agent: np.array([7.0, -9.0]) for agent in a.agents})
    edge = b.step({agent: np.array([1.0, -1.0]) for agent in b.agents})
    assert all(np.array_equal(far[0][agent], edge[0][agent]) for agent in far[0])


def test_prescribed_motion_ignores_actions() -> None:
    env = coopenv.parallel_env("busy_intersection")
    runs = []
    for value in (-1.0, 1.0):
        env.reset(seed=2)
        runs.append([env.step({agent: np.full(2, value) for agent in env.agents})[0] for _ in range(5)])
    for a, b in zip(*runs, strict=True):
        assert all(np.array_equal(a[agent], b[agent]) for agent in a)
