"""Planning of headings by predicted pose covariances over sampled plans; a reference for the achievable."""

from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from coopenv.policies.prediction import LEAST_ODDS, FieldOfView, Occluder, Occluders, PlanarCovariance, unhidden
from coopenv.policies.route_follower import RouteFollower, by_place
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets

OFFSETS = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6, 0.8, -0.8)  # rad, of the heading from the direction of the route
STEP, FIRST, STEPS = 0.4, 4, 10  # s; steps with the first of two offsets; steps in all
HOLD = 2  # decisions that a plan is kept
CACHED = 32  # rows that plan at once: more do not fit in a core's cache
OUTSIDE, BACK = 5.0, 0.5  # s/s for each metre too far out; s for each metre from the route at the end of a plan
LEAST_BEARING_STD = 0.001  # rad, of a frame: where there is no noise to speak of
BENT = 4.0  # weight of the linearisation variance of a bearing
FAR = 3.0  # m, distance driven without bearings after a plan
FORESIGHT = 3.0  # s; other vehicles of this kind do not drive straight on for longer
CLOSE = 20.0  # s/s for each metre that a plan comes too close to another vehicle


class _Path(NamedTuple):
    """Poses that plans have reached, (rows, plans) each, m and rad, in the own frame of the start."""

    x: np.ndarray
    y: np.ndarray
    heading: np.ndarray
    along: np.ndarray
    """Progress along the route."""
    aside: np.ndarray
    """Distance to the left of the route."""

    def moved(
        self, wanted: np.ndarray, bend: np.ndarray, stride: float, most: float
    ) -> tuple["_Path", np.ndarray, np.ndarray]:
        """Return the path a stride farther, turned to a wanted heading by so much at most, and its displacement."""
        heading = self.heading + np.clip((wanted - self.heading + np.pi) % (2 * np.pi) - np.pi, -most, most)
        dx, dy = stride * np.cos(heading), stride * np.sin(heading)
        along = self.along + stride * np.cos(heading - bend)
        return _Path(self.x + dx, self.y + dy, heading, along, self.aside + stride * np.sin(heading - bend)), dx, dy


class _Sight(NamedTuple):
    """Measurable targets in some rows."""

    landmarks: np.ndarray
    """Points (rows, K, 2), m, own frame, that are of use in any row."""
    known: np.ndarray
    """(rows, 1, K), which of them are."""
    boxes: list[Occluder]
    """Boxes that occlude the targets."""
    view: FieldOfView


class Follower(NamedTuple):
    """Another vehicle that may measure the planning one; it is predicted to drive straight on along its route.

    An entry for each of F rows of planning vehicles.
    """

    row: np.ndarray
    """(F,), of the planning vehicle."""
    vehicle: np.ndarray
    """(F,), its own number."""
    place: np.ndarray
    """(F, 2), m, in the frame of the planning vehicle."""
    forward: np.ndarray
    """(F, 2), direction of its route in that frame."""
    speed: np.ndarray
    """(F, 1), m/s."""
    covariance: PlanarCovariance
    """(F, plans), along its route and across."""


def _repeated(covariance: PlanarCovariance, count: int) -> PlanarCovariance:
    return PlanarCovariance(*(np.repeat(part, count, axis=1) for part in covariance))


