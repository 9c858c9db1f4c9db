"""The command from a gate to its car's wheels: motion, the message of a make, and its bytes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from coopenv.base.errors import shown
from coopenv.base.sections import Section
from coopenv.cars.messages.cdr import KINDS, STAMP, TEXT, read, write
from coopenv.cars.settings.limits import Number, Positive


@dataclass(frozen=True, slots=True)
class MotionCommand:
    """Motion command of a car."""

    steering: float = 0.0  # rad, left is positive
    speed: float = 0.0  # m/s, forward is positive
    brake: bool = False  # with the profile's brake, whatever the others are


NEUTRAL = MotionCommand()


class Channel(Section):
    """One value of the command message: linear between neutral and full."""

    field: str
    """Field of the message."""
    full: Positive
    """Steering angle (rad, left is positive), turn rate (rad/s) or speed (m/s) at full."""
    change: Number
    """Change of the field from neutral to full."""


class Brake(Section):
    """Braking of the wheels."""

    fields: dict[str, Number] = Field(min_length=1)
    """Fields of the message that differ from a standing car's."""
    deceleration: Positive
    """Deceleration of a braking car, m/s^2, by a test. Braking lasts for the last commanded speed divided by it."""


FieldType = Literal["bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]


def _holds(kind: FieldType, value: float) -> bool:
    """Return whether a field can have a value."""
    if kind.startswith("float"):
        return True
    bits = 1 if kind == "bool" else int(kind.lstrip("uint"))
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind.startswith("i") else (0, 2**bits - 1)
    return value.is_integer() and low <= value <= high


class CommandMessage(Section):
    """Message from the gate to the car, a stamped one: a header, then numbers."""

    neutral: dict[str, tuple[FieldType, Number]]
    """Fields after the header in their order: type, and value of a standing car. Nested messages are written flat."""
    steering: Channel
    """Field of the steering angle; with `wheelbase`, of the turn rate."""
    speed: Channel
    """Field of the speed."""
    most: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of full that is sent at most, either way."""
    brake: Brake | None = None
    """Braking before neutral when the gate stops its car (none: neutral alone)."""
    wheelbase: Positive | None = None
    """Wheelbase of a car that takes turn rates, such as differential drives: that of the environment's vehicle, m.
    Turn rates are speed tan(steering) / wheelbase."""
    timeout: Positive = 0.5
    """Time without a message after which the car goes to neutral by itself, s (assumed by fake cars)."""

    @model_validator(mode="after")
    def _channels_move_fields(self) -> Self:
        for name, channel in (("steering", self.steering), ("speed", self.speed)):
            if not self.neutral.get(channel.field, ("", 0.0))[0].startswith("float"):
                raise ValueError(f"{name}.field: {shown(channel.field)} is no float32 or float64 of neutral")
            if channel.change == 0.0:
                raise ValueError(f"{name}.change: must not be 0")
        if self.steering.field == self.speed.field:
            raise ValueError(f"speed.field: {shown(self.speed.field)} is steering.field, too")
        braking = self.brake.fields if self.brake else {}
        if braking and all(value == self.neutral.get(name, ("", None))[1] for name, value in braking.items()):
            raise ValueError("brake.fields: equal a standing car's, so they brake nothing")
        for field in braking:
            if field not in self.neutral:
                raise ValueError(f"brake.fields: {shown(field)} is no field of neutral")
        for name, (kind, value) in self.neutral.items():
            for where, number in (("neutral", value), ("brake.fields", braking.get(name, value))):
                if not _holds(kind, number):
                    raise ValueError(f"{where}.{name}: a field of type {kind} cannot be {number:g}")
        return self

    def share(self, channel: Channel, value: float) -> float:
        """Return a steering angle or a speed as a share of full, cut off at `most`."""
        return min(max(value / channel.full, -self.most), self.most)

    def values(self, drive: MotionCommand) -> dict[str, float]:
        """Return the fields of a finite command by name."""
        found, turn = {name: value for name, (_, value) in self.neutral.items()}, drive.steering
        if drive.brake and self.brake:
            return found | self.brake.fields
        if self.wheelbase is not None:
            turn = drive.speed * math.tan(drive.steering) / self.wheelbase
        for channel, value in ((self.steering, turn), (self.speed, drive.speed)):
            found[channel.field] += channel.change * self.share(channel, value)
        return found

    def drive(self, values: Mapping[str, float]) -> MotionCommand:
        """Return the command of fields by name."""
        if self.brake and all(values[name] == value for name, value in self.brake.fields.items()):
            return MotionCommand(brake=True)
        steering, speed = (
            (values[channel.field] - self.neutral[channel.field][1]) / channel.change * channel.full
            for channel in (self.steering, self.speed)
        )
        if self.wheelbase is not None:
            steering = math.atan(steering * self.wheelbase / speed) if speed else 0.0
        return MotionCommand(steering, speed)


def write_drive(stamp: int, message: CommandMessage, drive: MotionCommand) -> bytes:
    """Return the message from the gate to the car for a finite command, with a stamp in ns."""
    kinds, values = [kind for kind, _ in message.neutral.values()], message.values(drive).values()
    numbers = [v if kind.startswith("float") else int(v) for kind, v in zip(kinds, values, strict=True)]
    return write((STAMP, TEXT, *(KINDS[kind] for kind in kinds)), stamp, "", *numbers)


def read_drive(payload: bytes, message: CommandMessage) -> MotionCommand:
    """Return the command in a message from a gate to its car. Raises Malformed: the bytes are none."""
    kinds = [KINDS[kind] for kind, _ in message.neutral.values()]
    _, _, *values = read(payload, (STAMP, TEXT, *kinds))
    return message.drive(dict(zip(message.neutral, values, strict=True)))
