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
def test_wrong_actions(env: coopenv.CooperativeLocalisationEnv, actions: Any, message: str) -> None:
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
