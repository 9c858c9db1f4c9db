"""Positions of a moving landmark at the times of frames."""

from __future__ import annotations

import numpy as np

from coopenv.cars.backend.tracks import KEPT, PlaceTrack

MS = 1_000_000
START = 1_700_000_000 * 1_000_000_000
"""ns: a wall clock's numbers, at which float64 no longer tells nanoseconds apart."""


def test_it_is_on_the_straight_line_and_goes_on_for_a_tenth_of_a_second() -> None:
    track = PlaceTrack()
    assert track.stamp < 0
    for k in range(5):
        track.put(START + 16 * k * MS, np.array([0.26 * 0.016 * k, 1.45, 0.0]))
    np.testing.assert_allclose(track.at(START + 24 * MS), [0.26 * 0.024, 1.45, 0.0], atol=1e-12)
    np.testing.assert_allclose(track.at(START + 80 * MS), [0.26 * 0.080, 1.45, 0.0], atol=1e-12)
    np.testing.assert_allclose(track.at(START + 1000 * MS), [0.26 * 0.164, 1.45, 0.0], atol=1e-12)
    np.testing.assert_allclose(track.at(START - 1000 * MS), [0.0, 1.45, 0.0], atol=1e-12)


def test_what_is_old_or_out_of_order_does_not_count() -> None:
    track = PlaceTrack()
    track.put(START, np.array([1.0, 0.0, 0.0]))
    assert not track.put(START - 1, np.array([9.0, 0.0, 0.0]))
    assert not track.put(START, np.array([9.0, 0.0, 0.0]))
    assert track.stamp == START and track.at(START)[0] == 1.0
    track.put(START + 200 * MS, np.array([3.0, 0.0, 0.0]))
    assert track.at(START + 250 * MS)[0] == 3.0  # nothing is said of its speed by positions so far apart
    track = PlaceTrack()
    for k in range(2 * KEPT):
        track.put(START + k * MS, np.array([float(k), 0.0, 0.0]))
    assert track.at(START)[0] == KEPT  # the oldest that is kept
