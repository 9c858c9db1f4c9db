"""Odometry, and positions of moving landmarks, at any time between samples."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from coopenv.cars.backend.tracks import KEPT, MOST_SAMPLES, Odometer, PlaceTrack
from coopenv.cars.readings import Twist

NS = 10**9


def integrated(
    samples: list[tuple[int, np.ndarray, np.ndarray]], begin: int, end: int
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate held twists by an adaptive Runge-Kutta method, piece by piece."""
    R, p = np.eye(3), np.zeros(3)
    edges = sorted({begin, end, *(t for t, _, _ in samples if begin < t < end)})
    for a, b in pairwise(edges):
        v, w = next(((v, w) for t, v, w in reversed(samples) if t <= a), (np.zeros(3), np.zeros(3)))
        cross = np.cross(np.eye(3), w)  # y -> w x y

        def rate(_: float, y: np.ndarray, v: np.ndarray = v, cross: np.ndarray = cross) -> np.ndarray:
            R = y[:9].reshape(3, 3)
            return np.concatenate([(R @ cross).ravel(), R @ v])

        y0 = np.concatenate([R.ravel(), p])
        y = solve_ivp(rate, (0.0, (b - a) / NS), y0, rtol=1e-10, atol=1e-12).y[:, -1]
        R, p = y[:9].reshape(3, 3), y[9:]
    return R, p


numbers = st.floats(-2.0, 2.0).map(lambda x: round(x, 3))
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


@given(
    st.lists(st.tuples(st.integers(0, 200), vectors, vectors), min_size=1, max_size=6, unique_by=lambda s: s[0]),
    st.integers(0, 200),
    st.integers(0, 200),
)
def test_held_twists_are_integrated_exactly(rows: list[tuple[int, np.ndarray, np.ndarray]], a: int, b: int) -> None:
    samples = [(t * NS // 1000, v, w) for t, v, w in sorted(rows, key=lambda row: row[0])]
    begin, end = sorted((a * NS // 1000, b * NS // 1000))
    odometer = Odometer()
    for t, v, w in samples:
        odometer.put(t, Twist(v, w))
    odometer.increment(0, begin)
    R, p = odometer.increment(begin, end)
    R_expected, p_expected = integrated(samples, begin, end)
    np.testing.assert_allclose(R, R_expected, atol=1e-8)
    np.testing.assert_allclose(p, p_expected, atol=1e-8)


@given(st.lists(st.integers(1, 20), min_size=2, max_size=8), st.randoms())
def test_the_order_in_which_two_sensors_come_does_not_matter(gaps: list[int], random: object) -> None:
    """Each sensor's samples come in order, but one sensor may come later than the other."""
    wheel = [(t * 7_000_001, Twist(np.array([0.1 * t, 0.0, 0.0]), None)) for t in range(1, len(gaps) + 1)]
    gyro = [(t * 5_000_003, Twist(None, np.array([0.0, 0.0, 0.2 * t]))) for t in range(1, 2 * len(gaps))]
    in_order, one_late = Odometer(), Odometer()
    for stamp, twist in sorted(wheel + gyro, key=lambda sample: sample[0]):
        in_order.put(stamp, twist)
    for stamp, twist in gyro + wheel:
        one_late.put(stamp, twist)
    end = 10**8
    for expected, got in zip(in_order.increment(0, end), one_late.increment(0, end), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_its_age_is_that_of_the_sensor_that_is_older() -> None:
    odometer = Odometer()
    odometer.put(5, Twist(np.ones(3), None))
    assert odometer.stamp is None
    odometer.put(3, Twist(None, np.ones(3)))
    assert odometer.stamp == 3


def test_samples_that_nobody_asks_for_fill_no_memory() -> None:
    odometer = Odometer()
    for k in range(5 * MOST_SAMPLES):
        odometer.put(k, Twist(np.array([float(k), 0.0, 0.0]), np.zeros(3)))
    assert len(odometer._waiting) <= MOST_SAMPLES


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
    for older in (START - 1, START):
        track.put(older, np.array([9.0, 0.0, 0.0]))
    assert track.stamp == START and track.at(START)[0] == 1.0
    track.put(START + 200 * MS, np.array([3.0, 0.0, 0.0]))
    assert track.at(START + 250 * MS)[0] == 3.0  # nothing is said of its speed by positions so far apart
    track = PlaceTrack()
    for k in range(2 * KEPT):
        track.put(START + k * MS, np.array([float(k), 0.0, 0.0]))
    assert track.at(START)[0] == KEPT  # the oldest that is kept
