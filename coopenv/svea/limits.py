"""What a car may be told to do."""

import math
from dataclasses import dataclass, fields

from coopenv.errors import CoopenvError


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

    def approach(self, before: tuple[float, float], wanted: tuple[float, float], dt: float) -> tuple[float, float]:
        """Return the (speed, steering) nearest to what is wanted that can follow after dt s; both in m/s and rad."""
        speed = _toward(before[0], wanted[0], self.acceleration * dt)
        return speed, _toward(before[1], wanted[1], self.steering_rate * dt)

    def check(self) -> "Limits":
        """Return these limits. Raises CoopenvError: one of them is not above zero, or beyond the hardest."""
        for field in fields(self):
            value, most = getattr(self, field.name), getattr(HARDEST, field.name)
            if field.name != "reverse" and not 0.0 < value <= most:
                raise CoopenvError(f"limit of {field.name.replace('_', ' ')}: must be above 0, at most {most:.4g}")
        return self


def _toward(before: float, wanted: float, most: float) -> float:
    """Return `wanted`, or what is `most` from `before` towards it."""
    return wanted if abs(wanted - before) <= most else before + math.copysign(most, wanted - before)


SLACK = 1e-6
"""m/s or rad, of numbers that have gone through single precision."""

HARDEST = Limits(speed=1.53, steering=math.pi / 6, acceleration=2.0, steering_rate=4.0, reverse=True)
"""Beyond which no file can go: 90 % of the low gear, and what a SVEA's servo does."""

USUAL = Limits(speed=0.5, steering=math.pi / 6, acceleration=1.0, steering_rate=2.0)
"""Where nothing else is said."""
