"""The planar filter's state, noise, commands and small geometry."""

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.mrclam.wheels import IROBOT_CREATE, TURNING_RATE, Wheels

X, Y, HEADING, TURN_SCALE, SPEED_SCALE, TURN_OFFSET, SPEED_OFFSET, SLOWDOWN, LEAD, BIAS, SHARE, DRIFT = range(12)
STATES = 12


class PlanarPose(NamedTuple):
    """A broadcast pose: x m, y m, heading rad (3,), and its covariance (3, 3)."""

    pose: Array
    covariance: Array


NEAREST_M = 0.1  # nothing is seen from closer than this; bounds the bearing's derivatives


Angle = TypeVar("Angle", float, Array)


def wrapped(angle: Angle) -> Angle:
    """Return an angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def left_out(dx: float, dy: float, square: float, covariance: Array) -> float:
    """Return the variance of a bearing, rad^2, that its linearisation leaves out.

    That is of the second order in the covariance (2, 2) of the line's ends, m^2: where these are as uncertain as the
    line is long, a bearing has little information. The line is (dx, dy) in m, `square` its length squared.
    """
    (xx, xy), (_, yy) = covariance.tolist()
    along = (dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy) / square
    across = (dy * dy * xx - 2 * dx * dy * xy + dx * dx * yy) / square
    both = (dx * dy * (yy - xx) + (dx * dx - dy * dy) * xy) / square
    return float((along * across + both * both) / square**2)


def unsure(variance: float) -> tuple[float, float, float]:
    """Return the moments of a straight path under a normal error of its heading of a variance in rad^2.

    By what its mean shrinks, and the standard deviations along and across it, relative to its length, of what the best
    linear function of the heading leaves: e^(-u/2), (1 - e^-u) / sqrt 2 and sqrt((1 - e^-2u) / 2 - u e^-u).
    """
    left = -math.expm1(-variance)
    across = -math.expm1(-2 * variance) / 2 - variance * (1 - left)
    return math.exp(-variance / 2), left / math.sqrt(2), math.sqrt(max(across, 0.0))


def misfit(bearing: float, by: PlanarPose, to: PlanarPose, bearing_std: float) -> tuple[float, float]:
    """Return the normalised innovation squared of a bearing in rad between two reported poses, and its variance."""
    dx, dy = (to.pose[:2] - by.pose[:2]).tolist()
    square = max(dx * dx + dy * dy, NEAREST_M**2)
    both = by.covariance[:2, :2] + to.covariance[:2, :2]
    line = np.array([dy / square, -dx / square, -1.0])
    variance = float(line @ by.covariance @ line + line[:2] @ to.covariance[:2, :2] @ line[:2])
    variance += bearing_std**2 + left_out(dx, dy, square, both)
    return wrapped(bearing - (math.atan2(dy, dx) - float(by.pose[2]))) ** 2 / variance, variance


TURN, TURNING, PATH, ARC, SLOWING, SWITCHING, COMMANDED = range(7)
"""Terms of the wheels' model: commanded turn times gain, rad; commanded turning times gain, s; commanded path, m;
commanded turning, s; path times rate of turn, m rad/s; squares of the steps in the commanded rate, rad^2/s^2."""


class OdometryStep(NamedTuple):
    """Odometry of one tick."""

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
        """Take the commands over the last dt in s: rad, m."""
        v, w = path / dt, turn / dt
        turning = dt if abs(w) > TURNING_RATE else 0.0
        gain = self._wheels.gain(v, w) if turning else 1.0
        self._t[:-1] = self._t[1:]
        self._sum[:, :-1] = self._sum[:, 1:]
        self._t[-1] += dt
        self._sum[:, -1] += gain * turn, gain * turning, path, turning, path * abs(w), (w - self._rate) ** 2, turn
        self._rate = w

    def response(self, dt: float, lead: float) -> tuple[Array, Array]:
        """Return the wheels' terms (7,) of the last dt in s, if commands are early by `lead` in s, and d/dlead."""
        now, half = self._t[-1] - lead, dt / 2
        ends = np.array([now - dt - half, now - dt, now - half, now, now + half])
        at = (ends[:, None] - self._delay).ravel()
        k = np.searchsorted(self._t[1:-1], at)
        t, before = self._t.take(k), self._sum[:, k]
        share = np.minimum((at - t) / (self._t.take(k + 1) - t), 1.0)
        sums = (before + share * (self._sum[:, k + 1] - before)).reshape(7, len(ends), -1) @ self._share
        earlier, start, middle, end, later = sums.T
        return end - start, -(later - 2 * middle + earlier) / dt


