"""Commands on the wires of a car: the values of its own interface, and back."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.actuation import (
    KEEP,
    Drive,
    Gear,
    Lowlevel,
    Manual,
    from_lowlevel,
    from_manual,
    to_lowlevel,
    to_manual,
)
from coopenv.cars.codec import ros2
from coopenv.cars.limits import HARDEST, Limits

STEERING = st.floats(-math.radians(36.0), math.radians(36.0))
SPEED = st.floats(-1.53, 1.53)
GEAR = st.sampled_from(Gear)


@pytest.mark.parametrize(
    ("steering", "speed", "y", "z"),
    [
        (0.0, 0.0, 0.0, 500.0),
        (0.2, 0.4, -286.48, 382.35),
        (-0.2, -0.4, 286.48, 617.65),
        (1.0, 3.0, -900.0, 50.0),
    ],
)
def test_manual_control_has_the_values_of_the_cars_interface(steering: float, speed: float, y: float, z: float) -> None:
    fields = to_manual(Drive(steering, speed))
    assert (fields.y, fields.z) == pytest.approx((y, z), abs=0.005)
    back = from_manual(y, z)
    cut = Drive(min(max(steering, -0.2 * math.pi), 0.2 * math.pi), min(max(speed, -1.53), 1.53))
    assert (back.steering, back.speed) == pytest.approx((cut.steering, cut.speed), abs=2e-5)


def test_manual_control_names_its_extensions() -> None:
    low, high = to_manual(Drive()), to_manual(Drive(gear=Gear.HIGH))
    assert low.enabled_extensions == sum(1 << bit for bit in range(2, 8)) == 252
    assert (low.aux1, low.aux2, low.aux3, low.aux4, low.aux5, low.aux6) == (-1000, 1000, 1000, 1000, 1000, 0)
    assert (low.x, low.r, low.s, low.t, low.buttons, low.buttons2) == (0, 0, 0, 0, 0, 0)
    assert high == Manual(aux3=-1000.0)
    names = [name for name in ros2().types["mavros_msgs/msg/ManualControl"].__annotations__ if name[0] != "_"]
    assert names[1:] == list(Manual.__slots__)


@given(STEERING, SPEED, GEAR)
def test_manual_control_comes_back(steering: float, speed: float, gear: Gear) -> None:
    fields = to_manual(Drive(steering, speed, gear))
    y, z = struct.unpack("<2f", struct.pack("<2f", fields.y, fields.z))
    assert abs(y) <= 900.001 and 49.999 <= z <= 950.001
    back = from_manual(y, z, fields.aux3)
    assert back.gear is gear
    assert (back.steering, back.speed) == pytest.approx((steering, speed), abs=1e-6)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), GEAR)
def test_no_command_goes_beyond_ninety_per_cent(steering: float, speed: float, gear: Gear) -> None:
    fields, low = to_manual(Drive(steering, speed, gear)), to_lowlevel(Drive(steering, speed, gear))
    assert abs(fields.y) <= 900.0 and 50.0 <= fields.z <= 950.0
    assert abs(low.steering) <= 114 and abs(low.velocity) <= 116


def test_low_level_has_the_values_of_the_cars_interface() -> None:
    fields = to_lowlevel(Drive(0.2, 0.8))
    assert (fields.steering, fields.velocity) == (36, 70)
    assert to_lowlevel(Drive()) == Lowlevel(0, 0, 0b111000, 0)
    assert to_lowlevel(Drive(gear=Gear.HIGH)).trans_diff == 0b111001
    least = to_lowlevel(Drive(speed=0.018)).velocity  # 1 %
    assert least == round(1.27 * 15.85) == -to_lowlevel(Drive(speed=-0.018)).velocity
    assert to_lowlevel(Drive(speed=0.0169)).velocity == 0


@given(STEERING, SPEED, GEAR)
def test_low_level_comes_back_but_for_its_whole_numbers(steering: float, speed: float, gear: Gear) -> None:
    back = from_lowlevel(to_lowlevel(Drive(steering, speed, gear)))
    full = 1.7 if gear is Gear.LOW else 3.6
    assert back.gear is gear
    assert back.steering == pytest.approx(steering, abs=0.5 / 1.27 * math.radians(0.4) + 1e-9)
    assert back.speed == pytest.approx(speed, abs=full / 100.0 * (1.0 + 0.5 / 1.27 / 0.85) + 1e-9)
    assert back.speed * speed >= 0.0


def test_low_level_keeps_what_it_says_not_to_change() -> None:
    before = Drive(0.1, 0.3, Gear.HIGH)
    assert from_lowlevel(Lowlevel(KEEP, KEEP, 0), before) == before
    assert from_lowlevel(Lowlevel(0, KEEP, 0b001000), before) == Drive(0.0, 0.3, Gear.LOW)
    assert from_lowlevel(Lowlevel(KEEP, 19, 0), before).speed == 0.0  # within the dead band


@given(st.tuples(SPEED, STEERING), st.tuples(SPEED, STEERING), st.floats(0.0, 1.0))
def test_rates_are_limited(before: tuple[float, float], wanted: tuple[float, float], dt: float) -> None:
    limits = Limits(0.5, 0.5, 1.0, 2.0)
    after = limits.approach(before, wanted, dt)
    for old, goal, new, rate in zip(before, wanted, after, (1.0, 2.0), strict=True):
        assert abs(new - old) <= rate * dt + 1e-12
        assert abs(goal - new) <= abs(goal - old)  # never away from it, nor beyond
        assert new == goal or abs(new - old) == pytest.approx(rate * dt)


@pytest.mark.parametrize("limits", [Limits(1.6, 0.5, 1.0, 2.0), Limits(0.5, 0.6, 1, 2), Limits(0.5, 0.5, 0.0, 2)])
def test_limits_beyond_the_hardest_are_refused(limits: Limits) -> None:
    assert HARDEST.check() is HARDEST
    with pytest.raises(CoopenvError, match="must be above 0, at most"):
        limits.check()
