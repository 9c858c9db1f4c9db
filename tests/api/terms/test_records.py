"""Values of the built-in fields and reward terms stand at the places of their rows, whatever the order of the rows."""

import importlib.util
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import warp as wp

from coopenv.api.terms import records, results
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS, ROLES
from coopenv.world.referee import COLLIDED


def filled(kind: Any) -> Any:
    """Return a record whose numbers all differ."""
    record = kind()
    for n, (name, field) in enumerate(kind.vars.items()):
        numbers = 1.0 + 0.01 * n + 0.001 * np.arange(np.ravel(getattr(record, name)).size)
        whole = {wp.int32: n + 1, wp.bool: True, wp.float32: float(numbers[0])}
        setattr(record, name, whole[field.type] if field.type in whole else field.type(*numbers.tolist()))
    return record


def values_kernel(records: ModuleType, results: ModuleType) -> wp.Kernel:
    """Return the kernel that computes all values of the modules of records and results."""
    Ego, TruthRecord, Target = records.Ego, records.TruthRecord, records.Target
    Neighbour, MapLandmark = records.Neighbour, records.MapLandmark
    of_vehicle, of_target, of_neighbour = records.vehicle_values, records.target_values, records.neighbour_values
    of_landmark, of_reward = records.landmark_values, results.reward_values

    def compute(
        ego: Ego,
        truth: TruthRecord,
        target: Target,
        neighbour: Neighbour,
        landmark: MapLandmark,
        out: wp.array2d(dtype=wp.float32),
    ):
        write(of_vehicle(ego), out[0])
        write(of_target(target), out[1])
        write(of_neighbour(ego, neighbour, True), out[2])
        write(of_landmark(landmark), out[3])
        write(of_reward(ego, truth), out[4])

    return wp.kernel(compute, module="unique", module_options={"enable_backward": False})


@wp.func
def write(values: Any, out: wp.array(dtype=wp.float32)):
    for k in range(len(values)):
        out[k] = values[k]


def computed(records: ModuleType, results: ModuleType) -> dict[str, list[float]]:
    """Return the entries of every built-in field and reward term, by name, of the same records."""
    ego = filled(records.Ego)
    ego.outcome = int(COLLIDED)
    given = [ego, *map(filled, (records.TruthRecord, records.Target, records.Neighbour, records.MapLandmark))]
    out = wp.zeros((5, 100), dtype=wp.float32, device="cpu")
    wp.launch(values_kernel(records, results), dim=1, inputs=[*given, out], device="cpu")
    of = dict(zip(("vehicle", "target", "neighbour", "landmark"), out.numpy().tolist(), strict=False))
    found = {f"reward.{name}": [float(out.numpy()[4, results.RewardPlace[name]])] for name in REWARD_TERMS.built_in}
    for name, row in OBSERVATION_FIELDS.built_in.items():
        place = records.FieldPlace[name]
        found[name] = of[row.per][place : place + row.size]
    return found


def loaded_again(module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return a module of the same code that is made now, and that stands for the first one in later imports."""
    spec = importlib.util.spec_from_file_location(f"{module.__name__.rpartition('.')[2]}_again", module.__file__)
    assert spec is not None and spec.loader is not None
    again = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, module.__name__, again)
    spec.loader.exec_module(again)
    return again


def test_values_follow_their_rows_to_other_places(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = computed(records, results)
    zero = {name for name, entries in expected.items() if not all(entries)}
    assert zero == {"reward.off_route", "role"}  # every other value is written
    assert expected["role"] == [float(place == 1) for place in range(ROLES)]  # of vehicle 1
    for terms in (OBSERVATION_FIELDS, REWARD_TERMS):
        monkeypatch.setattr(terms, "built_in", dict(reversed(terms.built_in.items())))
    records_of_reversed, results_of_reversed = (loaded_again(module, monkeypatch) for module in (records, results))
    assert records_of_reversed.SOURCES != records.SOURCES
    assert results_of_reversed.RewardPlace.progress != results.RewardPlace.progress
    assert computed(records_of_reversed, results_of_reversed) == expected
