"""Fields of the observation about sensors beside the camera, and an environment with a user's own sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.measurements.table import KINDS
from coopenv.scenario import Scenario
from tests.helpers.builders import circling, scenario

DOPPLER = "tests.helpers.doppler:Doppler"
OTHERS = [["L1", "L2", "vehicle_2"], ["L1", "vehicle_1", "vehicle_3"], ["L3", "vehicle_1"]]


def described(*include: str, **sections: Any) -> Scenario:
    """Return three vehicles on circles with every shipped kind, and a user's, of a lower rate."""
    sensors = [{"kind": kind, "towards": ["landmarks", "vehicles"], "rate": 20.0} for kind in KINDS]
    given = {"sensors": [*sensors, {"kind": DOPPLER, "rate": 20.0}], "topology": {"acyclic": False}}
    observation = {"include": list(include or ("readings",)), "age_scale": 10.0}
    return scenario(circling(OTHERS), horizon=1.0, observation=observation, **{**given, **sections})


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_fields_hold_the_last_measurement_of_every_sensor(dtype: str) -> None:
    description = described()
    engine = Engine(description, 2, dtype)
    engine.reset([1, 2])
    layout, actions = observation_layout(description), np.zeros((2, 3, 2))
    last: dict[str, tuple[Any, Any]] = {}
    for step in range(4):
        k = step * description.ticks_per_decision
        for name, values in engine.world.sensed(1, k).readings.items():  # type: ignore[attr-defined]
            then, before = last.get(name, (np.full(values.shape[:2], -1), np.zeros(values.shape)))
            fresh = np.isfinite(values).all(axis=-1)
            last[name] = np.where(fresh, k, then), np.where(fresh[..., None], values, before)
            assert_fields(layout, engine.view("observation")[1], name, *last[name], k, description)
        engine.step(actions)


def assert_fields(layout: Any, seen: Any, name: str, then: Any, values: Any, k: int, description: Scenario) -> None:
    shown = {part: field.values(seen) for part, field in layout.items() if part.startswith(f"reading_{name}")}
    shown = {part.removeprefix(f"reading_{name}"): found for part, found in shown.items()}
    shown.pop("_bearing", None)
    mask, age = shown["_mask"].reshape(then.shape), shown["_age"].reshape(then.shape)
    assert_allclose(mask, then == k)
    assert_allclose(age, np.where(then < 0, 10.0, (k - then) / description.rates.camera), atol=1e-5)
    parts = [found.reshape(*then.shape, -1) for part, found in shown.items() if part not in ("_mask", "_age")]
    if name == "range":  # whose fields begin as those of range_bearing do
        parts = parts[:1]
    assert_allclose(np.concatenate(parts, axis=-1), values, atol=1e-4)


def test_parts_of_a_value_with_several_units_are_fields_of_their_own() -> None:
    layout = observation_layout(described())
    fields = {name: (field.unit, field.shape) for name, field in layout.items() if name.startswith("reading_r")}
    assert fields["reading_range_bearing_direction"] == ("1", (7, 3))
    assert fields["reading_range_bearing_distance"] == ("m", (7,))
    assert fields["reading_relative_pose_turn"] == ("rad", (7, 3))
    assert layout["reading_position"].shape == (3,)
    assert all(field.group == "readings" for field in layout.values())


def test_single_fields_of_a_sensor_may_be_named_and_scaled() -> None:
    description = described("estimate", "reading_range_mask", "reading_range")
    layout = observation_layout(description)
    assert {name for name in layout if name.startswith("reading")} == {"reading_range", "reading_range_mask"}
    assert layout["reading_range"].scale == description.observation.position_scale


def test_a_field_of_a_sensor_that_is_not_there_is_refused() -> None:
    with pytest.raises(CoopenvError, match="observation field 'reading_sonar' is not registered"):
        observation_layout(described("reading_sonar"))


def test_readings_without_sensors_add_nothing() -> None:
    layouts = [
        observation_layout(described(*include, sensors=[])) for include in (["estimate", "readings"], ["estimate"])
    ]
    assert layouts[0] == layouts[1]


def test_a_users_sensor_is_measured_in_a_parallel_environment() -> None:
    env = coopenv.parallel_env(described("readings", "odometry"), observer="mekf")
    observations, _ = env.reset(seed=3)
    place = observation_layout(described("readings", "odometry"))["reading_doppler_mask"]
    first = np.array([place.values(observations[agent]) for agent in env.possible_agents])
    assert first.sum() > 4
    for _ in range(3):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    env.close()
