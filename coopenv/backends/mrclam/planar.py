"""Planar bearing-only observers for recorded robots.

One extended Kalman filter per robot. Its state is

    x, y [m], heading [rad], omega scale [-], v scale [-], turn per metre [rad/m], command lead [s],
    bearing bias [rad], slowdown in turns [s/rad]

With commands v, w that lead the motion by tau, the motion from time a to b is

    turn = s_w dW + c dV,    path = s_v dV - k dU,    dF = F(b - tau) - F(a - tau)

where W, V and U are the integrals of w, v and v |w|, commands held from sample to sample. Only past commands are
needed, since tau > 0. `PLAIN` has no spread in the last six: the textbook filter. `SELF_CALIBRATING` estimates them
online, starting from the same values for every robot and sub-dataset. There a robot that sees another also tells it so:
the bearing corrects both.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coopenv.backends.mrclam.files import Array

X, Y, HEADING, TURN_SCALE, SPEED_SCALE, CURVATURE, LEAD, BIAS, SLOWDOWN = range(9)
STATES = 9
TICK_S = 0.05  # between frames the motion is integrated exactly; covariance is propagated this often
MAX_LEAD_S = 0.6
MESSAGE_BYTES = 8 * 9  # x, y, heading and the six numbers of their covariance
SIGHTING_BYTES = MESSAGE_BYTES + 8  # and a bearing

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Tuning:
    """Noise and choices of the filter; one of them serves all sub-datasets.

    Attributes:
        turn_noise: rad/sqrt(s), plus rad/sqrt(s) per rad/s, plus rad/sqrt(s) per m/s.
        path_noise: m/sqrt(s), plus m/sqrt(s) per m/s.
        slide_noise: m/sqrt(s) sideways per m/s.
        bearing_std: rad.
        gate: normalised innovation squared above which a bearing is dropped.
        soft: normalised innovation squared above which a bearing's variance grows with it (a heavy tail).
        start_std: m, m, rad of the start.
        mean: of omega scale, v scale, rad/m, command lead s, bearing bias rad, slowdown s/rad, at the start.
        std: of the same.
        walk: of the same, per sqrt(s).
        fusion: how a neighbour's covariance counts: `plain` takes its errors as independent of ours, `intersection`
            does not (split covariance intersection with the weight that leaves the least variance).
        dependent: the share of both covariances that `intersection` takes as possibly shared errors.
        arm_m: m, how far a rad of heading counts in that variance.
        robot_std: rad, added to the bearing noise of robots.
        settled_m: what a robot says whose position standard deviation is larger is left out.
        mutual: a robot that is seen corrects itself with the sighting, too.
    """

    turn_noise: tuple[float, float, float] = (0.02, 0.3, 0.0)
    path_noise: tuple[float, float] = (0.01, 0.3)
    slide_noise: float = 0.0
    bearing_std: float = 0.03
    gate: float = 9.0
    soft: float = math.inf
    start_std: tuple[float, float, float] = (0.01, 0.01, 0.01)
    mean: Six = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    std: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    walk: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    fusion: Literal["plain", "intersection"] = "plain"
    dependent: float = 1.0
    arm_m: float = 0.0
    robot_std: float = 0.0
    settled_m: float = math.inf
    mutual: bool = False


PLAIN = Tuning()
SELF_CALIBRATING = Tuning(
    turn_noise=(0.001, 0.15, 0.17),
    path_noise=(0.002, 0.2),
    slide_noise=0.05,
    bearing_std=0.02,
    gate=25.0,
    soft=4.0,
    mean=(0.93, 1.0, -0.03, 0.22, 0.0, 0.8),
    std=(0.08, 0.05, 0.03, 0.05, 0.01, 0.4),
    walk=(0.001, 0.001, 0.001, 0.0005, 0.0001, 0.001),
    fusion="intersection",
    dependent=0.25,
    arm_m=1.0,
    mutual=True,
)
TUNINGS = {"plain": PLAIN, "self-calibrating": SELF_CALIBRATING}


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What a robot tells another.

    Attributes:
        pose: (3,) x m, y m, and the heading rad from which its camera's bearings count (its bias taken off).
        covariance: (3, 3) of the same.
    """

    pose: Array
    covariance: Array


