"""Planning what to look at: the belief rolled forward over sampled plans. A yardstick of what is possible."""

from functools import partial
from itertools import product

import numpy as np

from coopenv.policies.belief import Belief
from coopenv.policies.occluders import Occluders, unhidden
from coopenv.policies.route_follower import RouteFollower
from coopenv.policies.view import FieldOfView
from coopenv.scenario import Scenario

OFFSETS = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6, 0.8, -0.8)  # rad, of the heading from that of the way
STEP, FIRST, STEPS = 0.4, 4, 10  # s; steps with the first of two offsets; steps in all
HOLD = 2  # decisions that a plan is kept
OUTSIDE, BACK = 5.0, 0.5  # s/s for each metre too far out; s for each metre from the way at the end of a plan
FAR = 3.0  # m, how much farther one would drive blind after a plan


class LookAhead(RouteFollower):
    """The route follower with the heading of the best of many plans.

    A plan is two headings off the way, one after the other. Its cost in seconds is the time that it loses, and what its
    uncertainty costs: the standard deviation of the position, over the plan and a few metres beyond.
    """

    needs = ("axis_std", "heading_std", "map_position", "route_heading", "route_offset", "route_ahead")

    def __init__(
        self,
        scenario: Scenario,
        *,
        price: float = 4.0,
        tolerated: float = 0.02,
        bearing_std: float = 0.01,
        drift: float = 0.05,
        farthest: float = 0.8,
    ) -> None:
        """Choose what matters.

        Args:
            scenario: of the environment.
            price: seconds that a second with a standard deviation of 1 m is worth.
            tolerated: standard deviation that costs nothing, m.
            bearing_std: of what one step tells of a landmark in view, rad.
            drift: growth of the standard deviation by odometry, m per root metre.
            farthest: offset from the way that costs nothing, m.
        """
        super().__init__(scenario)
        self.view, self.occluders = FieldOfView(scenario.camera), Occluders(scenario, self.layout)
        self.price, self.tolerated, self.farthest = price, tolerated, farthest
        self.information, self.drift = bearing_std**-2, drift**2
        plans = product(OFFSETS, repeat=2)
        self._first, self._second = (np.array(part, dtype=np.float32) for part in zip(*plans, strict=True))
        self._sharpest = np.tan(self.layout.action[1].high) / self.wheelbase  # rad/m
        self._left = np.zeros(0, dtype=int)
        self._plan = np.zeros(0, dtype=int)

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the rows of a mask."""
        if len(mask) != len(self._left):
            self._left, self._plan = (np.zeros(len(mask), dtype=int) for _ in range(2))
        self._left[mask] = 0

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        if len(observations) != len(self._left):
            self.reset(np.ones(len(observations), dtype=bool))
        due = np.flatnonzero(self._left == 0)
        if len(due):
            self._plan[due] = np.argmin(self.costs(observations[due]), axis=1)
            self._left[due] = HOLD
        self._left -= 1
        heading = self.read(observations, "route_heading")[:, 0]
        offset = self._first[self._plan]
        along = self.pursue(self.direction(observations))
        steering = np.where(offset == 0.0, along, self.pursue(offset - heading))
        return self.speed(observations), steering

    def costs(self, observations: np.ndarray) -> np.ndarray:
        """Return the costs, (rows, plans) in s."""
        way, bends = self._way(observations)
        landmarks = self.read(observations, "map_position")[..., :2]
        boxes = self.occluders.boxes(partial(self.read, observations))
        known = self.information * self.known(observations)[:, None]
        belief = self._belief(observations)
        shape = len(observations), len(self._first)
        x, y, heading, along = (np.zeros(shape, dtype=np.float32) for _ in range(4))
        aside = np.repeat(self.read(observations, "route_offset"), shape[1], axis=1)
        cost = np.zeros(shape)
        stride = self.cruise * STEP
        for step in range(STEPS):
            bend = np.take_along_axis(way, np.searchsorted(bends, along, side="right") - 1, axis=1)
            offset = self._first if step < FIRST else self._second
            wanted = bend + np.where(offset == 0.0, -np.arctan(aside / self.look_ahead), offset)
            most = self._sharpest * stride
            heading = heading + np.clip((wanted - heading + np.pi) % (2 * np.pi) - np.pi, -most, most)
            dx, dy = stride * np.cos(heading), stride * np.sin(heading)
            x, y = x + dx, y + dy
            along = along + stride * np.cos(heading - bend)
            aside = aside + stride * np.sin(heading - bend)
            place, forward = np.stack([x, y], axis=-1), np.stack([np.cos(heading), np.sin(heading)], axis=-1)
            line = landmarks[:, None] - place[:, :, None]
            seen = self.view.sees(line, heading[..., None]) & (known > 0.0)
            seen = unhidden(boxes, seen, place + self.view.ahead * forward, landmarks, stride * (step + 1))
            belief = belief.driven(dx, dy, self.drift * stride, 1e-5).measured(line, known * seen)
            cost += STEP * self.price * np.maximum(belief.std - self.tolerated, 0.0)
            cost += STEP * OUTSIDE * np.maximum(np.abs(aside) - self.farthest, 0.0)
        later = belief.driven(FAR * np.cos(heading), FAR * np.sin(heading), 0.0, 0.0)
        cost += self.price * FAR / self.cruise * np.maximum(later.std - self.tolerated, 0.0)
        return np.asarray(cost - along / self.cruise + BACK * np.abs(aside))

    def _way(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the directions of the pieces of the way, (rows, P), rad, own frame, and where they begin, (P,), m."""
        points, distance = self.way_ahead(observations)
        heading = -self.read(observations, "route_heading")[:, 0]
        leg = np.diff(points[:, 1:], axis=1)
        ahead = np.arctan2(leg[..., 1], leg[..., 0])
        return np.column_stack([heading, ahead]), distance[:-1]

    def _belief(self, observations: np.ndarray) -> Belief:
        """Return the covariance as far as the observation tells of it, (rows, 1)."""
        axes, heading = (10.0 ** self.read(observations, name).astype(float) for name in ("axis_std", "heading_std"))
        none = np.zeros_like(heading)
        return Belief(axes[:, :1] ** 2, none, none, axes[:, 1:2] ** 2, none, heading**2)
