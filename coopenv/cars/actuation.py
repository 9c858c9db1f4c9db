"""What a steering angle and a speed are on the wires of a car, both ways; facts of SVEA's own interfaces.

`Manual` is mavros' ManualControl (ROS 2, PX4), `Lowlevel` is svea_msgs/lli_ctrl (ROS 1, Teensy).
"""

import math
from dataclasses import dataclass
from enum import StrEnum


class Gear(StrEnum):
    """Of the car's gear box."""

    LOW = "low"
    HIGH = "high"


FULL_STEERING = math.radians(40.0)  # rad at 100 %
FULL_SPEED = {Gear.LOW: 1.7, Gear.HIGH: 3.6}  # m/s at 100 %
MOST_PERCENT = 90.0  # either way, of both
DEAD_BAND = 15.0  # % of the speed controller's range about zero in which the wheels do not turn
PER_PERCENT = 1.27  # of the low level's whole numbers
KEEP = -128  # of the low level: do not change this
EXTENSIONS = 0b11111100  # that aux1 to aux6 hold


@dataclass(frozen=True, slots=True)
class Drive:
    """What a car is to do."""

    steering: float = 0.0  # rad, left is positive
    speed: float = 0.0  # m/s, forward is positive
    gear: Gear = Gear.LOW


NEUTRAL = Drive()


@dataclass(frozen=True, slots=True)
class Manual:
    """Fields of mavros_msgs/ManualControl, in its order and without its header."""

    x: float = 0.0
    y: float = 0.0  # steering, -1000..1000, right is positive
    z: float = 500.0  # speed, 0..1000, forward is below the middle
    r: float = 0.0
    buttons: int = 0
    buttons2: int = 0
    enabled_extensions: int = EXTENSIONS
    s: float = 0.0
    t: float = 0.0
    aux1: float = -1000.0  # front differential open
    aux2: float = 1000.0  # rear differential open
    aux3: float = 1000.0  # low gear; high: -1000
    aux4: float = 1000.0  # spare outputs, at 0 %
    aux5: float = 1000.0
    aux6: float = 0.0


@dataclass(frozen=True, slots=True)
class Lowlevel:
    """Fields of svea_msgs/lli_ctrl."""

    steering: int = 0  # -127..127, left is positive
    velocity: int = 0  # -127..127
    trans_diff: int = 0b111000  # bits 0-2: high gear, front and rear differential locked; 3-5: which of them to change
    ctrl: int = 0


def to_manual(drive: Drive) -> Manual:
    """Return the fields for a finite command; beyond 90 % it is cut off."""
    steering, speed = _percent(drive)
    low = drive.gear is Gear.LOW
    return Manual(y=-10.0 * steering, z=500.0 - 5.0 * _clipped(speed), aux3=1000.0 if low else -1000.0)


def from_manual(y: float, z: float, aux3: float = 1000.0) -> Drive:
    """Return the command that fields y, z and aux3 of a ManualControl stand for."""
    gear = Gear.LOW if aux3 >= 0.0 else Gear.HIGH
    return Drive(-y / 10.0 * FULL_STEERING / 100.0, (500.0 - z) / 5.0 * FULL_SPEED[gear] / 100.0, gear)


def to_lowlevel(drive: Drive) -> Lowlevel:
    """Return the fields for a finite command, with the dead band of the speed controller leapt over.

    Speeds are cut to whole per cent, as the car's own interface does.
    """
    steering, speed = _percent(drive)
    speed = _clipped(int(speed))
    if speed:
        speed = speed * (100.0 - DEAD_BAND) / 100.0 + math.copysign(DEAD_BAND, speed)
    high = int(drive.gear is Gear.HIGH)
    return Lowlevel(round(PER_PERCENT * steering), round(PER_PERCENT * speed), 0b111000 | high)


def from_lowlevel(message: Lowlevel, before: Drive = NEUTRAL) -> Drive:
    """Return the command that fields stand for.

    Args:
        message: fields.
        before: what was commanded last, for what is not to change.
    """
    gear = before.gear
    if message.trans_diff & 0b001000:
        gear = Gear.HIGH if message.trans_diff & 1 else Gear.LOW
    steering, speed = before.steering, before.speed
    if message.steering != KEEP:
        steering = message.steering / PER_PERCENT * FULL_STEERING / 100.0
    if message.velocity != KEEP:
        beyond = max(abs(message.velocity) / PER_PERCENT - DEAD_BAND, 0.0) / (100.0 - DEAD_BAND)
        speed = math.copysign(beyond * FULL_SPEED[gear], message.velocity)
    return Drive(steering, speed, gear)


def _percent(drive: Drive) -> tuple[float, float]:
    """Return the steering, cut off, and the speed, in per cent."""
    return _clipped(drive.steering * 100.0 / FULL_STEERING), drive.speed * 100.0 / FULL_SPEED[drive.gear]


def _clipped(percent: float) -> float:
    return min(max(percent, -MOST_PERCENT), MOST_PERCENT)