Nine = tuple[float, float, float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Tuning:
    """Noise and choices of the filter; one of them serves all robots."""

    turn_noise: tuple[float, float, float] = (0.02, 0.3, 0.0)
    """rad/sqrt(s), plus rad/sqrt(s) per rad/s, plus rad/sqrt(s) per m/s."""
    path_noise: tuple[float, float] = (0.01, 0.3)  # m/sqrt(s), plus m/sqrt(s) per m/s
    slide_noise: float = 0.0  # m/sqrt(s) sideways per m/s
    bearing_std: float = 0.03  # rad
    gate: float = 9.0  # normalised innovation squared above which a bearing is dropped
    others_gate: float = math.inf  # the same of a bearing to or from a robot, before the covariances grow
    soft: float = math.inf  # the same above which a bearing's variance grows with it (a heavy tail)
    second_order: bool = False  # whether a bearing's variance grows with what its linearisation leaves out
    mean: Nine = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    """Turn scale, speed scale, turn offset, speed offset, slowdown, lead, bearing bias, wheels' share and drift at the
    start."""
    std: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the same
    walk: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the same, per sqrt(s)
    drifting: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the drift, rad/s, of robots that drift, and their share; `std` has that of the others."""
    jitter: float = 0.0  # s, by which a step of the commanded rate may take effect sooner or later
    level_std: float = 0.0  # of the logarithm of a factor on all motion noise, learnt from the innovations; 0: fixed
    wheels: Wheels = field(default_factory=Wheels)
    fusion: Literal["plain", "intersection"] = "plain"
    """Fusion of a neighbour's covariance: `plain` takes its errors as independent of the own ones, `intersection` does
    not (split covariance intersection with the weight that leaves the least variance)."""
    dependent: float = 1.0  # the share of both covariances that `intersection` takes as possibly shared errors
    arm_m: float = 0.0  # m, how far a rad of heading counts in that variance


TEXTBOOK = Tuning()
CALIBRATING = Tuning(
    turn_noise=(0.004, 0.1, 0.1),
    path_noise=(0.002, 0.22),
    slide_noise=0.05,
    bearing_std=0.025,
    gate=math.inf,
    others_gate=36.0,
    soft=4.0,
    second_order=True,
    mean=(0.936, 1.0, 0.005, 0.004, 1.0, 0.15, 0.0, 1.0, 0.0),
    std=(0.25, 0.04, 0.001, 0.002, 0.3, 0.05, 0.007, 0.3, 0.001),
    walk=(0.0003, 0.0003, 0.0, 0.0001, 0.0003, 0.0005, 0.0, 0.0, 0.0),
    drifting=(0.02, 0.02),
    jitter=0.09,
    level_std=0.7,
    wheels=IROBOT_CREATE,
    fusion="intersection",
    dependent=0.25,
    arm_m=1.0,
)


WEIGHTS = 0.04 * np.arange(24, 0, -1)


def growth(own: float, gain: float, cost: float, theirs: float, noise: float, dependent: float) -> tuple[float, float]:
    """Return the inflation of the own and the neighbour's covariance before fusion, if it helps (else 0, 0).

    Split covariance intersection: Li, Nashashibi, "Cooperative multi-vehicle localization using split covariance
    intersection filter", IEEE ITS Magazine 5(2), 2013; the weight is searched on a grid. `own` is h P h^T, `gain` are
    the weighted squares of P h^T, `cost` is the weighted trace of P, `theirs` and `noise` are variances of the bearing,
    `dependent` is the share of both covariances that may come from the same errors.
    """
    ours_by, theirs_by = 1 + dependent * (1 / WEIGHTS - 1), 1 + dependent * (1 / (1 - WEIGHTS) - 1)
    left = ours_by * cost - ours_by**2 * gain / (ours_by * own + noise + theirs * theirs_by)
    best = int(np.argmin(left))
    return (float(ours_by[best]), float(theirs_by[best])) if left[best] < cost else (0.0, 0.0)


MEMORY = 150.0  # bearings, over which what was learnt fades
LARGEST_RATIO = 9.0
HIGHEST = math.log(4.0)


class NoiseLevel:
    """The factor on the motion noise of one robot, 1 at the start.

    `std` is that of its logarithm before anything was seen, 0: fixed.

    The logarithm l of a factor on the noise's standard deviation follows the gradient of the innovations' likelihood.
    With a share s of the innovation's variance that is due to motion and r the normalised innovation squared,

        d log p / dl = s (r - 1) / 2,    E[(d log p / dl)^2] = s^2 / 2

    (in a steady state the covariance grows with the deviation of the noise, not with its square). r is bounded, so that
    an outlier has little effect; old information fades, so that the level adapts to another floor.
    """

    def __init__(self, std: float) -> None:
        self.factor = 1.0  # on variances
        self._log = 0.0
        self._prior = 1 / std**2 if std > 0 else math.inf
        self._information = 0.0

    def learn(self, ratio: float, share: float) -> None:
        """Take a normalised innovation squared, and the share of its variance that is due to motion."""
        if self._prior == math.inf:
            return
        self._information = (1 - 1 / MEMORY) * self._information + share**2 / 2
        slope = share * (min(ratio, LARGEST_RATIO) - 1) / 2 - self._prior * self._log / MEMORY
        step = slope / (self._information + self._prior)
        self._log = min(max(self._log + step, 0.0), HIGHEST)
        self.factor = math.exp(2 * self._log)
