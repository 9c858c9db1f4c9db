"""Looking where landmarks are, one step ahead."""

from functools import partial

import numpy as np

from coopenv.policies.occluders import Occluders, unhidden
from coopenv.policies.route_follower import RouteFollower
from coopenv.policies.view import FieldOfView
from coopenv.scenario import Scenario

OFFSETS = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6, 0.8, -0.8)
"""Of the heading from that of the way, rad, those that are preferred first."""


class Peek(RouteFollower):
    """The route follower, but where its position is uncertain it turns off its way to see more landmarks of the map.

    It takes the smallest of a few headings from which most of the known landmarks would be in view a moment later, past
    buildings and the vehicles that it hears, and none that leads farther from the way once it is too far from it. With
    a camera that pans it turns that instead.
    """

    needs = ("position_std", "map_position", "route_heading", "route_offset")

    def __init__(
        self, scenario: Scenario, *, threshold: float = 0.1, ahead: float = 0.4, farthest: float = 0.6
    ) -> None:
        """Choose when to peek.

        Args:
            scenario: of the environment.
            threshold: standard deviation of the position from which on it peeks, m.
            ahead: how far ahead the view is predicted, m; in proportion farther for a car that is longer than `SMALL`.
            farthest: offset from the way from which on it does not lead farther away, m.
        """
        super().__init__(scenario)
        self.view, self.occluders = FieldOfView(scenario.camera), Occluders(scenario, self.layout)
        self.threshold, self.ahead, self.farthest = np.log10(threshold), ahead * self.scale, farthest
        self.pans = next((field.high for field in self.layout.action if field.name == "pan"), 0.0)

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        heading = self.read(observations, "route_heading")[:, 0]
        lost = self.read(observations, "position_std")[:, 0] > self.threshold
        offset = np.where(lost, self.offset(observations, heading), 0.0)
        speed, along = self.speed(observations), self.pursue(self.direction(observations))
        if self.pans:
            return speed, along, offset - heading
        return speed, np.where(offset == 0.0, along, self.pursue(offset - heading))

    def offset(self, observations: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Return the heading, (rows,) in rad from the way's, from which most landmarks would be in view."""
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
