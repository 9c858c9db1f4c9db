"""The held commands of one robot, integrated exactly: dead-reckoned poses at any time."""

from functools import cached_property

import numpy as np

from coopenv.backends.mrclam.dataset import Robot
from coopenv.estimation.arrays import Array

MAX_HOLD_S = 2.0
"""A command holds until the next one, but no longer than this: where a log ends, its robot does not drive on."""


class HeldCommands:
    """One robot's odometry as a function of time. Before its first command a robot stands."""

    def __init__(self, robot: Robot) -> None:
        t, v, omega = robot.odometry.T
        long = np.flatnonzero(np.diff(t, append=np.inf) > MAX_HOLD_S)
        self._t = np.insert(t, long + 1, t[long] + MAX_HOLD_S)
        self._v, self._omega = np.insert(v, long + 1, 0.0), np.insert(omega, long + 1, 0.0)

    def commands(self, t: Array) -> tuple[Array, Array]:
        """Return the velocity (K,) m/s and angular velocity (K,) rad/s that hold at times t (K,) in s."""
        k = np.searchsorted(self._t, t, side="right") - 1
        return np.where(k < 0, 0.0, self._v[k]), np.where(k < 0, 0.0, self._omega[k])

    def pose(self, t: Array) -> Array:
        """Return x, y in m and heading in rad (K, 3), seen from the pose at the first command, at times t (K,) in s."""
        k = np.searchsorted(self._t, t, side="right") - 1
        start, dt = self._at_samples[k], t - self._t[k]
        turn = self._omega[k] * dt
        moved = start[:, :2] + _arc(start[:, 2], self._v[k] * dt, turn)
        return np.where((k < 0)[:, None], 0.0, np.column_stack([moved, start[:, 2] + turn]))

    @cached_property
    def _at_samples(self) -> Array:
        """(N, 3) x, y, heading when each command begins."""
        dt = np.diff(self._t)
        turn, path = self._omega[:-1] * dt, self._v[:-1] * dt
        heading = np.concatenate([[0.0], np.cumsum(turn)])
        steps = _arc(heading[:-1], path, turn)
        return np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading])


def _arc(heading: Array, path: Array, turn: Array) -> Array:
    """Return the displacement (K, 2) along arcs that begin at a heading: a chord at half the turn."""
    chord, middle = path * np.sinc(turn / (2 * np.pi)), heading + turn / 2
    return np.stack([chord * np.cos(middle), chord * np.sin(middle)], axis=-1)
