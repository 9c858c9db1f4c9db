"""A planar bearing-only extended Kalman filter that calibrates its robot's odometry.

Its state is

    x, y [m], heading [rad], turn scale [-], speed scale [-], turn offset [rad/s], speed offset [m/s],
    slowdown in turns [s/rad], command lead [s], bearing bias [rad]

and the commands w, v, late by the lead and spread by the wheels' response, move it by

    turn = turn scale * (W - turn offset * G),    path = speed scale * V + speed offset * T - slowdown * U

over a tick: W and G are the integrals of g w and g over the time in which a turn is commanded, g the wheels' gain, T
is that time, V and U are the integrals of v and v |w|. A robot told to drive straight does so. A step of the commanded
rate takes effect a jitter sooner or later, which leaves an error in the heading. With no spread in the last seven
numbers it is the textbook filter.
"""

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.commands import ARC, PATH, SLOWING, SWITCHING, TURN, TURNING, CommandHistory, Wheels

X, Y, HEADING, TURN_SCALE, SPEED_SCALE, TURN_OFFSET, SPEED_OFFSET, SLOWDOWN, LEAD, BIAS = range(10)
STATES = 10
MAX_LEAD_S = 0.6
NEAREST_M = 0.1  # nothing is seen from closer than this; bounds the bearing's derivatives
Seven = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Tuning:
    """Noise and choices of the filter; one of them serves all robots."""

    turn_noise: tuple[float, float, float] = (0.02, 0.3, 0.0)
    """rad/sqrt(s), plus rad/sqrt(s) per rad/s, plus rad/sqrt(s) per m/s."""
    path_noise: tuple[float, float] = (0.01, 0.3)  # m/sqrt(s), plus m/sqrt(s) per m/s
    slide_noise: float = 0.0  # m/sqrt(s) sideways per m/s
    bearing_std: float = 0.03  # rad
    gate: float = 9.0  # normalised innovation squared above which a bearing is dropped
    soft: float = math.inf  # the same above which a bearing's variance grows with it (a heavy tail)
    mean: Seven = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Turn scale, speed scale, turn offset, speed offset, slowdown, lead and bearing bias at the start."""
    std: Seven = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the same
    walk: Seven = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the same, per sqrt(s)
    jitter: float = 0.0  # s, by which a step of the commanded rate may take effect sooner or later
    wheels: Wheels = field(default_factory=Wheels)
    fusion: Literal["plain", "intersection"] = "plain"
    """How a neighbour's covariance counts: `plain` takes its errors as independent of ours, `intersection` does not
    (split covariance intersection with the weight that leaves the least variance)."""
    dependent: float = 1.0  # the share of both covariances that `intersection` takes as possibly shared errors
    arm_m: float = 0.0  # m, how far a rad of heading counts in that variance
    mutual: bool = False  # whether a robot that is seen corrects itself with the sighting, too


class PlanarPose(NamedTuple):
    """What a robot tells another: x m, y m, heading rad (3,), and their covariance (3, 3)."""

    pose: Array
    covariance: Array


class PlanarFilter:
    """One robot's estimate, which starts at a pose (x m, y m, heading rad) with a covariance (3, 3)."""

    def __init__(self, tuning: Tuning, pose: Array, covariance: Array) -> None:
        self.tuning = tuning
        self.state: Array = np.array([*pose, *tuning.mean])
        self.covariance: Array = np.diag(np.square([0.0, 0.0, 0.0, *tuning.std]))
        self.covariance[:3, :3] = covariance
        self._walk = np.square([0.0, 0.0, 0.0, *tuning.walk])
        self._commands: CommandHistory | None = None

    def advance(self, dt: float, turn: float, path: float) -> None:
        """Move the estimate on by dt in s, over which the commands amount to a turn in rad and a path in m."""
        k = self.tuning
        if self._commands is None:
            self._commands = CommandHistory(k.wheels, MAX_LEAD_S, dt)
        self._commands.add(dt, turn, path)
        s = self.state
        done, late = self._commands.response(dt, float(s[LEAD]))
        turning, turning_late = done[TURN] - s[TURN_OFFSET] * done[TURNING], late[TURN] - s[TURN_OFFSET] * late[TURNING]
        turned = s[TURN_SCALE] * turning
        driven = s[SPEED_SCALE] * done[PATH] + s[SPEED_OFFSET] * done[ARC] - s[SLOWDOWN] * done[SLOWING]
        middle = float(s[HEADING] + turned / 2)
        c, sn = math.cos(middle), math.sin(middle)
        turn_row, along = np.zeros(STATES), np.zeros(STATES)
        turn_row[TURN_SCALE], turn_row[TURN_OFFSET] = turning, -s[TURN_SCALE] * done[TURNING]
        turn_row[LEAD] = s[TURN_SCALE] * turning_late
        along[SPEED_SCALE], along[SPEED_OFFSET], along[SLOWDOWN] = done[PATH], done[ARC], -done[SLOWING]
        along[LEAD] = s[SPEED_SCALE] * late[PATH] + s[SPEED_OFFSET] * late[ARC] - s[SLOWDOWN] * late[SLOWING]
        across = turn_row * (driven / 2)
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
        q_path = (k.path_noise[0] + k.path_noise[1] * speed) ** 2 * dt
        q_side = (k.slide_noise * speed) ** 2 * dt
        p[HEADING, HEADING] += (k.turn_noise[0] + k.turn_noise[1] * rate + k.turn_noise[2] * speed) ** 2 * dt
        p[HEADING, HEADING] += k.jitter**2 * done[SWITCHING]
        p[X, X] += q_path * c * c + q_side * sn * sn
        p[Y, Y] += q_path * sn * sn + q_side * c * c
        p[X, Y] += (q_path - q_side) * c * sn
        p[Y, X] = p[X, Y]
        self.covariance = p

    def landmark(self, bearing: float, x: float, y: float) -> None:
        """Correct with a bearing in rad to a known point in m."""
        h, direction = self._line(x, y)
        self._correct(*self._to(bearing, h, direction), self.tuning.bearing_std**2, self.covariance)

    def robot(self, bearing: float, other: PlanarPose) -> None:
        """Correct with a bearing in rad to a robot that tells where it thinks it is."""
        h, direction = self._line(*other.pose[:2].tolist())
        theirs = np.array([-h[X], -h[Y], 0.0])
        self._fuse(*self._to(bearing, h, direction), theirs, other)

    def seen(self, bearing: float, other: PlanarPose) -> None:
        """Correct with the bearing in rad under which another robot, which tells its pose, sees this one."""
        h, direction = self._line(*other.pose[:2].tolist())
        theirs = np.array([-h[X], -h[Y], -1.0])
        back = direction + math.pi  # from them to us; its derivatives are those of the line from us to them
        self._fuse(h, wrapped(bearing - (back - float(other.pose[2]))), theirs, other)

    def tell(self) -> PlanarPose:
        """Return what others need: the heading is the camera's, from which bearings count (bias taken off)."""
        pick = np.zeros((3, STATES))
        pick[0, X] = pick[1, Y] = pick[2, HEADING] = 1.0
        pick[2, BIAS] = -1.0
        return PlanarPose(pick @ self.state, pick @ self.covariance @ pick.T)

    def _line(self, x: float, y: float) -> tuple[Array, float]:
        """Return the derivatives and the direction of the line from here to a point."""
        dx, dy = x - float(self.state[X]), y - float(self.state[Y])
        square = max(dx * dx + dy * dy, NEAREST_M**2)
        h = np.zeros(STATES)
        h[X], h[Y] = dy / square, -dx / square
        return h, math.atan2(dy, dx)

    def _to(self, bearing: float, h: Array, direction: float) -> tuple[Array, float]:
        """Return derivatives and innovation of a bearing of this robot's camera."""
        h[HEADING], h[BIAS] = -1.0, 1.0
        return h, wrapped(bearing - (direction - float(self.state[HEADING]) + float(self.state[BIAS])))

    def _fuse(self, h: Array, innovation: float, by_theirs: Array, other: PlanarPose) -> None:
        k = self.tuning
        theirs, noise = float(by_theirs @ other.covariance @ by_theirs), k.bearing_std**2
        if k.fusion == "plain":
            self._correct(h, innovation, noise + theirs, self.covariance)
            return
        p, arm = self.covariance, k.arm_m**2
        ph = p @ h
        own, gain = float(h @ ph), float(ph[X] ** 2 + ph[Y] ** 2 + arm * ph[HEADING] ** 2)
        cost = float(p[X, X] + p[Y, Y] + arm * p[HEADING, HEADING])
        ours_by, theirs_by = growth(own, gain, cost, theirs, noise, k.dependent)
        if ours_by > 0:
            grown = np.where(np.arange(STATES) <= HEADING, math.sqrt(ours_by), 1.0)  # nobody shares a calibration
            self._correct(h, innovation, noise + theirs * theirs_by, p * np.outer(grown, grown))

    def _correct(self, h: Array, innovation: float, noise: float, prior: Array) -> None:
        k = self.tuning
        ph = prior @ h
        spread = float(h @ ph)
        ratio = innovation**2 / (spread + noise)
        if ratio > k.gate:
            return
        if ratio > k.soft:
            noise = max(innovation**2 / k.soft - spread, noise)
        gain = ph / (spread + noise)
        self.state += gain * innovation
        self.state[LEAD] = min(max(float(self.state[LEAD]), 0.0), MAX_LEAD_S)
        p = prior - np.outer(gain, ph)
        self.covariance = (p + p.T) / 2


def wrapped(angle: float) -> float:
    """Return an angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def growth(own: float, gain: float, cost: float, theirs: float, noise: float, dependent: float) -> tuple[float, float]:
    """Return by what our and their covariance grow before they are fused, so that less is left (else 0, 0).

    Split covariance intersection: Li, Nashashibi, "Cooperative multi-vehicle localization using split covariance
    intersection filter", IEEE ITS Magazine 5(2), 2013; the weight is searched on a grid. `own` is h P h^T, `gain` are
    the weighted squares of P h^T, `cost` is the weighted trace of P, `theirs` and `noise` are variances of the bearing,
    `dependent` is the share of both covariances that may come from the same errors.
    """
    ours_by, theirs_by = 1 + dependent * (1 / WEIGHTS - 1), 1 + dependent * (1 / (1 - WEIGHTS) - 1)
    left = ours_by * cost - ours_by**2 * gain / (ours_by * own + noise + theirs * theirs_by)
    best = int(np.argmin(left))
    return (float(ours_by[best]), float(theirs_by[best])) if left[best] < cost else (0.0, 0.0)


WEIGHTS = 0.04 * np.arange(24, 0, -1)
