"""A driver at constant speed."""

import numpy as np

from coopenv.policies.route_follower import Driver


class ConstantSpeed(Driver):
    """Straight on at full speed, whatever happens."""

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        return np.full(len(observations), self.cruise), np.zeros(len(observations))
