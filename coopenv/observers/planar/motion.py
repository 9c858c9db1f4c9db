"""How a planar robot's estimate moves by what the robot was told, and how uncertain that makes it.

Its state is

    x, y [m], heading [rad], turn scale [-], speed scale [-], turn offset [rad/s], speed offset [m/s],
    slowdown in turns [s/rad], command lead [s], bearing bias [rad], wheels' share [-], drift [rad/s]

and the commands w, v, late by the lead and spread by the wheels' response, move it by

    turn = turn scale * (W - turn offset * G) + drift * dt,    path = speed scale * V + speed offset * T - slowdown * U

over a tick: W is the integral of w + share (g - 1) w, g the wheels' gain as it was measured on one kind of robot (a
share of 0 is another kind), G is that of g over the time in which a turn is commanded, T is that time, V and U are the
integrals of v and v |w|. A robot told to drive straight does so. A step of the commanded rate takes effect a jitter
sooner or later, which leaves an error in the heading. All of this noise is as large as the innovations say
(`level.py`). With no spread in the last nine numbers and a fixed level it is the textbook filter.
"""

import math
from copy import copy
from typing import Self

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.bearing import unsure
from coopenv.observers.planar.commands import ARC, PATH, SLOWING, SWITCHING, TOLD, TURN, TURNING, CommandHistory, Step
from coopenv.observers.planar.level import NoiseLevel
from coopenv.observers.planar.state import (
    DRIFT,
    HEADING,
    LEAD,
    SHARE,
    SLOWDOWN,
    SPEED_OFFSET,
    SPEED_SCALE,
    STATES,
    TURN_OFFSET,
    TURN_SCALE,
    X,
    Y,
)
from coopenv.observers.planar.tuning import Tuning

MAX_LEAD_S = 0.6


class PlanarMotion:
    """One robot's estimate, which starts at a pose (x m, y m, heading rad) with a covariance (3, 3)."""

    def __init__(self, tuning: Tuning, pose: Array, covariance: Array) -> None:
        self.tuning = tuning
        self.state: Array = np.array([*pose, *tuning.mean])
        self.covariance: Array = np.diag(np.square([0.0, 0.0, 0.0, *tuning.std]))
        self.covariance[:3, :3] = covariance
        self._walk = np.square([0.0, 0.0, 0.0, *tuning.walk])
        self.history: CommandHistory | None = None
        self.level = NoiseLevel(tuning.level_std)
        self.learns = True  # how large the noise is
        self.evidence = 0.0  # logarithm of the likelihood of the last bearing
        self._off = np.zeros(2)  # m, along and across, that an unsure heading has led astray since it was seen

    def copy(self) -> Self:
        """Return another one like it; what was commanded, and the level of the noise, they share."""
        other = copy(self)
        other.state, other.covariance = self.state.copy(), self.covariance.copy()
        return other

    def advance(self, dt: float, turn: float, path: float) -> Step:
        """Move the estimate on by dt in s, over which the commands amount to a turn in rad and a path in m."""
        self.command(dt, turn, path)
        return self.move(dt)

    def command(self, dt: float, turn: float, path: float) -> None:
        """Take what was commanded over the last dt in s."""
        if self.history is None:
            self.history = CommandHistory(self.tuning.wheels, MAX_LEAD_S, dt)
        self.history.add(dt, turn, path)

    def move(self, dt: float) -> Step:
        """Move the estimate on by dt in s, by what was commanded."""
        k, s = self.tuning, self.state
        if self.history is None:
            return Step(0.0, 0.0, 0.0, 0.0)
        done, late = self.history.response(dt, float(s[LEAD]))
        turning, turning_late = (
            sums[TOLD] + s[SHARE] * (sums[TURN] - sums[TOLD]) - s[TURN_OFFSET] * sums[TURNING] for sums in (done, late)
        )
        turned = s[TURN_SCALE] * turning + s[DRIFT] * dt
        driven = s[SPEED_SCALE] * done[PATH] + s[SPEED_OFFSET] * done[ARC] - s[SLOWDOWN] * done[SLOWING]
        middle = float(s[HEADING] + turned / 2)
        c, sn = math.cos(middle), math.sin(middle)
        shrunk, astray = self._astray(float(driven))
        turn_row, along = np.zeros(STATES), np.zeros(STATES)
        turn_row[TURN_SCALE], turn_row[TURN_OFFSET] = turning, -s[TURN_SCALE] * done[TURNING]
        turn_row[LEAD], turn_row[SHARE] = s[TURN_SCALE] * turning_late, s[TURN_SCALE] * (done[TURN] - done[TOLD])
        turn_row[DRIFT] = dt
        along[SPEED_SCALE], along[SPEED_OFFSET], along[SLOWDOWN] = done[PATH], done[ARC], -done[SLOWING]
        along[LEAD] = s[SPEED_SCALE] * late[PATH] + s[SPEED_OFFSET] * late[ARC] - s[SLOWDOWN] * late[SLOWING]
        across = turn_row * (driven / 2)
        along, across, driven = shrunk * along, shrunk * across, shrunk * driven
        across[HEADING] = driven
        f = np.eye(STATES)
        f[X] += c * along - sn * across
        f[Y] += sn * along + c * across
        f[HEADING] += turn_row
        s[X] += driven * c
        s[Y] += driven * sn
        s[HEADING] += turned
        p = f @ self.covariance @ f.T
        p.flat[:: STATES + 1] += self._walk * dt
        speed, rate = abs(done[PATH]) / dt, abs(done[TURN]) / dt
        factor = self.level.factor
        q_path = factor * (k.path_noise[0] + k.path_noise[1] * speed) ** 2 * dt + astray[0]
        q_side = factor * (k.slide_noise * speed) ** 2 * dt + astray[1]
        q_turn = (k.turn_noise[0] + k.turn_noise[1] * rate + k.turn_noise[2] * speed) ** 2 * dt
        q_turn = factor * (q_turn + k.jitter**2 * float(done[SWITCHING]))
        p[HEADING, HEADING] += q_turn
        p[X, X] += q_path * c * c + q_side * sn * sn
        p[Y, Y] += q_path * sn * sn + q_side * c * c
        p[X, Y] += (q_path - q_side) * c * sn
        p[Y, X] = p[X, Y]
        self.covariance = p
        return Step(float(turned), float(driven), q_turn, q_path)

    def _astray(self, driven: float) -> tuple[float, tuple[float, float]]:
        """Return what a path in m shrinks by, and what an unsure heading adds along and across, m^2.

        The heading's error lasts, so that what it adds grows by lengths and not by variances.
        """
        if not self.tuning.second_order:
            return 1.0, (0.0, 0.0)
        shrunk, *more = unsure(float(self.covariance[HEADING, HEADING]))
        before, self._off = self._off, self._off + abs(driven) * np.array(more)
        along, across = (self._off**2 - before**2).tolist()
        return shrunk, (along, across)
