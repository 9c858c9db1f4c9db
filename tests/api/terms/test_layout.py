"""The meaning of observations and actions, as an agent's card states it."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.api.terms.layout import action_fields, observation_layout, observation_space, settings_of_meaning
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.four_way import FOUR_WAY

OWN = {
    "dynamics.max_speed": 1.0,
    "dynamics.max_steering": 0.3,
    "vehicles.0.dynamics": {"max_speed": 1.5, "max_steering": 0.4, "reverse": True, "max_acceleration": 2.5},
    "vehicles.1.dynamics": {"max_speed": 0.5},
    "action.steering": None,
    "rates.decision": 6.0,
    "rates.camera": 30.0,
}


def scenario(**changes: object) -> Scenario:
    return load_scenario(FOUR_WAY, {**OWN, **changes})


@pytest.mark.parametrize(
    ("fields", "more"),
    [
        ([], {}),
        (["goal_position"], {}),
        (["gramian_min_eigenvalue"], {"observer.gramian_window": 3.0}),
        (["route_ahead"], {"observation.route_step": 0.75}),
        (["message_clearance"], {"observation.route_step": 0.75}),
        (["soft_observability"], {"observer.gramian_window": 3.0, "reward.observability_floor": 0.125}),
    ],
)
def test_settings_of_meaning_are_the_first_vehicles(fields: list[str], more: dict[str, float]) -> None:
    changed = scenario(
        **{
            "observer.gramian_window": 3.0,
            "observation.route_step": 0.75,
            "reward.observability_floor": 0.125,
        }
    )
    assert settings_of_meaning(changed, fields) == {"rates.decision": 6.0, "dynamics.max_speed": 1.5, **more}


def test_a_setting_that_is_set_is_among_them() -> None:
    changed = scenario(**{"observer.gramian_distance": 4.0})
    assert settings_of_meaning(changed, ["gramian_min_eigenvalue"])["observer.gramian_distance"] == 4.0


def test_actions_span_the_limits_of_each_vehicle() -> None:
    found = scenario(**{"action.longitudinal": "speed"})
    spans = [[(a.name, a.low, a.high) for a in own] for own in observation_layout(found).actions[:3]]
    assert spans == [
        [("speed", -1.5, 1.5), ("steering", -0.4, 0.4)],
        [("speed", 0.0, 0.5), ("steering", -0.3, 0.3)],
        [("speed", 0.0, 1.0), ("steering", -0.3, 0.3)],
    ]
    speed, steering = action_fields(found)
    assert (speed.low, speed.high, steering.high) == (-1.5, 1.5, 0.4)
    assert speed.level(0.75) == 0.5 and steering.level(-0.2) == -0.5
    first, *rest = action_fields(scenario(**{"action.longitudinal": "acceleration", "action.radio": True}))
    assert (first.name, first.low, first.high) == ("acceleration", -2.5, 2.5)
    assert [field.name for field in rest] == ["steering", "radio_1", "radio_2", "radio_3"]
    *_, pan = action_fields(scenario(**{"action.pan": {"limit": 0.75, "rate": 1.0}}))
    assert (pan.name, pan.low, pan.high) == ("pan", -0.75, 0.75)


def test_fields_follow_one_another_and_values_have_their_units() -> None:
    layout = observation_layout(scenario(**{"observation.centers": {"velocity": 0.25}}))
    start = 0
    for field in layout.values():
        assert field.start == start < field.stop
        start = field.stop
    assert layout.size == start and layout.copy() == layout and layout.copy() is not layout
    assert layout["estimate_position"].group == "estimate"
    field, rows = layout["estimate_position"], np.zeros((2, 5, layout.size))
    rows[1, 4, field.slice] = 0.5
    values = field.values(rows)
    assert values.shape == (2, 5, 3) and values[1, 4].tolist() == [0.5 * field.scale] * 3 and not values[0].any()
    flat, parts = observation_space(layout), observation_space(layout, "dict")
    assert flat.shape == (start,) and (flat.high == 1.0).all()  # type: ignore[attr-defined]
    for name, field in layout.items():
        box = parts[name]  # type: ignore[index]
        assert (box.high == 1.0).all() and (box.low == field.low).all() and box.shape == (field.stop - field.start,)
        assert (flat.low[field.slice] == field.low).all()  # type: ignore[attr-defined]


@pytest.mark.parametrize(("pan", "entries"), [(None, 2), ({"limit": 0.75, "rate": 1.0}, 3)])
def test_the_last_action_has_an_entry_per_field_of_an_action(pan: object, entries: int) -> None:
    layout = observation_layout(scenario(**{"action.pan": pan, "observation.include": ["last_action"]}))
    assert [*layout] == ["last_action"] and layout.size == entries == len(layout.action)
