"""Write sensors of one's own: differences of ranges to beacons, and a Doppler radar; compare observers with them.

Run: python examples/own_sensors.py (about 20 s)
"""

from pathlib import Path

import numpy as np

import coopenv


def away(own, point):
    """Return the distance of a point, m, and the unit vector to it."""
    line = point - own.position
    distance = np.linalg.norm(line)
    return distance, line / distance


class RangeDifference:
    """Difference of the distances to a beacon and to a reference, m, by arrival times of their signals."""

    noise, units = 0.05, ("m",)
    towards = ("anchors",)

    def __init__(self, reference, reach=30.0):
        self.reference, self.reach = reference, reach

    def predict(self, own, target):
        return away(own, target.position)[0] - away(own, own.landmarks[self.reference])[0]

    def jacobian(self, own, target):
        _, u = away(own, target.position)
        _, to_reference = away(own, own.landmarks[self.reference])
        zero = np.zeros(3)
        return np.hstack([zero, to_reference - u]), np.hstack([zero, u])

    def sensed(self, own, target):
        reference = own.landmarks[self.reference]
        return np.any(target.position != reference) and away(own, reference)[0] < self.reach


class Doppler:
    """Speed at which the distance to a target grows, m/s."""

    noise, units = 0.05, ("m/s",)

    def predict(self, own, target):
        return away(own, target.position)[1] @ (target.velocity - own.velocity)


if __name__ == "__main__":
    scenario = Path(__file__).with_name("own_sensors.toml")
    print(coopenv.compare(["schmidt_kalman", "mekf"], scenario, seeds=2, sensors=True))
