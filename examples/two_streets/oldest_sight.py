"""A rule over choices: serve the vehicle that has not measured the helper for longest.

Drive it with `coopenv evaluate two_streets.toml --agents oldest_sight.py:OldestSight,look_ahead` in this folder.
"""

import numpy as np

from coopenv.policies.choices import Choices
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets


class OldestSight(Choices):
    """A helper serves the vehicle that has not measured it for longest; all other vehicles follow their routes.

    Helpers measure landmarks, and the vehicles that they serve measure helpers instead. A helper stays with a vehicle
    until that has measured it, and changes only to one whose last sight is older by `patience`.
    """

    needs = (*Choices.needs, "seen_age")
    patience = 1.3
    """Ratio of the ages above which a helper changes to another vehicle."""

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        landmarks, sets = len(scenario.landmarks), neighbour_sets(scenario)
        localised = [any(target < landmarks for target in targets) for targets in sets]
        vehicles = range(len(sets))
        self.serves = np.array(
            [
                [localised[i] and not localised[k] and landmarks + i in sets[k] for k in vehicles if k != i]
                for i in vehicles
            ]
        ).reshape(len(sets), -1)
        """(N, N - 1), whether a vehicle helps the sender of each message."""

    def choose(self, observations: np.ndarray, present: np.ndarray) -> np.ndarray:
        """See `Choices.choose`."""
        rows = np.arange(len(present))
        mask, *_ = self.reported(observations)
        open_to = mask & self.serves[rows % len(self.serves)]
        need = np.where(open_to, self.read(observations, "seen_age") + 0.5 / self.kept, -1.0)
        oldest = np.argmax(need, axis=1)
        now = np.maximum(present - self.first_served, 0)
        stays = (present >= self.first_served) & open_to[rows, now]
        stays &= self.patience * need[rows, now] >= need[rows, oldest]
        chosen = self.first_served + np.where(stays, now, oldest)
        return np.where(open_to.any(axis=1), chosen, 0)
