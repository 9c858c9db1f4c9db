"""Lasting errors of sensors and clocks as further states of the bound: what observers are told of, they may estimate.

Counted are the odometry's scale, the gyro's bias, how the camera is mounted, and the clocks. Slips count as if there
were none, the focal length as if it were known: with them the bound would be higher.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import skew
from coopenv.observers.contract import SensorNoise
from coopenv.observers.recording import Recording

SIZES = {"scale": 1, "bias": 3, "mounting": 3, "place": 3, "clock": 1}
"""Errors of a vehicle: relative, rad/s, rad, m, s; body axes."""


@dataclass(frozen=True)
class ErrorStates:
    """Which errors the vehicles of a record have, beside those of their poses."""

    places: dict[str, slice]
    """Name to place among a vehicle's errors, of those that any vehicle has."""
    variance: Array  # (N, e) at the start
    walk: Array  # (N, e) by which it grows, 1/s

    @property
    def count(self) -> int:
        """How many a vehicle has."""
        return int(self.variance.shape[1])

    def over_step(self, turned: Array, step: Array, dt: float) -> Array:
        """Return (..., 6, e) what the pose's left error gets over a tick from the errors, to first order.

        Args:
            turned: (..., 3, 3) body at the start to body at the end.
            step: (..., 3) way, body at the start, m.
            dt: s.
        """
        made = np.zeros((*step.shape[:-1], 6, self.count))
        if "scale" in self.places:
            made[..., 3:, self.places["scale"]] = -turned @ step[..., None]
        if "bias" in self.places:
            made[..., :3, self.places["bias"]] = -dt * np.eye(3)
        return made

    def in_bearings(self, u: Array, across: Array) -> Array:
        """Return (K, 3, e) what a bearing gets from its own vehicle's errors, its clock apart.

        Args:
            u: (K, 3) unit bearings, body frame.
            across: (K, 3, 3) the derivative of a bearing by the line to the target.
        """
        made = np.zeros((len(u), 3, self.count))
        if "mounting" in self.places:
            made[..., self.places["mounting"]] = skew(u)
        if "place" in self.places:
            made[..., self.places["place"]] = -across
        return made

    def of_clock(self, motion: Array) -> Array:
        """Return (K, 3, e) what a bearing gets from a clock that is off, given its derivative by time (K, 3)."""
        made = np.zeros((len(motion), 3, self.count))
        if "clock" in self.places:
            made[..., self.places["clock"]] = motion[..., None]
        return made


def error_states(recording: Recording) -> ErrorStates:
    """Return the errors that the vehicles of a record have been told of."""
    noises = [setup.noise for setup in recording.setups]
    variance, walk = (np.array([_stacked(noise, walks) for noise in noises]) ** 2 for walks in (False, True))
    ends = np.cumsum([0, *SIZES.values()]).tolist()
    there = {
        name: range(first, last)
        for name, first, last in zip(SIZES, ends[:-1], ends[1:], strict=True)
        if (variance[:, first:last] + walk[:, first:last]).any()
    }
    kept: list[int] = [column for columns in there.values() for column in columns]
    places = {
        name: slice(kept.index(columns[0]), kept.index(columns[0]) + len(columns)) for name, columns in there.items()
    }
    return ErrorStates(places, variance[:, kept], walk[:, kept])


def _stacked(noise: SensorNoise, walks: bool) -> list[float]:
    """Return the standard deviations of all errors, or of their walks."""
    nothing: Sequence[float] = (0.0,) * 3
    if walks:
        return [noise.odometry_scale_walk, *noise.gyro_bias_walk, *nothing, *nothing, 0.0]
    mounting, place = (noise.camera_orientation,) * 3, (noise.camera_position,) * 3
    return [noise.odometry_scale, *noise.gyro_bias, *mounting, *place, noise.clock_offset]


def motion_of_points(points: Array, dt: float, ticks: NDArray[np.int64]) -> Array:
    """Return (k, 3) the velocities at some ticks of a point that moves over all (K, 3), m/s."""
    return np.asarray((points[np.maximum(ticks, 1)] - points[np.maximum(ticks, 1) - 1]) / dt)
