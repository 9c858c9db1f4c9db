"""What a car may be told to do."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Bounds of commands."""

    speed: float  # m/s
    steering: float  # rad
    acceleration: float  # m/s^2
    steering_rate: float  # rad/s
    reverse: bool = False

    def permit(self, speed: float, steering: float) -> bool:
        """Return whether a command is finite and inside."""
        return (
            math.isfinite(speed)
            and math.isfinite(steering)
            and (-self.speed if self.reverse else 0.0) - SLACK <= speed <= self.speed + SLACK
            and abs(steering) <= self.steering + SLACK
        )


SLACK = 1e-6
"""m/s or rad, of numbers that have gone through single precision."""

HARDEST = Limits(speed=1.53, steering=math.pi / 6, acceleration=2.0, steering_rate=4.0, reverse=True)
"""Beyond which no file can go: 90 % of the low gear, and what a SVEA's servo does."""
