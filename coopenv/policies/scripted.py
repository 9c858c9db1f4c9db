"""Simple drivers: at constant speed, by cars ahead or behind, waiting when lost, or turning to landmarks.

The baseline is in route_follower.py.
"""

from functools import partial

import numpy as np

from coopenv.policies.look_ahead import OFFSETS
from coopenv.policies.prediction import FieldOfView, Occluders, unhidden
from coopenv.policies.route_follower import Driver, RouteFollower
from coopenv.scenario import Scenario


class ConstantSpeed(Driver):
    """Straight on at full speed, whatever happens."""

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        return np.full(len(observations), self.cruise), np.zeros(len(observations))


class IntelligentDriver(RouteFollower):
    """Pure pursuit of the route, at the speed that keeps a time gap to the nearest sender on it.

    Source: Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and microscopic
    simulations, Physical Review E 62, 2000. It has no rules of priority: vehicles that cross its route count once they
    are on it.
    """

    needs = ("velocity",)
    time_gap = 0.8  # s, to the vehicle ahead
    standstill_gap = 0.3  # m, between bumpers
    acceleration = 1.0  # m/s^2, largest
    deceleration = 1.5  # m/s^2, comfortable
    half_width = 0.5  # m, distance from the route within which a vehicle is on it

    def __init__(self, scenario: Scenario, *, cruise: float | None = None) -> None:
        """See `Driver`."""
        super().__init__(scenario, cruise=cruise)
        bodies = [vehicle.body.size[0] for vehicle in scenario.vehicles if vehicle.body]
        self.length = max(bodies, default=0.0)

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Return the speeds, (rows,) in m/s, that the model's acceleration leads to until the next decision."""
        own = np.maximum(self.read(observations, "velocity")[:, 0], 0.0)
        gap, closing = self._ahead(observations, own)
        wanted = own * self.time_gap + own * closing / (2.0 * np.sqrt(self.acceleration * self.deceleration))
        wanted = self.standstill_gap + np.maximum(wanted, 0.0)
        free = 1.0 - (own / self.cruise) ** 4
        acceleration = self.acceleration * (free - (wanted / np.maximum(gap, 0.05)) ** 2)
        return np.asarray(np.clip(own + acceleration * self.period, 0.0, self.cruise))

    def _ahead(self, observations: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gap to the nearest vehicle on the route, (rows,) in m, and how fast it closes, m/s."""
        mask, place, forward = self.received(observations)
        points, distance = self.route_points(observations)
        leg = np.diff(points, axis=1)
        along = leg / np.maximum(np.linalg.norm(leg, axis=2, keepdims=True), 1e-9)
        offset = place[:, None] - points[:, :-1, None]
        ahead = (offset * along[:, :, None]).sum(axis=-1)
        aside = np.abs(along[..., :1] * offset[..., 1] - along[..., 1:] * offset[..., 0])
        on_it = mask[:, None] & (aside < self.half_width) & (ahead > 0.0) & (ahead <= np.diff(distance)[:, None])
        gaps = np.where(on_it, ahead + distance[:-1, None] - self.length, np.inf)
        theirs = self.cruise * (forward[:, None] * along[:, :, None]).sum(axis=-1)
        first = np.argmin(gaps.reshape(len(own), -1), axis=1)
        gap, speed = (part.reshape(len(own), -1)[np.arange(len(own)), first] for part in (gaps, theirs))
        return gap, np.where(np.isfinite(gap), own - speed, 0.0)


class StopWhenLost(RouteFollower):
    """The route follower, but it stands still while its position is too uncertain, for a limited time.

    It waits again only after having been certain in between, so that it never stalls.
    """

    needs = ("position_std",)
    remembers = 1  # decisions for which it has been lost
    threshold = 0.15  # m, standard deviation of the position above which it stops
    patience = 3.0  # s, longest time to stand

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.longest = round(self.patience * scenario.rates.decision)  # decisions

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """See `RouteFollower.speed`."""
        lost = self.read(observations, "position_std")[:, 0] > np.log10(self.threshold)
        (waited,) = self.memory(observations)
        waited[:] = np.where(lost, waited + 1, 0)
        stands = lost & (waited <= self.longest)
        return np.where(stands, 0.0, super().speed(observations, points))


class KeepContact(RouteFollower):
    """The route follower, which slows down where the next car behind falls back towards the reach of its sensors.

    Sensors between vehicles then keep measuring, from the first car to the last. Up to half of the reach it drives at
    full speed, beyond it ever slower.
    """

    needs = ("message_position",)
    slowest = 0.5  # of the top speed, so that a car behind that never moves again does not hold it for ever

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        others = range(len(scenario.landmarks), len(scenario.target_names))
        sensors = [s for s in scenario.sensors if any(s.measures(scenario, other) for other in others)]
        ranges = [sensor.range for sensor in sensors] + [camera.range for camera in scenario.cameras]
        self.reach = min((reach for reach in ranges if reach is not None), default=np.inf)
        """Shortest range of any sensor of vehicles, m."""

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """See `RouteFollower.speed`."""
        mask, place, _ = self.reported(observations)
        behind = mask & (place[..., 0] < 0.0)
        gap = np.min(np.linalg.norm(place, axis=-1), axis=1, where=behind, initial=np.inf)
        gap = np.where(behind.any(axis=1), gap, 0.0)  # without a car behind nothing is to keep
        share = np.clip(2.0 * (1.0 - gap / self.reach), self.slowest, 1.0)
        return np.asarray(share * super().speed(observations, points))


class Peek(RouteFollower):
    """The route follower, which turns off its route to see more landmarks of the map where its position is uncertain.

    It takes the smallest of a few headings from which most of the known landmarks would be in view a moment later, past
    buildings and vehicles with a received message, and none that leads farther from the route once it is too far off.
    With a camera that pans it turns that instead.
    """

    needs = ("position_std", "map_position", "route_heading", "route_offset")
    threshold = 0.1  # m, standard deviation of the position from which on it peeks
    ahead = 0.4  # m, how far ahead the view is predicted; in proportion farther for a car that is longer than `SMALL`
    farthest = 0.6  # m, offset from the route from which on it does not lead farther away

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.view, self.occluders = FieldOfView(scenario.camera), Occluders(scenario, self.layout)
        self.ahead *= self.scale
        self.pans = next((field.high for field in self.layout.action if field.name == "pan"), 0.0)

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        heading = self.read(observations, "route_heading")[:, 0]
        lost = self.read(observations, "position_std")[:, 0] > np.log10(self.threshold)
        offset = np.where(lost, self.offset(observations, heading), 0.0)
        speed, along = self.speed(observations), self.pursue(self.direction(observations))
        if self.pans:
            return speed, along, offset - heading
        return speed, np.where(offset == 0.0, along, self.pursue(offset - heading))

    def offset(self, observations: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Return the heading, (rows,) in rad relative to the route, from which most landmarks would be in view."""
        landmarks = self.read(observations, "map_position")[..., :2]
        aside = self.read(observations, "route_offset")
        offsets = np.array([offset for offset in OFFSETS if not self.pans or abs(offset) <= self.pans])
        turned = offsets - heading[:, None]  # in the own frame
        forward = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
        place = self.ahead * forward
        seen = self.view.sees(landmarks[:, None] - place[:, :, None], turned[..., None])
        seen &= self.known(observations)[:, None]
        boxes = self.occluders.boxes(partial(self.read, observations))
        seen = unhidden(boxes, seen, place + self.view.ahead * forward, landmarks, self.ahead)
        too_far = (np.abs(aside) > self.farthest) & (offsets * aside > 0.0)
        return np.asarray(offsets[np.argmax(np.where(too_far, -1, seen.sum(axis=-1)), axis=1)])
