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
        forward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        line = offset - self.ahead * forward
        along = (line * forward).sum(axis=-1)
        aside = forward[..., 0] * line[..., 1] - forward[..., 1] * line[..., 0]
        angle = np.arctan2(aside, along)
        near = (line**2).sum(axis=-1) <= self.reach**2
        return np.asarray(near & (angle <= self.left) & (angle >= self.right))
