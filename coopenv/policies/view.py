"""What a camera would see of the map from somewhere else, as its vehicle believes."""

import math

import numpy as np

from coopenv.scenario.sensing import Camera

MARGIN = math.radians(1.5)  # kept from the edges of the image
SHARE = 0.95  # of the range


class FieldOfView:
    """The horizontal field of view of a camera that looks ahead."""

    def __init__(self, camera: Camera) -> None:
        """Take over a camera; one without an image sees all around."""
        self.reach = SHARE * camera.range if camera.range is not None else math.inf
        self.ahead = float(camera.position[0])
        self.left, self.right = math.pi, -math.pi
        if camera.model == "pinhole":
            focal, middle, width = camera.focal_length[0], camera.principal_point[0], camera.image_size[0]
            self.left = math.atan(middle / focal) - MARGIN
            self.right = -math.atan((width - middle) / focal) + MARGIN

    def sees(self, offset: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Return whether points are in view, (...).

        Args:
            offset: (..., 2), m, from the vehicle's reference point.
            heading: (...), rad, of the camera, in the same frame.
        """
        angle, distance = self._polar(offset, heading)
        return np.asarray((distance <= self.reach) & (angle <= self.left) & (angle >= self.right))

    def odds(self, offset: np.ndarray, heading: np.ndarray, angle_std: np.ndarray, range_std: np.ndarray) -> np.ndarray:
        """Return how likely points are in view where their direction and distance are uncertain, (...) in [0, 1].

        Args:
            offset: (..., 2), m, from the vehicle's reference point.
            heading: (...), rad, of the camera, in the same frame.
            angle_std: (...), rad, above 0.
            range_std: (...), m, above 0.
        """
        angle, distance = self._polar(offset, heading)
        inside = np.minimum(self.left - angle, angle - self.right)
        return np.asarray(_share(inside / angle_std) * _share((self.reach - distance) / range_std))

    def _polar(self, offset: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return direction, rad, and distance, m, of points from the camera, (...)."""
        cosine, sine = np.cos(heading), np.sin(heading)
        x, y = offset[..., 0] - self.ahead * cosine, offset[..., 1] - self.ahead * sine
        return np.arctan2(cosine * y - sine * x, cosine * x + sine * y), np.sqrt(x * x + y * y)


def _share(margin: np.ndarray) -> np.ndarray:
    """Return the share of a uniform distribution of standard deviation 1 that lies below a margin."""
    return np.clip(0.5 + margin / (2.0 * math.sqrt(3.0)), 0.0, 1.0)
