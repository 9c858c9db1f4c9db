"""The motion of a car under a command."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from coopenv.base import units
from coopenv.base.sections import NonNegative, Positive, Section


class Dynamics(Section):
    """Kinematic bicycle with its actuators; the defaults are a SVEA car's."""

    wheelbase: Annotated[Positive, units.LENGTH] = 0.324
    """m, from the rear to the front axle"""
    max_speed: Annotated[Positive, units.DRIVEN_SPEED] = 1.53
    """m/s, forwards"""
    reverse: bool = False
    """Allow negative speeds."""
    max_acceleration: Annotated[Positive, units.ACCELERATION] = 2.0
    max_steering: Annotated[float, Field(gt=0.0, lt=1.5), units.TURN] = 0.6981317007977318
    """rad, to either side"""
    max_steering_rate: Annotated[Positive, units.TURN_RATE] = 2.0
    speed_time_constant: Annotated[NonNegative, units.LAG] = 0.1
    """First-order lag of the drive, s."""
    steering_time_constant: Annotated[NonNegative, units.LAG] = 0.05
    """First-order lag of the steering, s."""
    latency: Annotated[NonNegative, units.LAG] = 0.0
    """Dead time between a decision and its effect, s; at most one decision period."""
    dead_band: Annotated[NonNegative, units.SPEED_ERROR] = 0.0
    """Speed commands of a smaller magnitude do not move the car, as its speed controller has them, m/s."""
    gated: bool = False
    """Limit the change of commands between decisions by the acceleration and `max_steering_rate`, as the gate of a SVEA
    car does; otherwise only the car's own dynamics limit it."""

    @model_validator(mode="after")
    def _can_move(self) -> Self:
        if self.dead_band > self.max_speed:
            raise ValueError(f"dead_band: {self.dead_band:g} m/s is above max_speed ({self.max_speed:g} m/s)")
        return self
