"""Schmidt-Kalman filter: neighbours are considered with all cross-covariances, never corrected.

Source: Schmidt, Application of state-space methods to navigation problems, Advances in Control Systems 3, 1966; for
vehicles that consider each other, the cross-covariances of Roumeliotis and Bekey, Distributed multirobot localization,
IEEE Transactions on Robotics and Automation 18(5), 2002. One's own pose and those of the neighbours in view are one
state, in which the gain of the neighbours is zero. What neighbours have in common with each other is what they tell:
each sends the cross-covariances that it keeps with its own. What changes those is carried on as neighbours.py tells.
"""

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Message, Tick
from coopenv.observers.lines import Lines, Sight
from coopenv.observers.neighbours import Considering


class SchmidtKalman(Considering):
    """Considers neighbours with cross-covariances.

    It sends its pose with covariance, its factor, and the cross-covariances that it keeps.
    """

    def message(self) -> Message:
        """Return what others need to consider this vehicle and what it has in common with its neighbours."""
        told = super().message()
        targets = sorted(self.neighbours)
        cross = np.array([self.to_marker.dot(self.neighbours[t].cross) for t in targets]).reshape(-1, 6, 6)
        extra: dict[str, Array] = {**told.extra, "targets": np.array(targets, float), "cross": cross}
        return Message(told.position, told.rotation, told.covariance, extra)

    def correct(self, tick: Tick, sight: Sight, lines: Lines) -> None:
        """Correct by all bearings at once."""
        seen = [
            (target, message)
            for target, message in zip(sight.targets.tolist(), sight.messages, strict=True)
            if target in self.neighbours and message is not None
        ]
        told = np.zeros((len(seen), len(seen), 6, 6))
        for n, (target, message) in enumerate(seen):
            for m, (other, its) in enumerate(seen[:n]):
                told[n, m] = told_of(message, other) + told_of(its, target).T
        self.nis, self.nis_dof = self.consider(tick, sight, told), 2 * len(sight.targets)


def told_of(message: Message, target: int) -> Array:
    """Return the cross-covariance (6, 6) of a sender with a target as it tells it, zero where it tells none."""
    targets, cross = (np.asarray(message.extra.get(name, ())) for name in ("targets", "cross"))
    if targets.ndim != 1 or cross.shape != (len(targets), 6, 6):
        return np.zeros((6, 6))
    found = np.flatnonzero(targets == target)
    return np.asarray(cross[found[0]]) if len(found) else np.zeros((6, 6))
