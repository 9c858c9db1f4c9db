"""Commands on the wires of a car: the values of its own interface, and back."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.codec import decode, ros2
from coopenv.cars.gate.core import read_drive, write_drive
from coopenv.cars.profile import NEUTRAL, SVEA, Limits, MotionCommand, Role
from coopenv.cars.transport.authors import low_level

STEERING = st.floats(-math.radians(36.0), math.radians(36.0))
SPEED = st.floats(-1.53, 1.53)
COMMAND = SVEA.command


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
    fields = COMMAND.values(MotionCommand(steering, speed))
    assert (fields["y"], fields["z"]) == pytest.approx((y, z), abs=0.005)
    back = COMMAND.drive({"y": y, "z": z})
    cut = MotionCommand(min(max(steering, -0.2 * math.pi), 0.2 * math.pi), min(max(speed, -1.53), 1.53))
    assert (back.steering, back.speed) == pytest.approx((cut.steering, cut.speed), abs=2e-5)


def test_manual_control_names_its_extensions() -> None:
    fields = COMMAND.values(NEUTRAL)
    assert fields["enabled_extensions"] == sum(1 << bit for bit in range(2, 8)) == 252
    assert [fields[f"aux{i}"] for i in range(1, 7)] == [-1000, 1000, 1000, 1000, 1000, 0]
    assert not any(fields[name] for name in ("x", "y", "r", "s", "t", "buttons", "buttons2"))
    names = [name for name in ros2().types[SVEA.topics[Role.MANUAL].type].__annotations__ if name[0] != "_"]
    assert names[1:] == list(COMMAND.neutral)


@given(STEERING, SPEED)
def test_manual_control_comes_back(steering: float, speed: float) -> None:
    payload = write_drive(0, COMMAND, MotionCommand(steering, speed))
    fields = decode(payload, SVEA.topics[Role.MANUAL].type)
    assert abs(fields.y) <= 900.001 and 49.999 <= fields.z <= 950.001
    back = read_drive(payload, COMMAND)
    assert (back.steering, back.speed) == pytest.approx((steering, speed), abs=1e-6)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_no_command_goes_beyond_ninety_per_cent(steering: float, speed: float) -> None:
    fields, low = COMMAND.values(MotionCommand(steering, speed)), low_level(MotionCommand(steering, speed), COMMAND)
    assert abs(fields["y"]) <= 900.0 and 50.0 <= fields["z"] <= 950.0
    assert abs(low.steering) <= 114 and abs(low.velocity) <= 116


def test_low_level_has_the_values_of_the_cars_interface() -> None:
    fields = low_level(MotionCommand(0.2, 0.8), COMMAND)
    assert (fields.steering, fields.velocity) == (36, 70)
    still = low_level(NEUTRAL, COMMAND)
    assert (still.steering, still.velocity, still.trans_diff, still.ctrl) == (0, 0, 0b111000, 0)
    least = low_level(MotionCommand(speed=0.018), COMMAND).velocity  # 1 %
    assert least == round(1.27 * 15.85) == -low_level(MotionCommand(speed=-0.018), COMMAND).velocity
    assert low_level(MotionCommand(speed=0.0169), COMMAND).velocity == 0


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
    assert SVEA.hardest.check(SVEA.hardest) is SVEA.hardest
    with pytest.raises(CoopenvError, match="must be above 0, at most"):
        limits.check(SVEA.hardest)
