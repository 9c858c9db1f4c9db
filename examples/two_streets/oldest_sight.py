"""A rule over choices: serve the vehicle that has not measured the helper for longest.

Drive it with `coopenv evaluate two_streets.toml --agents oldest_sight.py:OldestSight,look_ahead` in this folder.
"""

import numpy as np

from coopenv.policies.choices import Choices
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets


class OldestSight(Choices):
    """A helper serves the vehicle that has not measured it for longest; all other vehicles follow their routes.

    Helpers measure landmarks, and the vehicles that they serve measure helpers instead. Ages grow alike, so a helper
    stays with a vehicle until that has measured it.
    """

    needs = (*Choices.needs, "seen_age")

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
        mask, *_ = self.reported(observations)
        open_to = mask & self.serves[np.arange(len(mask)) % len(self.serves)]
        oldest = np.argmax(np.where(open_to, self.read(observations, "seen_age"), -1.0), axis=1)
        return np.where(open_to.any(axis=1), self.first_served + oldest, 0)
