"""The drive of a vehicle: the kind of its motion under commands, limits and actuators."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from coopenv.base import units
from coopenv.base.errors import CoopenvError
from coopenv.base.sections import NonNegative, Positive, Section
from coopenv.motions.table import check_model


class Dynamics(Section):
    """The drive with its actuators; the defaults are a SVEA car's. A kind of motion reads the keys of its columns."""

    model: Annotated[str, Field(min_length=1, max_length=1_000)] = "bicycle"
    """Kind of motion: `bicycle` (speed and steering angle), `differential_drive` (speed and turn rate),
    `omnidirectional` (also a lateral speed), or a class of the user's own, `file.py:Class`."""
    wheelbase: Annotated[Positive, units.LENGTH] = 0.324
    """m, from the rear to the front axle"""
    max_speed: Annotated[Positive, units.DRIVEN_SPEED] = 1.53
    """m/s, forwards"""
    reverse: bool = False
    """Allow negative speeds."""
    max_acceleration: Annotated[Positive, units.ACCELERATION] = 2.0
    max_steering: Annotated[float, Field(gt=0.0, lt=1.5), units.TURN] = 0.6981317007977318
    """Of a bicycle, rad, to either side."""
    max_steering_rate: Annotated[Positive, units.TURN_RATE] = 2.0
    max_turn_rate: Annotated[Positive, units.TURN_RATE] = 1.5
    """Of the other kinds, rad/s, to either side."""
    max_turn_acceleration: Annotated[Positive, units.TURN_ACCELERATION] = 5.0
    """Of the other kinds: largest change of the turn rate, rad/s^2."""
    max_lateral_speed: Annotated[Positive, units.DRIVEN_SPEED] = 0.5
    """Of an omnidirectional drive, m/s, to either side; acceleration and lag are those of the speed."""
    speed_time_constant: Annotated[NonNegative, units.LAG] = 0.1
    """First-order lag of the drive, s."""
    steering_time_constant: Annotated[NonNegative, units.LAG] = 0.05
    """First-order lag of the steering, s."""
    turn_time_constant: Annotated[NonNegative, units.LAG] = 0.05
    """First-order lag of the turn rate, s."""
    latency: Annotated[NonNegative, units.LAG] = 0.0
    """Dead time between a decision and its effect, s; at most one decision period."""
    dead_band: Annotated[NonNegative, units.SPEED_ERROR] = 0.0
    """Speed commands of a smaller magnitude do not move the car, as its speed controller has them, m/s."""
    gated: bool = False
    """Limit the change of commands between decisions by the acceleration and `max_steering_rate` (other kinds:
    `max_turn_acceleration`), as the gate of a SVEA car does; otherwise only the car's own dynamics limit it."""

    @model_validator(mode="after")
    def _can_move(self) -> Self:
        try:
            check_model(self.model)
        except CoopenvError as error:
            raise ValueError(f"model: {error}") from None
        if self.dead_band > self.max_speed:
            raise ValueError(f"dead_band: {self.dead_band:g} m/s is above max_speed ({self.max_speed:g} m/s)")
        return self
