"""What a vehicle's odometry says, and what its errors that last do to that."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import exp_so3
from coopenv.observers.contract import SensorNoise, Tick
from coopenv.observers.robust.constants import (
    JUMP_GATE,
    MAX_SMOOTH_ACCELERATION,
    MAX_SMOOTH_ANGULAR_ACCELERATION,
    MIN_ERROR_STD,
    SAME_TIME,
)

SMOOTH = MAX_SMOOTH_ANGULAR_ACCELERATION, MAX_SMOOTH_ACCELERATION


@dataclass(frozen=True)
class Lasting:
    """Variances of errors of odometry that last, as declared."""

    bias: Array  # (3,) (rad/s)^2
    scale: float
    bias_walk: Array  # (3,) per second
    scale_walk: float

    @classmethod
    def of(cls, noise: SensorNoise) -> Lasting:
        """Return what a vehicle is told."""
        bias, walk = np.square(noise.gyro_bias), np.square(noise.gyro_bias_walk)
        return cls(bias, noise.odometry_scale**2, walk, noise.odometry_scale_walk**2)

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return bool(self.bias.any() or self.bias_walk.any() or self.scale or self.scale_walk)

    @property
    def start(self) -> Array:
        """(6, 6) covariance before anything is known."""
        return np.diag([*np.maximum([*self.bias, self.scale], MIN_ERROR_STD**2), 1.0, 1.0])


def as_noise(P: Array | None, dp: Array, dt: float, correlated: float) -> Array:
    """Return the variances (6,) of an increment by errors that last, of covariance P, if they were noise."""
    if P is None:
        return np.zeros(6)
    time = max(correlated, dt)
    return np.repeat([P.diagonal()[:3].max() * dt * time, P[3, 3] * dp.dot(dp) * time / max(dt, SAME_TIME)], 3)


def trapezoidal(
    tick: Tick, before: tuple[Array, Array] | None, T: float, stds: tuple[float, float]
) -> tuple[Tick, Array]:
    """Return a tick whose increment has the half change of the held sample that holding it has left out.

    Also the variances (6,) of what has changed at once, at an unknown time between two samples.

    Args:
        tick: as measured.
        before: angular and linear velocity of the sample held at the last tick's end.
        T: period of the samples, s.
        stds: of their noise, angular and linear.
    """
    if before is None:
        return tick, np.zeros(6)
    changes = [b - a for a, b in zip(before, (tick.angular_velocity, tick.velocity), strict=True)]
    turn, step = (0.5 * T * change for change in changes)
    translation = tick.translation + tick.rotation.dot(step)
    jumps = [
        change.dot(change) * T * T / 12.0 if change.dot(change) > max(JUMP_GATE * std**2, (smooth * T) ** 2) else 0.0
        for change, std, smooth in zip(changes, stds, SMOOTH, strict=True)
    ]
    return replace(tick, rotation=tick.rotation.dot(exp_so3(turn)), translation=translation), np.repeat(jumps, 3)
