"""What a planar robot was told to do, and what its wheels made of it a moment later."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array

TURNING_RATE = 1e-6  # rad/s; a smaller command is one to drive straight
DRIVING_SPEED = 1e-6  # m/s; a smaller command is one to turn on the spot
TURN, TURNING, PATH, ARC, SLOWING, SWITCHING, TOLD = range(7)
"""What the wheels make of commands: commanded turn times gain, rad; commanded turning times gain, s; commanded path, m;
commanded turning, s; path times rate of turn, m rad/s; squares of the steps in the commanded rate, rad^2/s^2."""


@dataclass(frozen=True, slots=True)
class Wheels:
    """How a kind of robot follows its commands v and w; the default does at once what it is told."""

    delay: tuple[float, ...] = (0.0,)  # s after the lead by which commands are early
    share: tuple[float, ...] = (1.0,)  # of the response at these delays; they sum to one
    arc: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    """(curvature |w| / v in 1/m, gain): how much it turns against what it is told, between and beyond linear."""
    spot: float = 1.0  # the same gain of turns on the spot
    slow: float = 0.0  # m/s, below which arcs tighter than 1/m gain more, by:
    slow_gain: float = 0.0
    centre: float = 0.0  # rad/s, the logged w at which it drives straight, for the curvature

    def gain(self, v: float, w: float) -> float:
        """Return turn against commanded turn at v in m/s and w in rad/s."""
        if abs(v) <= DRIVING_SPEED:
            return self.spot
        curvature = abs(w - self.centre) / abs(v)
        curvatures, gains = zip(*self.arc, strict=True)
        more = self.slow_gain if abs(v) < self.slow and curvature > 1.0 else 0.0
        return float(np.interp(curvature, curvatures, gains)) + more


class Step(NamedTuple):
    """What the odometry says of one tick."""

    turned: float  # rad
    driven: float  # m
    turn_variance: float  # rad^2, of its noise alone
    path_variance: float  # m^2


class CommandHistory:
    """The last commands of one robot, for leads up to the longest, s, and ticks down to the shortest, s."""

    def __init__(self, wheels: Wheels, longest: float, shortest: float) -> None:
        self._wheels = wheels
        self._delay, self._share = np.array(wheels.delay), np.array(wheels.share)
        ticks = int((longest + self._delay.max()) / shortest) + 4
        self._t = np.arange(-ticks, 1) * shortest
        self._sum = np.zeros((7, ticks + 1))
        self._rate = 0.0

    def add(self, dt: float, turn: float, path: float) -> None:
        """Take what was commanded over the last dt in s: rad, m."""
        v, w = path / dt, turn / dt
        turning = dt if abs(w) > TURNING_RATE else 0.0
        gain = self._wheels.gain(v, w) if turning else 1.0
        self._t[:-1] = self._t[1:]
        self._sum[:, :-1] = self._sum[:, 1:]
        self._t[-1] += dt
        self._sum[:, -1] += gain * turn, gain * turning, path, turning, path * abs(w), (w - self._rate) ** 2, turn
        self._rate = w

    def response(self, dt: float, lead: float) -> tuple[Array, Array]:
        """Return what the wheels did in the last dt in s (7,), if commands are early by `lead` in s, and d/dlead."""
        now, half = self._t[-1] - lead, dt / 2
        ends = np.array([now - dt - half, now - dt, now - half, now, now + half])
        at = (ends[:, None] - self._delay).ravel()
        k = np.clip(np.searchsorted(self._t, at), 1, len(self._t) - 1)
        share = np.minimum((at - self._t[k - 1]) / (self._t[k] - self._t[k - 1]), 1.0)
        before = self._sum[:, k - 1]
        sums = (before + share * (self._sum[:, k] - before)).reshape(7, len(ends), -1) @ self._share
        earlier, start, middle, end, later = sums.T
        return end - start, -(later - 2 * middle + earlier) / dt
