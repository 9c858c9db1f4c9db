"""What planar robots tell of whom they saw, as it is read."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.observers.planar.fusion import LEAST_STD, MOST_SEEN, sightings_of

TOLD = {
    "seen": np.array([15, 17], np.uint8),
    "bearing": np.array([0.25, -0.5], np.float32),
    "from": np.array([1, 2, 0.5, 0.04, 0, 0.09, 0, 0, 0.01], np.float32),
    "sure": np.array([1], np.uint8),
}


def test_sightings_are_read():
    told = sightings_of(TOLD)
    assert told is not None and told.sure and told.seen == [(15, 0.25), (17, -0.5)]
    np.testing.assert_allclose(told.by.pose, [1, 2, 0.5])
    added = np.square([LEAST_STD[0], *LEAST_STD])
    np.testing.assert_allclose(told.by.covariance, np.diag(np.add(added, (0.04, 0.09, 0.01))), rtol=1e-6)


@pytest.mark.parametrize("sure", [None, np.array([0], np.uint8), np.ones(2, np.uint8), np.array(1, np.uint8)])
def test_who_does_not_say_so_is_not_sure(sure):
    told = sightings_of({name: value for name, value in {**TOLD, "sure": sure}.items() if value is not None})
    assert told is not None and not told.sure and len(told.seen) == 2


@pytest.mark.parametrize(
    "field",
    [
        {"seen": np.array([[15, 17]], np.uint8)},
        {"seen": np.array([[15], None], dtype=object)},
        {"seen": np.full(MOST_SEEN + 1, 15, np.uint8), "bearing": np.zeros(MOST_SEEN + 1, np.float32)},
        {"bearing": np.array([0.25, np.inf], np.float32)},
        {"bearing": np.array(["a", "b"])},
        {"bearing": np.array([1j, 0])},
        {"from": TOLD["from"][:4]},
        {"from": -TOLD["from"]},
        {"from": np.full(9, "x")},
        {"sure": np.array([None], dtype=object)},
    ],
)
def test_what_makes_no_sense_is_left_out(field):
    assert sightings_of({**TOLD, **field}) is None
