"""The baseline: along the route at full speed, giving way to vehicles whose messages it receives."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import product

import numpy as np

from coopenv.api.terms.layout import RADIO, observation_layout
from coopenv.policies.right_of_way import at_arc_lengths, discs_along, nearest, right_of_way
from coopenv.scenario import Scenario

MULTIPLES = np.array([1.0, 2.0, 4.0, 8.0])
"""Distances ahead of the entries of `route_ahead`, as multiples of `observation.route_step`."""

SMALL = (0.586, 0.25)
"""Length and width, m, of the car that distances are chosen for (SVEA); they grow with larger ones."""

LEAST_CURVATURE = 1e-6
"""1/m; a smaller one counts as straight on."""

PURSUED = 5.0
"""Decisions, at least, until a vehicle reaches the pursued point, so that it steers before it is past it."""


class Driver(ABC):
    """A policy that chooses speed and steering, or turn rate, for every row from its observation alone."""

    needs: tuple[str, ...] = ()
    """Fields of the observation without which it cannot drive."""
    remembers = 0
    """Number of values that it remembers of every row."""

    def __init__(self, scenario: Scenario, *, cruise: float | None = None) -> None:
        """Learn where everything stands in an observation.

        Args:
            scenario: of the environment.
            cruise: speed when nothing is in the way, m/s; also what others are expected to drive (None: top speed).

        Raises:
            ValueError: the observation lacks a field, or the environment does not take speeds and steering.
        """
        if scenario.action.longitudinal != "speed":
            raise ValueError("it chooses speeds, so it needs action.longitudinal = 'speed'")
        self.layout = observation_layout(scenario)
        for speed, turn, *_ in self.layout.actions:
            if speed.unit != "m/s" or turn.unit not in ("rad", "rad/s"):
                units = f"{speed.name} in {speed.unit} and {turn.name} in {turn.unit}"
                raise ValueError(
                    f"it chooses a speed (m/s) and a steering angle (rad) or turn rate (rad/s), not {units}"
                )
        self._by_rate = np.array([turn.unit == "rad/s" for _, turn, *_ in self.layout.actions])
        """(N,), which vehicles turn by a rate, not by an angle."""
        self.agents = scenario.target_names[len(scenario.landmarks) :]
        """Names of the vehicles in the order of rows."""
        known = {*self.layout, "route" if {"route_ahead", "goal"} & {*self.layout} else ""}
        if missing := [name for name in (*self.needs, "route") if name not in known]:
            raise ValueError(f"the observation lacks {', '.join(missing)} (route: the group route or goal)")
        self.cruise = self.layout.action[0].high if cruise is None else cruise
        self.look_ahead = max(1.0, PURSUED * self.cruise / scenario.rates.decision)
        """Distance of the pursued point of the route, m."""
        driven = [vehicle.body for vehicle in scenario.vehicles if vehicle.motion.kind == "driven" and vehicle.body]
        (self.length, self.width, _), (self.body_center, *_) = max(
            ((body.size, body.center) for body in driven), default=((*SMALL, 0.0), (0.0,))
        )
        self.scale = max(1.0, self.length / SMALL[0])
        self.midway = scenario.cosimulator is not None and scenario.cosimulator.reference_midway
        self.wheelbase = self.length if self.midway else scenario.dynamics.wheelbase
        self._distances = scenario.observation.route_step * MULTIPLES
        self._memory = np.zeros((self.remembers, 0), dtype=int)

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the rows of a mask: their memory is 0."""
        self.memory(mask)[:, mask] = 0

    def memory(self, rows: np.ndarray) -> np.ndarray:
        """Return the memory (remembers, rows); 0 if the number of rows has changed."""
        if len(rows) != self._memory.shape[1]:
            self._memory = np.zeros((self.remembers, len(rows)), dtype=int)
        return self._memory

    @abstractmethod
    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return speed, m/s, turn (see `pursue`), and maybe the camera's pan, rad to the left, (rows,) each."""

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions, (rows, A), for observations (rows, D)."""
        actions = self.levels(*self.drive(np.asarray(observations, dtype=np.float32)))
        actions[:, [field.name.startswith(RADIO) for field in self.layout.action]] = 1.0  # it sends whole reports
        return actions

    def levels(self, speed: np.ndarray, turn: np.ndarray, pan: np.ndarray | None = None) -> np.ndarray:
        """Return the actions, (rows, A), for what `drive` has returned; other entries are 0.

        A vehicle that cannot turn so fast drives more slowly, along the same circle.
        """
        actions = np.zeros((len(speed), len(self.layout.action)), dtype=np.float32)
        by_rate = self._in_rows(self._by_rate, len(speed))
        for rate in (False, True):
            rows = by_rate == rate
            if not rows.any():
                continue
            fields = self.layout.actions[int(np.argmax(self._by_rate == rate))]
            wanted = [speed[rows], turn[rows]]
            if rate:
                curvature = wanted[1] / self.cruise
                wanted[0] = np.minimum(wanted[0], fields[1].high / np.maximum(np.abs(curvature), LEAST_CURVATURE))
                wanted[1] = curvature * wanted[0]
            for k, values in enumerate(wanted):
                actions[rows, k] = np.clip(fields[k].level(values), -1.0, 1.0)
        if pan is not None:
            place = next(k for k, field in enumerate(self.layout.action) if field.name == "pan")
            actions[:, place] = np.clip(self.layout.action[place].level(pan), -1.0, 1.0)
        return actions

    def _in_rows(self, of_vehicles: np.ndarray, rows: int) -> np.ndarray:
        """Return a property of the vehicles, (N,), by rows; where they are not of all vehicles, the first one's."""
        vehicles = len(of_vehicles)
        return np.resize(of_vehicles, rows) if rows % vehicles == 0 else np.full(rows, of_vehicles[0])

    def read(self, observations: np.ndarray, name: str) -> np.ndarray:
        """Return a field of the observations in its unit, (rows, *shape)."""
        return self.layout[name].values(observations)

    def known(self, observations: np.ndarray) -> np.ndarray:
        """Return flags (rows, K) of existing landmarks of the map: all, if the observation has no `map_mask`."""
        if "map_mask" in self.layout:
            return self.read(observations, "map_mask") > 0.5
        return np.ones((len(observations), self.layout["map_position"].shape[0]), dtype=bool)

    def route_points(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points of the route ahead, (rows, P, 2), m, own frame, and their arc lengths from here, (P,), m.

        The first is the vehicle's own place. Without the group `route` the route leads straight to the goal.
        """
        distance = np.concatenate([[0.0], self._distances])
        if "route_ahead" in self.layout:
            angle = self.read(observations, "route_ahead")
        else:
            goal = self.read(observations, "goal")
            angle = np.repeat(np.arctan2(goal[:, 1], goal[:, 0])[:, None], len(self._distances), axis=1)
        points = self._distances[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.concatenate([np.zeros((len(points), 1, 2)), points], axis=1), distance

    def direction(self, observations: np.ndarray) -> np.ndarray:
        """Return the direction, (rows,) in rad from straight ahead, of the pursued point of the route."""
        points, distance = self.route_points(observations)
        place = int(np.clip(np.searchsorted(distance, self.look_ahead), 1, len(distance) - 1))
        share = np.clip((self.look_ahead - distance[place - 1]) / (distance[place] - distance[place - 1]), 0.0, 1.0)
        point = points[:, place - 1] + share * (points[:, place] - points[:, place - 1])
        return np.asarray(np.arctan2(point[:, 1], point[:, 0]))

    def pursue(self, direction: np.ndarray) -> np.ndarray:
        """Return what leads along a circle to a point `look_ahead` away in a direction, (rows,), rad.

        That is the steering angle (rad), or of a drive without steering the turn rate (rad/s) at the speed `cruise`.

        Source: Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, 1992. What lies behind counts as
        beside.
        """
        turn = np.clip((direction + np.pi) % (2.0 * np.pi) - np.pi, -np.pi / 2.0, np.pi / 2.0)
        circle = self.look_ahead + (self.wheelbase * np.cos(turn) if self.midway else 0.0)
        steering = np.arctan(2.0 * self.wheelbase * np.sin(turn) / circle)
        if not self._by_rate.any():
            return np.asarray(steering)
        rate = self.cruise * 2.0 * np.sin(turn) / circle
        return np.asarray(np.where(self._in_rows(self._by_rate, len(turn)), rate, steering))


GAP = 0.25
"""m, between bodies."""

SOON = 1.0
"""s; cars that stop within this drive at full speed or stand; slower cars are long between the two."""

REACTION = 0.5
"""s; cars that stop slowly look ahead for as long as stopping takes and this: their guesses are good for no longer."""


SAME_WAY = np.cos(np.pi / 4.0)
"""Cosine of the angle up to which a car drives the same way; one behind that does keeps its own distance."""

LEAP = 2.0
"""m, by which a car's reported place changes at most by corrections. Where landmarks are rare, 1.5 costs arrivals."""

PATIENCE, STANDING = 3.0, 0.5
"""Waiting time (s) below a speed (m/s), after which a car expects other vehicles to keep their motion, until it drives
at half of its top speed."""

LEAST_MOVED = 0.2
"""m, that a car has driven at least before the curvature of its way is measured in full."""

PREDICTED = 11
"""Points in time of a predicted motion of a car that stops slowly."""


class RouteFollower(Driver):
    """Pure pursuit of the route by the vehicle's own estimate; stops where driving on comes too close to vehicles.

    In the leader-follower order a vehicle receives from its leaders only, so giving way to senders cannot deadlock.
    Where all driven vehicles receive each other's messages, those before it in order have the right of way, and it
    waits for the others only while they block its way. A sender whose place leaps farther than it can drive may lie:
    it counts twice, where it reports to be, and where it would be without the leap.
    """

    clearance = 0.9
    """Distance to keep between reference points, m, without a standard deviation of the own position."""
    closest = 0.75
    """Distance to keep at a certain position, m; its standard deviation is added, up to `clearance`. Both are at least
    the distance of perpendicular cars `GAP` apart."""

    def __init__(self, scenario: Scenario, *, cruise: float | None = None) -> None:
        """See `Driver`."""
        super().__init__(scenario, cruise=cruise)
        self.braking = scenario.dynamics.max_acceleration
        stopping = self.cruise / self.braking
        self.nimble = nimble = stopping <= SOON
        self.goes_first = right_of_way(scenario)
        """(N, N - 1), whether a vehicle has the right of way over the sender of each message."""
        traffic = [vehicle.motion.kind == "traffic" for vehicle in scenario.vehicles]
        self.traffic = np.array([traffic[:i] + traffic[i + 1 :] for i in range(len(traffic))])
        self.senders_known = scenario.topology.most_nearby is None
        if not self.senders_known:
            self.traffic = np.zeros_like(self.goes_first)
        """(N, N - 1), which senders are cars of a backend's traffic."""
        self.discs = self.body_center + (np.zeros(1) if nimble else discs_along(self.length, self.width))
        """Centres of the discs that cover a car, m ahead of its reference point; a nimble car is one disc."""
        reach = (self.length + self.width) / 2.0 if nimble else np.hypot(self.length / len(self.discs), self.width)
        more = (self.clearance - self.closest) * self.scale
        self.closest = max(self.closest if nimble else 0.0, reach + GAP)
        self.clearance = max(self.clearance, self.closest) if nimble else self.closest + more
        self.blocking = reach + 0.4 * GAP
        """Distance, m, below which a vehicle blocks the way."""
        self.foresight = 6.0 if nimble else stopping + REACTION
        """Time (s) ahead in which other vehicles count."""
        self.period = 1.0 / scenario.rates.decision
        self._last = (np.zeros((0, 0), dtype=bool), *(np.zeros((0, 0, 0)) for _ in range(4)), np.zeros(0))
        """Last decision: messages, positions, directions, ages and motions of senders; standing time, s."""
        self._reported = (np.zeros((0, 0), dtype=bool), *(np.zeros((0, 0, 0)) for _ in range(3)))
        """Reports of the last decision: senders, their positions, ages (s) and jumps (m)."""
        self.paces = (1.0,) if nimble else (0.0, 0.25, 0.5, 0.75, 1.0)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """See `Driver.__call__`; the jumps of senders are appended to the observations."""
        observations = np.asarray(observations, dtype=np.float32)
        return super().__call__(np.concatenate([observations, self.leaps(observations)], axis=1))

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        return self.speed(observations), self.pursue(self.direction(observations))

    def leaps(self, observations: np.ndarray) -> np.ndarray:
        """Return the jumps of senders (rows, 2 M), m, own frame; no columns where they are unknown."""
        known = {"message_position", "message_age", "velocity", "angular_velocity"} <= {*self.layout}
        if not known or not self.senders_known:
            return np.zeros((len(observations), 0), dtype=np.float32)
        mask, place, _ = self.reported(observations)
        age, there = self.read(observations, "message_age")[..., None], mask[..., None]
        if len(self._reported[0]) != len(place):
            self._reported = np.zeros_like(mask), place, age, np.zeros_like(place)
        received, before, aged, leapt = self._reported
        turn = -self.period * self.read(observations, "angular_velocity")[:, -1]
        driven = [self.period, 0.0] * self.read(observations, "velocity")[:, None, :1]
        stood = _turned(before - driven, turn)
        observed = np.maximum(np.abs(place), np.abs(before)).max(axis=-1) < self.layout["message_position"].scale
        apart = np.linalg.norm(place - stood, axis=-1)
        most = LEAP * self.scale + 2.0 * self.cruise * (self.period + np.abs(age - aged)[..., 0])
        leaps = mask & received & observed & (apart > most)
        leapt = _turned(leapt, turn) + np.where(leaps[..., None], place - stood, 0.0)
        age = np.where(there, age, aged + self.period)
        self._reported = mask | received, np.where(there, place, stood), age, leapt
        return leapt.reshape(len(place), -1).astype(np.float32)

    def received(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the result of `reported`, followed by senders that have jumped, at extrapolated positions."""
        mask, place, forward = self.reported(observations)
        if observations.shape[1] == self.layout.size:
            return mask, place, forward
        leapt = observations[:, self.layout.size :].reshape(place.shape)
        where = np.concatenate([place, place - leapt], axis=1)
        return np.concatenate([mask, mask & leapt.any(axis=-1)], axis=1), where, np.tile(forward, (1, 2, 1))

    def reported(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the senders of received messages, (rows, M), their places and directions, (rows, M, 2), own frame.

        Where no vehicle can send there is one sender, and no message from it.
        """
        if "message_mask" not in self.layout or 0 in self.layout["message_mask"].shape:
            none = np.zeros((len(observations), 1, 2))
            return none[..., 0] > 0.0, none, none
        mask = self.read(observations, "message_mask") > 0.5
        place, forward = (self.read(observations, f"message_{name}")[..., :2] for name in ("position", "forward"))
        return mask, place, forward

    def before(self, senders: np.ndarray, vehicle: np.ndarray) -> np.ndarray:
        """Return flags (rows, M) of the senders to which the rows' vehicles, (rows,), give way."""
        if not self.goes_first.any():
            return senders
        return np.asarray(senders & ~by_place(self.goes_first[vehicle], senders.shape[1]))

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Return the speeds, (rows,) in m/s: nothing, where going on comes too close and waiting does not.

        Others are expected to go on at one of the velocities of `motions`.

        Args:
            observations: (rows, D).
            points: the way ahead in place of that of `route_points`.
        """
        mask, place, forward = self.received(observations)
        route, distance = self.route_points(observations)
        points = route if points is None else points
        clear = self.clear(observations, points)
        if not self.nimble:
            mask = mask & ((place[..., 0] > 0.0) | (forward[..., 0] < SAME_WAY))
        keep, count = self.distance_to_keep(observations), len(self.discs)
        *velocities, curvature = self.motions(observations, mask, place, forward)
        velocities = [np.repeat(v, count, axis=1) for v in velocities]
        bends = None if self.nimble else np.repeat(curvature, count, axis=1)
        place = self._covered(place, forward)
        vehicles = len(self.goes_first)
        if len(mask) % vehicles == 0:  # else the rows are of unknown vehicles, which give way to all
            mask = self.before(mask, np.arange(len(mask)) % vehicles)
        mask = np.repeat(mask, count, axis=1)

        def least(paths: Sequence[np.ndarray], times: np.ndarray) -> np.ndarray:
            every = product(paths, velocities)
            found = [nearest(p, times, place, v, mask, self.foresight, bends) for p, v in every]
            return np.asarray(np.min(found, axis=0))

        if self.nimble:
            centers = self.body_centers(points)
            going = least([centers], distance / self.cruise)
            waiting = least([np.repeat(centers[:, :1], 2, axis=1)], np.array([0.0, 1.0]))
        else:
            times = np.linspace(0.0, self.foresight, PREDICTED)
            s = self.going(observations, times)
            going, waiting = (least(self.swept(points, distance, arcs), times) for arcs in (s, 0.0 * s))
        return np.where(clear & ((going >= keep) | (going > np.maximum(waiting, self.blocking))), self.cruise, 0.0)

    def clear(self, observations: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return whether no sender that stands where it is would block a way by the points, (rows, P, 2) in m.

        Those who never have the right of way keep a larger distance to others than one that blocks.
        """
        if not self.goes_first.any():
            return np.ones(len(points), dtype=bool)
        mask, place, forward = self.received(observations)
        if not self.nimble:
            mask = mask & ((place[..., 0] > 0.0) | (forward[..., 0] < SAME_WAY))
        place, mask = self._covered(place, forward), np.repeat(mask, len(self.discs), axis=1)
        near = np.linalg.norm(place - [self.body_center, 0.0], axis=-1).min(axis=1, where=mask, initial=np.inf)
        times, soon = np.concatenate([[0.0], self._distances]) / self.cruise, SOON if self.nimble else self.foresight
        found = nearest(self.body_centers(points), times, place, np.zeros_like(place), mask, soon)
        return np.asarray(found >= np.minimum(self.blocking, near))

    def _covered(self, place: np.ndarray, forward: np.ndarray) -> np.ndarray:
        """Return the centres, (rows, M times discs, 2), of the discs of cars at places (rows, M, 2)."""
        centres = place[:, :, None] + self.discs[:, None] * forward[:, :, None]
        return np.asarray(centres.reshape(len(place), -1, 2))

    def body_centers(self, points: np.ndarray) -> np.ndarray:
        """Return the centers (rows, P, 2), m, of the own body with the reference point at the points of a path."""
        ways = np.diff(points, axis=1)
        ways /= np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-9)
        ahead = np.concatenate([np.broadcast_to([1.0, 0.0], ways[:, :1].shape), ways], axis=1)
        return np.asarray(points + self.body_center * ahead)

    def motions(
        self, observations: np.ndarray, mask: np.ndarray, place: np.ndarray, forward: np.ndarray
    ) -> list[np.ndarray]:
        """Return velocities that senders may have, (rows, M, 2) in m/s each, and the curvature of their way, (rows, M).

        Velocities are `paces` of the speed `cruise`. A car that stops slowly also measures both by two messages, in its
        own frame, whose motion is that of the odometry. When it has stood for `PATIENCE` it expects of the traffic only
        what it has measured: otherwise both might wait for each other for ever.
        """
        expected = [pace * self.cruise * forward for pace in self.paces]
        if self.nimble or not {"velocity", "angular_velocity", "message_age"} <= {*self.layout}:
            return [*expected, np.zeros(mask.shape)]
        speed = self.read(observations, "velocity")[:, 0]
        turn = -self.period * self.read(observations, "angular_velocity")[:, -1]
        age = by_place(self.read(observations, "message_age"), mask.shape[1])[..., None]
        if len(self._last[0]) != len(place):
            unknown = np.full((*mask.shape, 3), np.nan)
            self._last = np.zeros_like(mask), place, forward, age, unknown, np.zeros(len(place))
        received, before, pointed, aged, motion, stood = self._last
        moved = place - _turned(before - [self.period, 0.0] * speed[:, None, None], turn)
        pointed = _turned(pointed, turn)
        veer = pointed[..., 0] * forward[..., 1] - pointed[..., 1] * forward[..., 0]  # sine of the angle turned by
        bend = veer / np.maximum(np.linalg.norm(moved, axis=-1), LEAST_MOVED)
        span = self.period + aged - age  # s, between the sendings
        new = np.concatenate([moved / np.maximum(span, self.period / 2.0), bend[..., None]], axis=-1)
        motion = np.where(span > self.period / 2.0, new, motion)
        motion[~(mask & received)] = np.nan
        stood = np.where(speed < STANDING, stood + self.period, np.where(speed < self.cruise / 2.0, stood, 0.0))
        self._last = mask, place, forward, age, motion, stood
        waits = (stood < PATIENCE)[:, None, None]
        if len(place) % len(self.traffic) == 0:
            traffic = self.traffic[np.arange(len(place)) % len(self.traffic)]
            waits = waits | ~by_place(traffic, mask.shape[1])[..., None]
        measured = np.where(np.isnan(motion[..., :2]), expected[-1], motion[..., :2])
        return [measured, *(np.where(waits, each, measured) for each in expected), np.nan_to_num(motion[..., 2])]

    def reset(self, mask: np.ndarray) -> None:
        """See `Driver.reset`."""
        super().reset(mask)
        if len(self._reported[0]) == len(mask):
            self._reported[0][mask], self._reported[-1][mask] = False, 0.0
        if len(self._last[0]) == len(mask):
            self._last[0][mask], self._last[-1][mask] = False, 0.0

    @property
    def state(self) -> list[np.ndarray]:
        """Copies of what it remembers of every row; they can be set."""
        return [values.copy() for values in (self._memory, *self._reported, *self._last)]

    @state.setter
    def state(self, state: Sequence[np.ndarray]) -> None:
        self._memory, received, place, age, leapt, *last = state
        self._reported, self._last = (received, place, age, leapt), tuple(last)

    def going(self, observations: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the arc lengths, (rows, P) in m, at times (P,) in s of going on at full speed."""
        speed = np.full((len(observations), 1), self.cruise)
        if "velocity" in self.layout:
            speed = np.clip(self.read(observations, "velocity")[:, :1], 0.0, self.cruise)
        gains = np.minimum(times, (self.cruise - speed) / self.braking)
        return np.asarray(speed * times + self.braking * gains * (times - gains / 2.0))

    def swept(self, points: np.ndarray, distance: np.ndarray, s: np.ndarray) -> list[np.ndarray]:
        """Return the centres of the own discs, (rows, P, 2) each, at arc lengths (rows, P) of the route."""
        along = [at_arc_lengths(points, distance, arc) for arc in (s, s + 0.1)]
        forward = along[1] - along[0]
        forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
        return [along[0] + ahead * forward for ahead in self.discs]

    def distance_to_keep(self, observations: np.ndarray) -> np.ndarray:
        """Return the distances to keep, (rows,) in m: they grow with the standard deviation of the own position."""
        if "position_std" not in self.layout:
            return np.full(len(observations), self.clearance)
        std = 10.0 ** self.read(observations, "position_std")[:, 0]
        return np.asarray(np.minimum(self.closest + std, self.clearance))


def by_place(of_senders: np.ndarray, places: int) -> np.ndarray:
    """Return a table (rows, M) of the senders by their places, which are two for each, see `received`, or one."""
    return np.tile(of_senders, (1, places // max(1, of_senders.shape[1])))


def _turned(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return vectors (rows, M, 2) turned by angles (rows,), rad."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack([c * vectors[..., 0] - s * vectors[..., 1], s * vectors[..., 0] + c * vectors[..., 1]], axis=-1)
