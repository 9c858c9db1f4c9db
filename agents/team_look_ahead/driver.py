"""The planner of look_ahead for a fleet."""

import numpy as np

from coopenv.policies.look_ahead import Follower, LookAhead, senders_in_slots
from coopenv.policies.prediction import PlanarCovariance
from coopenv.scenario import Scenario


class TeamLookAhead(LookAhead):
    """The planner for the fleet: plans also have a pace, and a cost for the losses of other vehicles.

    For every vehicle that may measure the planning one, the covariance of that vehicle is predicted, with the bearings
    to the planning vehicle as the only ones; its uncertainty costs as much as the own. It plans with the covariances of
    all vehicles, which no vehicle has by itself: a reference for cooperation, which needs the rows of the whole fleet.
    """

    needs = (*LookAhead.needs, "position_std", "message_position", "route_left")
    clearance = np.inf  # others do not expect a vehicle to slow down or turn aside for them
    plan_paces = (1.0, 0.75, 0.5, 0.25)

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        fleet, landmarks = range(len(scenario.vehicles)), len(scenario.landmarks)
        self._measures = np.array([[landmarks + vehicle in row for vehicle in fleet] for row in self._neighbours])
        self._radius = np.array([vehicle.goal_radius for vehicle in scenario.vehicles])

    def avoided(self, senders: np.ndarray, vehicle: np.ndarray) -> np.ndarray:
        """See `LookAhead.avoided`: here all, for the reason for which `clearance` has no bound."""
        return senders

    def followers(self, observations: np.ndarray, due: np.ndarray) -> list[Follower]:
        """See `LookAhead.followers`.

        Raises:
            ValueError: there are not the rows of all vehicles.
        """
        count = len(self._top)
        if len(observations) % count:
            raise ValueError(f"it plans for all vehicles: rows: {len(observations)}, allowed: multiples of {count}")
        mask, place, forward = (part[due] for part in self.reported(observations))
        axes, std = (10.0 ** self.read(observations, name).astype(float) for name in ("axis_std", "heading_std"))
        heading, left = (self.read(observations, name)[:, 0] for name in ("route_heading", "route_left"))
        found, own = [], due % count
        for slot, vehicle in enumerate(senders_in_slots(own, mask.shape[1]).T):
            other = due - own + vehicle
            counts = self._measures[vehicle, own] & mask[:, slot] & (left[other] > self._radius[vehicle])
            row = np.flatnonzero(counts)
            vehicle, other, none = vehicle[row], other[row], np.zeros((len(row), 1))
            angle = np.arctan2(forward[row, slot, 1], forward[row, slot, 0]) - heading[other]
            along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            variances = (axes[other, :1] ** 2, none, none, axes[other, 1:2] ** 2, none, std[other] ** 2)
            speed = self._top[vehicle][:, None]
            found.append(Follower(row, vehicle, place[row, slot], along, speed, PlanarCovariance(*variances)))
        return [each for each in found if len(each.row)]
