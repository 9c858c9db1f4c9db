"""Recursive decentralised localisation with pairwise communication, as far as one-way messages carry it.

Source: Luft, Schubert, Roumeliotis and Burgard, Recursive decentralized localization for multi-robot systems with
asynchronous pairwise communication, International Journal of Robotics Research 37(10), 2018. Sigma_ij is kept in
factors; odometry and landmarks change one's own alone, and a bearing from i to j changes Sigma_ij exactly, while every
other one is carried on by Sigma_ii+ Sigma_ii-^-1.

The deviation: there a measurement corrects both vehicles, which exchange covariances and factors both ways. Here
messages are broadcast, and who is seen does not learn of it: j is considered with its covariance and the
cross-covariance, and only i is corrected. The product Sigma_ij is kept by i; j's factor carries it on (neighbours.py).
"""

import numpy as np

from coopenv.observers.contract import Tick
from coopenv.observers.lines import Lines, Sight
from coopenv.observers.neighbours import Considering


class Pairwise(Considering):
    """Keeps cross-covariances pair by pair.

    It sends its pose with covariance and its factor. It tells the normalised innovation of the landmarks.
    """

    def correct(self, tick: Tick, sight: Sight, lines: Lines) -> None:
        """Correct by the landmarks, then by neighbours one at a time."""
        known = np.array([target not in self.neighbours for target in sight.targets.tolist()])
        if known.any():
            self.nis, self.nis_dof = self.consider(tick, sight.only(known)), 2 * int(known.sum())
        for n in np.flatnonzero(~known).tolist():
            self.consider(tick, sight.one(n))
