"""A driver that turns to landmarks while it is lost."""

from functools import partial

import numpy as np

from coopenv.policies.look_ahead import OFFSETS
from coopenv.policies.prediction import FieldOfView, Occluders, unhidden
from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario


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
