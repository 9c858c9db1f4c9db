"""How much larger or smaller the motion noise is than the tuning says, learnt from the innovations.

The logarithm l of a factor on the noise's standard deviation follows the gradient of the innovations' likelihood. With
a share s of the innovation's variance that is due to motion and r the normalised innovation squared,

    d log p / dl = s (r - 1) / 2,    E[(d log p / dl)^2] = s^2 / 2

(in a steady state the covariance grows with the deviation of the noise, not with its square). r is bounded, so that a
misread bearing says little; what was learnt fades, so that another floor is found out.
"""

import math

MEMORY = 150.0  # bearings, over which what was learnt fades
LARGEST_RATIO = 9.0
HIGHEST = math.log(4.0)


class NoiseLevel:
    """The factor of one robot, 1 at the start; `std` is that of its logarithm before anything was seen, 0: fixed."""

    def __init__(self, std: float) -> None:
        self.factor = 1.0  # on variances
        self._log = 0.0
        self._prior = 1 / std**2 if std > 0 else math.inf
        self._information = 0.0

    def learn(self, ratio: float, share: float) -> None:
        """Take a normalised innovation squared, and the share of its variance that is due to motion."""
        if self._prior == math.inf:
            return
        self._information = (1 - 1 / MEMORY) * self._information + share**2 / 2
        slope = share * (min(ratio, LARGEST_RATIO) - 1) / 2 - self._prior * self._log / MEMORY
        step = slope / (self._information + self._prior)
        self._log = min(max(self._log + step, 0.0), HIGHEST)
        self.factor = math.exp(2 * self._log)
