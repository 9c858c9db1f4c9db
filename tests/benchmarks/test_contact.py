"""The benchmark of what measurements between vehicles are worth."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.testing import assert_array_equal

from benchmarks import contact
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record
from tests.helpers.builders import circling, scenario

NEIGHBOURS = [["L1", "vehicle_2"], ["L1", "vehicle_1"], ["L1", "vehicle_1"]]


@cache
def made() -> Recording:
    """Two vehicles measure a landmark and each other; the third one has ranges to vehicles alone."""
    first = {"kind": "range", "name": "marks", "towards": ["landmarks"], "vehicles": ["vehicle_1", "vehicle_2"]}
    sensors = [first, {"kind": "range", "name": "cars", "towards": ["vehicles"]}, {"kind": "position", "rate": 10.0}]
    return record(scenario(circling(NEIGHBOURS), horizon=1.2, sensors=sensors, topology={"acyclic": False}), seed=3)


def test_without_vehicles_only_their_measurements_are_missing() -> None:
    alone = contact.without_vehicles(made()).readings
    assert np.isfinite(made().readings["cars"]).any() and not np.isfinite(alone["cars"]).any()
    for name in ("marks", "position"):
        assert np.isfinite(alone[name]).any()
        assert_array_equal(alone[name], made().readings[name])


def test_errors_count_after_a_second_without_a_measurement_of_the_map() -> None:
    silent = contact.unaided(made(), ["marks", "cars"])
    expected = np.zeros_like(silent)
    expected[made().dt * (1 + np.arange(len(silent))) > contact.SILENT + 1e-9, 2] = True
    assert_array_equal(silent, expected)
    assert not contact.unaided(made(), ["position"]).any()


def test_the_tables_name_observers_bound_and_drivers() -> None:
    found = {"robust": [[0.4, 0.2], [0.6, 0.3]], "bound": [[0.3, 0.1]] * 2}
    text = contact.report("underpass", "keep_contact", 40.0, found)
    assert "| robust | 0.5(1) | 0.25(5) |" in " ".join(text.split())
    assert "| bound |" in text and "| `route_follower` | 32 |" in " ".join(text.split())
