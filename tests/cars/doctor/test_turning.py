"""Turn rates that never change, beside what a path in the plane shows: exact bearings, headings and commands."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coopenv.cars.doctor.turning import constant_turn_rate
from coopenv.estimation.poses import Array

WHEELBASE = 0.324
TIMES = np.arange(0.0, 10.0, 1.0 / 60.0)


def drive(speed: float, turn: Array, landmarks: Array) -> tuple[dict[str, Any], tuple[Array, Array, Array]]:
    """Return the tracks of a car that starts at the origin, its turn rate (n,) unmeasured, and its sightings."""
    dt = TIMES[1]
    heading = np.concatenate([[0.0], np.cumsum(turn[:-1]) * dt])
    place = np.concatenate([[0.0], np.cumsum(speed * np.exp(1j * (heading + 0.5 * turn * dt))[:-1]) * dt])
    ahead = (landmarks[:, 0] + 1j * landmarks[:, 1] - place[:, None]) * np.exp(-1j * heading[:, None])
    seen = np.abs(np.angle(ahead)) < 1.0
    when, which = np.nonzero(seen)
    wheel = np.full(len(TIMES), complex(speed))
    steering = np.arctan(WHEELBASE * turn / speed) if speed else np.zeros(len(TIMES))
    tracks = {"gyro_time": TIMES, "gyro": np.zeros(len(TIMES)), "wheel_time": TIMES, "wheel": wheel}
    tracks |= {"truth_time": TIMES, "truth_yaw": np.angle(np.exp(1j * heading))}
    tracks |= {"command_time": TIMES, "command_speed": wheel.real, "command_steering": steering}
    return tracks, (TIMES[when], np.angle(ahead)[seen], landmarks[which])


def without(tracks: dict[str, Any], *names: str) -> dict[str, Any]:
    return {key: value[:0] if key.split("_")[0] in names else value for key, value in tracks.items()}


AROUND = np.array([(6.0 * np.cos(a), 6.0 * np.sin(a)) for a in np.arange(8) * np.pi / 4])
CURVE = np.where(np.sin(TIMES) > 0.0, 0.5, -0.5)


def test_each_witness_of_a_turn_is_named() -> None:
    tracks, seen = drive(0.4, CURVE, AROUND)
    nothing = tuple(part[:0] for part in seen)
    truth = constant_turn_rate(without(tracks, "command"), nothing, WHEELBASE)  # type: ignore[arg-type]
    assert truth == f"is 0 rad/s in all {len(TIMES)} messages, while motion capture turns it by 89 deg"
    commands = constant_turn_rate(without(tracks, "truth"), nothing, WHEELBASE)  # type: ignore[arg-type]
    assert commands is not None and commands.endswith("while commands turn it by 90 deg")
    bearings = constant_turn_rate(without(tracks, "truth", "command"), seen, WHEELBASE)
    assert bearings is not None and "while bearings turn it by" in bearings


@pytest.mark.parametrize("speed", [0.4, -0.4, 0.0])
def test_a_turn_rate_that_changes_contradicts_nothing(speed: float) -> None:
    tracks, seen = drive(speed, CURVE, AROUND)
    assert constant_turn_rate(tracks | {"gyro": CURVE}, seen, WHEELBASE) is None
    assert constant_turn_rate(tracks, seen, WHEELBASE) is not None


def test_a_stuck_turn_rate_is_named_and_a_circle_contradicts_nothing() -> None:
    circle = np.full(len(TIMES), 0.3)
    tracks, seen = drive(0.4, circle, AROUND)
    assert constant_turn_rate(tracks | {"gyro": circle}, seen, WHEELBASE) is None
    stuck = constant_turn_rate(tracks | {"gyro": -circle}, seen, WHEELBASE)
    assert stuck is not None and stuck.startswith("is -0.3 rad/s in all ")


@given(
    st.lists(st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0)), min_size=1, max_size=6),
    st.floats(-10.0, 10.0),
)
@settings(max_examples=50, deadline=None)
def test_a_straight_drive_past_landmarks_contradicts_nothing(
    landmarks: list[tuple[float, float]], speed: float
) -> None:
    """Translation moves bearings away from the axis of motion, however near a landmark is."""
    far = np.array([(x, y) for x, y in landmarks if abs(y) > 1e-3] or [(5.0, 5.0)])
    tracks, seen = drive(speed, np.zeros(len(TIMES)), far)
    assert constant_turn_rate(tracks, seen, WHEELBASE) is None


def test_noise_of_bearings_and_one_flipped_pose_contradict_nothing() -> None:
    """A car that stands, or drives straight on; with 1.5 deg of noise for ten minutes, and times an age apart."""
    rng, n = np.random.default_rng(1), 6000
    times = np.concatenate([np.arange(n) * 0.1, 1e9 + np.arange(n) * 0.1])
    still = {"gyro_time": times[:2], "gyro": np.zeros(2), "wheel_time": times, "wheel": np.zeros(2 * n, complex)}
    flipped = np.where(np.arange(2 * n) == 50, np.pi, 0.0)
    still |= {"truth_time": times, "truth_yaw": flipped, "command_time": times, "command_speed": np.zeros(2 * n)}
    still |= {"command_steering": np.full(2 * n, 0.03)}
    azimuths = 0.5 + np.radians(1.5) * rng.normal(size=2 * n)
    assert constant_turn_rate(still, (times, azimuths, np.tile([3.0, 2.0], (2 * n, 1))), WHEELBASE) is None
