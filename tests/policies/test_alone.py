"""Who receives nothing drives alone, and a team's policy goes on in all other rows."""

from __future__ import annotations

import numpy as np
import pytest

import coopenv
from coopenv.api.terms.layout import observation_layout
from coopenv.policies import load_agent
from coopenv.policies.alone import PATIENCE, Alone

ENV = "lighthouse"


def test_rows_without_a_message_in_the_first_second_are_driven_by_the_other_agent() -> None:
    scenario = coopenv.load_scenario(ENV)
    layout, alone, other = (
        observation_layout(scenario),
        Alone(scenario, "route_follower"),
        load_agent("route_follower", scenario),
    )
    rows, rng = 4, np.random.default_rng(3)
    team = rng.uniform(-1.0, 1.0, (rows, 2))
    patience = round(PATIENCE * scenario.rates.decision)
    for decision in range(1, 3 * patience):
        seen = rng.uniform(-0.5, 0.5, (rows, layout.size)).astype(np.float32)
        seen[:, layout["message_mask"].start] = [0.0, decision == patience, 0.0, decision == patience + 1]
        if decision == 2 * patience:
            alone.reset(np.array([True, False, False, False]))
        found, expected = alone(seen, team), other(seen)
        drives = [patience < decision < 2 * patience, False, decision > patience, False]
        np.testing.assert_allclose(found, np.where(np.array(drives)[:, None], expected, team))


def test_without_messages_in_the_observation_there_is_no_alone() -> None:
    scenario = coopenv.load_scenario(ENV, {"observation.exclude": ["messages"]})
    with pytest.raises(ValueError, match="lacks message_mask"):
        Alone(scenario, "route_follower")


def test_the_other_agent_begins_where_a_vehicle_becomes_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it remembers of a vehicle does not depend on when others became alone; it drives all vehicles by name."""
    scenario, begun = coopenv.load_scenario(ENV), list[list[bool]]()

    class Other:
        def reset(self, mask: np.ndarray) -> None:
            begun.append(mask.tolist())

        def __call__(self, observations: np.ndarray) -> np.ndarray:
            return np.ones((len(observations), 2))

    monkeypatch.setattr("coopenv.policies.alone.load_agent", lambda name, scenario: Other())
    alone = Alone(scenario, "peek")
    assert alone.agents == list(scenario.vehicle_names)
    seen = np.zeros((2, observation_layout(scenario).size), dtype=np.float32)
    patience = round(PATIENCE * scenario.rates.decision)
    for decision in range(1, 2 * patience):
        if decision == 4:
            alone.reset(np.array([False, True]))
        drives = alone(seen, np.zeros((2, 2)))[:, 0]
        assert drives.tolist() == [decision > patience, decision > patience + 3]
    assert begun == [[True, True], [False, True], [True, False], [False, True]]