class LookAhead(RouteFollower):
    """The route follower with the heading of the best of many plans.

    A plan is two headings relative to the route, one after the other. Its cost in seconds is the lost time, the cost of
    uncertainty (the standard deviation of the position, over the plan and a few metres beyond), and the
    cost of coming close to other vehicles. It gives way only to those that come too close within `FORESIGHT`: drivers
    that turn to landmarks and back do not keep their headings for longer.
    """

    needs: tuple[str, ...] = ("axis_std", "heading_std", "map_position", "route_heading", "route_offset", "route_ahead")
    remembers = 2  # decisions until the next plan, and the present one
    price = 10.0  # s/s, that a second with a standard deviation of 1 m is worth
    tolerated = 0.02  # m, standard deviation that costs nothing
    farthest = 0.8  # m, offset from the route that costs nothing
    plan_paces: tuple[float, ...] = (1.0,)
    """Speeds of plans, as shares of the top speed."""
    closest, clearance = 0.85, 1.0  # farther from others, which turn aside as it does

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.foresight = min(self.foresight, FORESIGHT)
        self.view, self.occluders = FieldOfView(scenario.camera), Occluders(scenario, self.layout)
        noise, rates = scenario.noise, scenario.rates
        per_second = rates.odometry if noise.odometry_rate == "sample" else noise.odometry_rate
        self.drift = noise.velocity**2 / per_second + (noise.odometry_scale * self.cruise) ** 2  # m^2/s
        self.turn_drift = noise.angular_velocity**2 / per_second + np.max(noise.gyro_bias) ** 2  # rad^2/s
        self.bearing = max(noise.bearing.scale, LEAST_BEARING_STD) ** 2
        self.frames = rates.camera if noise.bearing.rate == "sample" else noise.bearing.rate
        legs = [*product(self.plan_paces, OFFSETS)]
        self._legs = np.array([pace for pace, _ in legs]), np.array([offset for _, offset in legs], dtype=np.float32)
        self._pace, self._first = (np.repeat(part, len(OFFSETS)) for part in self._legs)
        self._second = np.tile(np.array(OFFSETS, dtype=np.float32), len(legs))
        landmarks, self._neighbours = len(scenario.landmarks), neighbour_sets(scenario)
        self._sees_landmarks = np.array([any(target < landmarks for target in row) for row in self._neighbours])
        self._top = np.array([limits.max_speed for limits in scenario.limits])
        self._views = [FieldOfView(camera) for camera in scenario.cameras]
        self._one_view = all(vars(view) == vars(self.view) for view in self._views)
        turns = [fields[1] for fields in self.layout.actions]
        self._sharpest = min(  # rad/m
            turn.high / self.cruise if turn.unit == "rad/s" else np.tan(turn.high) / self.wheelbase for turn in turns
        )

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        left, plan = self.memory(observations)
        blocked = self.blocked(observations)
        due = np.flatnonzero((left == 0) | blocked)
        plan[due] = self.planned(observations, due)
        left[due] = HOLD
        left -= 1
        turn, points = self.path(observations, plan, blocked)
        return np.minimum(self.speed(observations, points), self._pace[plan] * self.cruise), turn

    def rule(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what a learned policy has to keep to: (rows,) each.

        Returns:
            flags of rows that drive by a plan, because something stands in the way or they are so far off the route
            that plans lead back; speeds, m/s, which give way; turns of the plans, see `Driver.pursue`.
        """
        blocked, plan = self.blocked(observations), np.zeros(len(observations), dtype=int)
        plans = blocked | (np.abs(self.read(observations, "route_offset")[:, 0]) > self.farthest)
        due = np.flatnonzero(plans)
        plan[due] = self.planned(observations, due)
        around, points = self.path(observations, plan, blocked)
        return plans, self.speed(observations, points), around

    def blocked(self, observations: np.ndarray) -> np.ndarray:
        """Return whether something stands in the way of the rows: (rows,)."""
        return np.asarray(~self.clear(observations, self.route_points(observations)[0]))

    def planned(self, observations: np.ndarray, due: np.ndarray) -> np.ndarray:
        """Return the numbers of the best plans of the rows `due`."""
        plan = np.zeros(len(observations), dtype=int)
        due = due[np.argsort(self._sees_landmarks[due % len(self._top)], kind="stable")]
        for rows in np.split(due, range(CACHED, len(due), CACHED)):
            vehicle = rows % len(self._top)
            plan[rows] = np.argmin(self.costs(observations[rows], vehicle, self.followers(observations, rows)), axis=1)
        return np.asarray(plan[np.sort(due)])

    def path(self, observations: np.ndarray, plan: np.ndarray, blocked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the turn, see `Driver.pursue`, and the path, (rows, P, 2) in m: the plan's first leg if blocked."""
        points, distance = self.route_points(observations)
        offset, along = self._first[plan], self.pursue(self.direction(observations))
        aside = offset - self.read(observations, "route_heading")[:, 0]
        leg = distance[:, None] * np.stack([np.cos(aside), np.sin(aside)], axis=1)[:, None]
        turns = offset != 0.0
        return np.where(turns, self.pursue(aside), along), np.where((blocked & turns)[:, None, None], leg, points)

    def followers(self, observations: np.ndarray, due: np.ndarray) -> list[Follower]:
        """Return the vehicles whose losses count for the rows `due` of the observations; here none."""
        return []

    def avoided(self, senders: np.ndarray, vehicle: np.ndarray) -> np.ndarray:
        """Return flags (rows, M) of the senders that plans keep away from: all to which the vehicle gives way."""
        return self.before(senders, vehicle)

    def costs(self, observations: np.ndarray, vehicle: np.ndarray, followers: list[Follower]) -> np.ndarray:
        """Return the costs, (rows, plans) in s, for rows that are of these vehicles, (rows,)."""
        (pieces, bends), sight = self._route_pieces(observations), self._sight(observations, vehicle)
        axes, std = (10.0 ** self.read(observations, name).astype(float) for name in ("axis_std", "heading_std"))
        none = np.zeros_like(std)
        covariance = PlanarCovariance(axes[:, :1] ** 2, none, none, axes[:, 1:2] ** 2, none, std**2)
        (paces, offsets), top = self._legs, self._top[vehicle][:, None]
        zero = np.zeros((len(observations), len(offsets)), dtype=np.float32)
        now = _Path(zero, zero, zero, zero, np.repeat(self.read(observations, "route_offset"), zero.shape[1], axis=1))
        (mask, others, forward), keep = self.received(observations), self.distance_to_keep(observations)[:, None]
        senders = senders_in_slots(vehicle, self.reported(observations)[0].shape[1]) % len(self._top)
        theirs = self._top[by_place(senders, mask.shape[1])][..., None]
        followers = [each._replace(covariance=_repeated(each.covariance, zero.shape[1])) for each in followers]
        avoided, others = self.avoided(mask, vehicle), others + self.body_center * forward
        # A vehicle that gives way is expected to stand, and is passed as closely as possible.
        theirs = np.where(avoided[..., None], theirs, 0.0)
        keep = np.where(avoided, keep, self.blocking)[:, None]
        cost, missing = np.zeros_like(now.x), zero
        for step in range(STEPS):
            if step == FIRST:  # each first leg goes on with each second one
                count = len(OFFSETS)
                now = _Path(*(np.repeat(part, count, axis=1) for part in now))
                covariance = _repeated(covariance, count)
                followers = [each._replace(covariance=_repeated(each.covariance, count)) for each in followers]
                cost, missing = (np.repeat(part, count, axis=1) for part in (cost, missing))
                paces, offsets = self._pace, self._second
            stride = paces * top * STEP
            bend = np.take_along_axis(pieces, np.searchsorted(bends, now.along, side="right") - 1, axis=1)
            wanted = bend + np.where(offsets == 0.0, -np.arctan(now.aside / self.look_ahead), offsets)
            now, dx, dy = now.moved(wanted, bend, stride, self._sharpest * stride)
            covariance = covariance.driven(dx, dy, self.drift * STEP, self.turn_drift * STEP)
            place = np.stack([now.x, now.y], axis=-1)
            covariance = self._measured(covariance, sight, place, now.heading, STEP * (step + 1))
            # Uncertainty costs per metre: what a slow plan does not drive is counted at its end.
            cost = cost + STEP * self.price * paces * np.maximum(covariance.std - self.tolerated, 0.0)
            missing = missing + (1.0 - paces) * top * STEP
            followers = [self.follow(each, STEP * (step + 1), place, covariance) for each in followers]
            for each in followers:
                cost[each.row] += STEP * self.price * np.maximum(each.covariance.std - self.tolerated, 0.0)
            cost = cost + STEP * OUTSIDE * np.maximum(np.abs(now.aside) - self.farthest, 0.0)
            # Vehicles to give way to are expected to drive straight on at top speed.
            driven = theirs * (STEP * (step + 1)) * forward
            center = place + self.body_center * np.stack([np.cos(now.heading), np.sin(now.heading)], axis=-1)
            apart = (others + driven)[:, None] - center[:, :, None]
            lacking = keep - np.linalg.norm(apart, axis=-1)
            cost = cost + STEP * CLOSE * np.max(lacking, axis=2, where=mask[:, None], initial=0.0)
        rest = FAR + missing
        later = covariance.driven(rest * np.cos(now.heading), rest * np.sin(now.heading), 0.0, 0.0)
        cost = cost + self.price * rest / top * np.maximum(later.std - self.tolerated, 0.0)
        for each in followers:
            later = each.covariance.driven(np.array(FAR), np.array(0.0), 0.0, 0.0)
            cost[each.row] += self.price * FAR / each.speed * np.maximum(later.std - self.tolerated, 0.0)
        # An observed offset is clipped at its scale and may be larger: from there no plan leads farther away.
        aside = self.read(observations, "route_offset")
        away = (np.abs(aside) >= self.layout["route_offset"].scale) & (self._first * aside > 0.0)
        return np.where(away, np.inf, cost - now.along / top + BACK * np.abs(now.aside))

    def _sight(self, observations: np.ndarray, vehicle: np.ndarray) -> _Sight:
        """Return the measurable targets in the rows of these vehicles."""
        known = (self.known(observations) & self._sees_landmarks[vehicle][:, None])[:, None]
        useful = known.any(axis=(0, 1))
        landmarks = self.read(observations, "map_position")[..., :2][:, useful]
        view = self.view if self._one_view else FieldOfView.of_rows(self._views, vehicle)
        return _Sight(landmarks, known[..., useful], self.occluders.boxes(partial(self.read, observations)), view)

    def _measured(
        self, covariance: PlanarCovariance, sight: _Sight, place: np.ndarray, heading: np.ndarray, time: float
    ) -> PlanarCovariance:
        """Return a covariance after the bearings that can be expected at places (rows, plans, 2), m, at a time, s."""
        line = sight.landmarks[:, None] - place[:, :, None]
        bearing, radial, lateral = covariance.along(line)
        odds = sight.view.odds(line, heading[..., None], np.sqrt(bearing), np.sqrt(radial)) * sight.known
        camera = place + sight.view.ahead * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        odds = odds * unhidden(sight.boxes, odds > LEAST_ODDS, camera, sight.landmarks, self.cruise * time)
        return covariance.measured(line, self.bearing_variance(line, radial, lateral), odds)

    def follow(self, follower: Follower, time: float, place: np.ndarray, covariance: PlanarCovariance) -> Follower:
        """Return a follower a step later, after the bearings to this vehicle that it can be expected to have.

        Args:
            follower: a step ago.
            time: since the observation, s.
            place: (rows, plans, 2), m, of this vehicle.
            covariance: (rows, plans), of this vehicle.
        """
        row, stride = follower.row, follower.speed * STEP
        own = follower.covariance.driven(stride, np.zeros_like(stride), self.drift * STEP, self.turn_drift * STEP)
        offset = place[row] - (follower.place + follower.speed * time * follower.forward)[:, None]
        x, y = (follower.forward[:, None, k] for k in (0, 1))
        ahead, left = x * offset[..., 0] + y * offset[..., 1], x * offset[..., 1] - y * offset[..., 0]
        line = np.stack([ahead, left], axis=-1)[:, :, None]
        bearing, radial, lateral = own.along(line)
        view = FieldOfView.of_rows(self._views, follower.vehicle)
        odds = view.odds(line, np.zeros((1, 1, 1)), np.sqrt(bearing), np.sqrt(radial))
        sender = PlanarCovariance(*(part[row] for part in covariance)).along(offset[:, :, None])[2]
        variance = self.bearing_variance(line, radial, lateral) + sender / _square(line)
        return follower._replace(covariance=own.measured(line, variance, odds))

    def bearing_variance(self, line: np.ndarray, radial: np.ndarray, lateral: np.ndarray) -> np.ndarray:
        """Return the variances, rad^2, of all bearings of a step along lines (..., 2), m, with that of linearisation.

        The other arguments are the variances of the distance and across it, m^2.
        """
        linearisation_variance = BENT * radial * lateral / _square(line) ** 2
        return np.asarray((self.bearing + linearisation_variance) / (self.frames * STEP))

    def _route_pieces(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the directions of the pieces of the route (rows, P), rad, own frame, and where they begin, (P,), m."""
        points, distance = self.route_points(observations)
        heading = -self.read(observations, "route_heading")[:, 0]
        leg = np.diff(points[:, 1:], axis=1)
        return np.column_stack([heading, np.arctan2(leg[..., 1], leg[..., 0])]), distance[:-1]


def _square(line: np.ndarray) -> np.ndarray:
    return np.asarray(np.maximum(line[..., 0] ** 2 + line[..., 1] ** 2, 0.01))


def senders_in_slots(vehicle: np.ndarray, slots: int) -> np.ndarray:
    """Return the vehicle whose message is in each slot, (rows, slots): all but the receiver, in order."""
    slot = np.arange(slots)
    return np.asarray(slot + (slot >= vehicle[:, None]))
