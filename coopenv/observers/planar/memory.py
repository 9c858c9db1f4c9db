"""What a robot saw in the last half minute, carried by its odometry: what is searched when it is lost."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.commands import Step

MOST = 60  # sightings
LARGEST_ERROR = 0.3  # rad; a sighting whose bearing is less certain by now is of no use


@dataclass(frozen=True, slots=True)
class Sighting:
    """A line from the robot to a point, or the direction from a point to the robot, when it was seen."""

    time: float  # s
    target: int
    angle: float  # rad: a bearing from the robot's heading, or a direction in the map
    own: bool  # whether the robot's own camera saw it, so that the angle counts from its heading
    point: tuple[float, float]  # m, map
    variance: float  # m^2, of the point along an axis
    angle_variance: float  # rad^2
    trail: tuple[float, ...]
    """(5,) where the odometry was: x m, y m, heading rad; and the sums of its variances, rad^2 and m^2."""


@dataclass(frozen=True, slots=True)
class Lines:
    """m sightings, seen from where the robot is now: offset (m, 2) in m in its body, and so on, all (m,)."""

    offset: Array
    angle: Array  # rad, from the robot's present heading, or in the map
    own: Array  # 1 or 0
    point: Array  # (m, 2)
    variance: Array  # m^2
    angle_variance: Array  # rad^2
    target: Array


class Memory:
    """The trail of one robot's odometry, and what it saw on it."""

    def __init__(self) -> None:
        self._trail = np.zeros(5)
        self._seen: deque[Sighting] = deque(maxlen=MOST)

    def forget(self, before: float) -> None:
        """Forget the sightings before a time in s."""
        while self._seen and self._seen[0].time < before:
            self._seen.popleft()

    def move(self, step: Step) -> None:
        """Go on by what the odometry says of a tick."""
        middle = self._trail[2] + step.turned / 2
        moved = step.driven * np.cos(middle), step.driven * np.sin(middle)
        self._trail += (*moved, step.turned, step.turn_variance, step.path_variance)

    def see(
        self,
        time: float,
        target: int,
        angle: float,
        own: bool,
        point: tuple[float, float],
        variance: float,
        angle_variance: float,
    ) -> None:
        """Remember a sighting; what is given is as in `Sighting`."""
        trail = tuple(self._trail.tolist())
        self._seen.append(Sighting(time, target, angle, own, point, variance, angle_variance, trail))

    def lines(self, now: float, span: float, scale_variance: float) -> Lines:
        """Return the sightings of the last `span` in s; `scale_variance` is that of the odometry's scale of turns."""
        x, y, heading, turn_sum, path_sum = self._trail
        kept = [s for s in self._seen if now - s.time <= span]
        trail = np.array([s.trail for s in kept], dtype=float).reshape(-1, 5)
        c, sn = np.cos(heading), np.sin(heading)
        away, turned = trail[:, :2] - (x, y), trail[:, 2] - heading
        offset = np.column_stack([c * away[:, 0] + sn * away[:, 1], c * away[:, 1] - sn * away[:, 0]])
        own = np.array([float(s.own) for s in kept])
        lost = np.abs(turn_sum - trail[:, 3]) + scale_variance * turned**2
        spread = np.array([s.angle_variance for s in kept]) + own * lost
        # a heading that is wrong by now also leads astray along the way back
        drift = np.abs(path_sum - trail[:, 4]) + lost * (offset**2).sum(axis=1) / 3
        use = spread < LARGEST_ERROR**2
        return Lines(
            offset[use],
            (np.array([s.angle for s in kept]) + own * turned)[use],
            own[use],
            np.array([s.point for s in kept]).reshape(-1, 2)[use],
            (np.array([s.variance for s in kept]) + drift)[use],
            spread[use],
            np.array([s.target for s in kept])[use],
        )
