"""Looking where landmarks are, one step ahead."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.policies.view import FieldOfView
from coopenv.scenario import Scenario

OFFSETS = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6, 0.8, -0.8)
"""Of the heading from that of the way, rad, those that are preferred first."""


class Peek(RouteFollower):
    """The route follower, but where its position is uncertain it turns off its way to see more landmarks of the map.

    It takes the smallest of a few headings from which most of the known landmarks would be in view a moment later, and
    none that leads farther from the way once it is too far from it. With a camera that pans it turns that instead.
    """

    needs = ("position_std", "map_position", "route_heading", "route_offset")

    def __init__(
        self, scenario: Scenario, *, threshold: float = 0.1, ahead: float = 0.4, farthest: float = 0.6
    ) -> None:
        """Choose when to peek.

        Args:
            scenario: of the environment.
            threshold: standard deviation of the position from which on it peeks, m.
            ahead: how far ahead the view is predicted, m.
            farthest: offset from the way from which on it does not lead farther away, m.
        """
        super().__init__(scenario)
        self.view = FieldOfView(scenario.camera)
        self.threshold, self.ahead, self.farthest = np.log10(threshold), ahead, farthest
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
        known = self.known(observations)
        aside = self.read(observations, "route_offset")[:, 0]
        best, most = np.zeros(len(heading)), np.full(len(heading), -1)
        for offset in OFFSETS:
            if self.pans and abs(offset) > self.pans:
                continue
            turned = offset - heading  # in the own frame
            place = self.ahead * np.stack([np.cos(turned), np.sin(turned)], axis=-1)
            seen = self.view.sees(landmarks - place[:, None], turned[:, None]) & known
            count = np.where((np.abs(aside) > self.farthest) & (offset * aside > 0.0), -1, seen.sum(axis=1))
            best, most = np.where(count > most, offset, best), np.maximum(count, most)
        return best