class Odometer:
    """Integrals of the commands so far, each command held until the next."""

    def __init__(self) -> None:
        self._t: list[float] = []
        self._rate: list[tuple[float, float]] = []
        self._sum: list[tuple[float, float, float]] = []

    def add(self, t: float, v: float, omega: float) -> None:
        """Take a command: s, m/s, rad/s."""
        self._sum.append(self.at(t)[:3])
        self._t.append(t)
        self._rate.append((v, omega))

    def at(self, t: float) -> tuple[float, float, float, float, float]:
        """Return the integrals of v, omega and v |omega|, then v and omega at time t in s (zero before any command)."""
        k = bisect_right(self._t, t) - 1
        if k < 0:
            return 0.0, 0.0, 0.0, 0.0, 0.0
        (v, omega), (path, turn, turning), dt = self._rate[k], self._sum[k], t - self._t[k]
        return path + v * dt, turn + omega * dt, turning + v * abs(omega) * dt, v, omega


class PlanarFilter:
    """One robot's estimate.

    Args:
        tuning: noise and choices.
        t: s, the start.
        pose: x m, y m, heading rad at the start.
    """

    def __init__(self, tuning: Tuning, t: float, pose: tuple[float, float, float]) -> None:
        self.tuning = tuning
        self.t = t
        self.state: Array = np.array([*pose, *tuning.mean])
        self.covariance: Array = np.diag(np.square([*tuning.start_std, *tuning.std]))
        self.accepted = 0
        self.rejected = 0
        self._walk = np.square([0.0, 0.0, 0.0, *tuning.walk])
        self._odometer = Odometer()

    def odometry(self, t: float, v: float, omega: float) -> None:
        """Take a command: s, m/s, rad/s."""
        self._odometer.add(t, v, omega)
        if t - self.t >= TICK_S:
            self.advance(t)

    def advance(self, t: float) -> None:
        """Move the estimate on to time t in s."""
        dt = t - self.t
        if dt <= 0:
            return
        s = self.state
        lead = float(s[LEAD])
        path0, turn0, both0, v0, w0 = self._odometer.at(self.t - lead)
        path1, turn1, both1, v1, w1 = self._odometer.at(t - lead)
        dv, dw, du = path1 - path0, turn1 - turn0, both1 - both0
        path, turn = s[SPEED_SCALE] * dv - s[SLOWDOWN] * du, s[TURN_SCALE] * dw + s[CURVATURE] * dv
        middle = float(s[HEADING] + turn / 2)
        c, sn = math.cos(middle), math.sin(middle)
        by_lead = (
            -s[TURN_SCALE] * (w1 - w0) - s[CURVATURE] * (v1 - v0),
            -s[SPEED_SCALE] * (v1 - v0) + s[SLOWDOWN] * (v1 * abs(w1) - v0 * abs(w0)),
        )
        turn_row = np.array([0, 0, 0, dw, 0, dv, by_lead[0], 0, 0])
        along = np.array([0, 0, 0, 0, dv, 0, by_lead[1], 0, -du])
        across = turn_row * (path / 2)
        across[HEADING] = path
        f = np.eye(STATES)
        f[X] += c * along - sn * across
        f[Y] += sn * along + c * across
        f[HEADING] += turn_row
        s[X] += path * c
        s[Y] += path * sn
        s[HEADING] += turn
        p = f @ self.covariance @ f.T
        p.flat[:: STATES + 1] += self._walk * dt
        k, speed, rate = self.tuning, abs(dv) / dt, abs(dw) / dt
        q_turn = (k.turn_noise[0] + k.turn_noise[1] * rate + k.turn_noise[2] * speed) ** 2 * dt
        q_path = (k.path_noise[0] + k.path_noise[1] * speed) ** 2 * dt
        q_side = (k.slide_noise * speed) ** 2 * dt
        p[HEADING, HEADING] += q_turn
        p[X, X] += q_path * c * c + q_side * sn * sn
        p[Y, Y] += q_path * sn * sn + q_side * c * c
        p[X, Y] += (q_path - q_side) * c * sn
        p[Y, X] = p[X, Y]
        self.covariance = p
        self.t = t

    def landmark(self, bearing: float, x: float, y: float) -> None:
        """Correct with a bearing in rad to a known point in m."""
        s = self.state
        h, direction = self._line(x, y)
        h[HEADING], h[BIAS] = -1.0, 1.0
        innovation = _turned(bearing - (direction - float(s[HEADING]) + float(s[BIAS])))
        self._correct(h, innovation, self.tuning.bearing_std**2, self.covariance)

    def robot(self, bearing: float, message: Message) -> None:
        """Correct with a bearing in rad to a robot that tells where it thinks it is."""
        s = self.state
        h, direction = self._line(*message.pose[:2].tolist())
        theirs = np.array([-h[X], -h[Y], 0.0])
        h[HEADING], h[BIAS] = -1.0, 1.0
        innovation = _turned(bearing - (direction - float(s[HEADING]) + float(s[BIAS])))
        self._fuse(h, innovation, theirs, message)

    def seen(self, bearing: float, message: Message) -> None:
        """Correct with the bearing in rad under which another robot, which tells its pose, sees this one."""
        h, direction = self._line(*message.pose[:2].tolist())
        theirs = np.array([-h[X], -h[Y], -1.0])
        back = direction + math.pi  # from them to us; its derivatives are those of the line from us to them
        self._fuse(h, _turned(bearing - (back - float(message.pose[2]))), theirs, message)

    def message(self) -> Message:
        """Return what this robot tells another."""
        pick = np.zeros((3, STATES))
        pick[0, X] = pick[1, Y] = pick[2, HEADING] = 1.0
        pick[2, BIAS] = -1.0
        return Message(pick @ self.state, pick @ self.covariance @ pick.T)

    def _line(self, x: float, y: float) -> tuple[Array, float]:
        """Return the derivatives and the direction of the line from here to a point."""
        dx, dy = x - float(self.state[X]), y - float(self.state[Y])
        square = max(dx * dx + dy * dy, 1e-4)
        h = np.zeros(STATES)
        h[X], h[Y] = dy / square, -dx / square
        return h, math.atan2(dy, dx)

    def _fuse(self, h: Array, innovation: float, by_theirs: Array, message: Message) -> None:
        k = self.tuning
        if message.covariance[0, 0] + message.covariance[1, 1] > k.settled_m**2:
            return
        theirs = float(by_theirs @ message.covariance @ by_theirs)
        noise = k.bearing_std**2 + k.robot_std**2
        if k.fusion == "plain":
            self._correct(h, innovation, noise + theirs, self.covariance)
            return
        p, arm = self.covariance, k.arm_m**2
        ph = p @ h
        own, gain = float(h @ ph), float(ph[X] ** 2 + ph[Y] ** 2 + arm * ph[HEADING] ** 2)
        cost = float(p[X, X] + p[Y, Y] + arm * p[HEADING, HEADING])
        ours_by, theirs_by = _scales(own, gain, cost, theirs, noise, k.dependent)
        if ours_by > 0:
            self._correct(h, innovation, noise + theirs * theirs_by, p * ours_by)

    def _correct(self, h: Array, innovation: float, noise: float, prior: Array) -> None:
        k = self.tuning
        ph = prior @ h
        spread = float(h @ ph)
        ratio = innovation**2 / (spread + noise)
        if ratio > k.gate:
            self.rejected += 1
            return
        self.accepted += 1
        if ratio > k.soft:
            noise = max(innovation**2 / k.soft - spread, noise)
        gain = ph / (spread + noise)
        self.state += gain * innovation
        self.state[LEAD] = min(max(float(self.state[LEAD]), 0.0), MAX_LEAD_S)
        p = prior - np.outer(gain, ph)
        self.covariance = (p + p.T) / 2


def _turned(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _scales(own: float, gain: float, cost: float, theirs: float, noise: float, dependent: float) -> tuple[float, float]:
    """Return by what our and their covariance grow before they are fused, so that less is left (else 0, 0).

    Args:
        own: h P h^T, rad^2.
        gain: weighted squares of P h^T.
        cost: weighted trace of P.
        theirs: rad^2, of the bearing, from the neighbour's covariance.
        noise: rad^2.
        dependent: share of both covariances that may come from the same errors.
    """
    best, scales = cost, (0.0, 0.0)
    for ours_by, theirs_by in ((1 + dependent * (1 / w - 1), 1 + dependent * (1 / (1 - w) - 1)) for w in WEIGHTS):
        left = ours_by * cost - ours_by**2 * gain / (ours_by * own + noise + theirs * theirs_by)
        if left < best:
            best, scales = left, (ours_by, theirs_by)
    return scales


WEIGHTS = tuple(0.04 * k for k in range(24, 0, -1))
