"""Predictions along a plan, in the plane: pose covariances, and what cameras will see.

Extended Kalman filter with bearings to known landmarks. Source: Thrun, Burgard and Fox, Probabilistic Robotics, 2005,
3.3 and 7.5. The covariance depends on where bearings are measured, not on their values, so it can be predicted;
Prentice and Roy, The belief roadmap, International Journal of Robotics Research 28, 2009. Measurements that may be
missing count by their odds; Sinopoli et al., Kalman filtering with intermittent observations, IEEE Transactions on
Automatic Control 49, 2004.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Body
from coopenv.scenario.sensing import Camera

LEAST_ODDS = 0.02  # below them a bearing counts as missing


class PlanarCovariance(NamedTuple):
    """Entries (...) of the covariance of x, y (m) and heading (rad), in any fixed frame."""

    xx: np.ndarray
    xy: np.ndarray
    xh: np.ndarray
    yy: np.ndarray
    yh: np.ndarray
    hh: np.ndarray

    def driven(self, dx: np.ndarray, dy: np.ndarray, drift: float, turn_drift: float) -> "PlanarCovariance":
        """Return the covariance after a motion by (dx, dy), m, along which the error grew.

        Args:
            dx: (...), m.
            dy: (...), m.
            drift: m^2, growth of the variance per axis.
            turn_drift: rad^2, growth of the heading's variance.
        """
        return PlanarCovariance(
            xx=self.xx - 2.0 * dy * self.xh + dy * dy * self.hh + drift,
            xy=self.xy + dx * self.xh - dy * self.yh - dx * dy * self.hh,
            xh=self.xh - dy * self.hh,
            yy=self.yy + 2.0 * dx * self.yh + dx * dx * self.hh + drift,
            yh=self.yh + dx * self.hh,
            hh=self.hh + turn_drift,
        )

    def along(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return variances (..., K) of landmarks' bearing, rad^2, of their distance and across it, m^2.

        Args:
            offset: (..., K, 2), m, from the vehicle to the landmarks.
        """
        distance = np.sqrt(np.maximum(offset[..., 0] ** 2 + offset[..., 1] ** 2, 0.01))
        ux, uy = offset[..., 0] / distance, offset[..., 1] / distance
        xx, xy, xh, yy, yh, hh = (part[..., None] for part in self)
        radial = ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy
        lateral = uy * uy * xx - 2.0 * ux * uy * xy + ux * ux * yy
        bearing = lateral / distance**2 + 2.0 * (ux * yh - uy * xh) / distance + hh
        return np.maximum(bearing, 1e-8), np.maximum(radial, 1e-8), np.maximum(lateral, 1e-8)

    def measured(self, offset: np.ndarray, variance: np.ndarray, odds: np.ndarray) -> "PlanarCovariance":
        """Return the expected covariance after bearings to landmarks, any of which may be missing.

        One after the other, the covariance falls by the share `odds` of what the bearing would take off it.

        Args:
            offset: (..., K, 2), m, from the vehicle to the landmarks.
            variance: (..., K), rad^2, of each bearing.
            odds: (..., K), how likely it is had, in [0, 1].
        """
        shape = odds.shape[:-1]
        parts = np.stack([np.broadcast_to(part, shape).ravel() for part in self])
        flat = parts.shape[1], (count := odds.shape[-1])
        offset, variance, odds = offset.reshape(*flat, 2), variance.reshape(flat), odds.reshape(flat)
        for k in range(count):
            rows = np.flatnonzero(odds[:, k] > LEAST_ODDS)
            if len(rows):
                own = PlanarCovariance(*parts[:, rows])
                parts[:, rows] = own._with_bearing(offset[rows, k], variance[rows, k], odds[rows, k])
        return PlanarCovariance(*(part.reshape(shape) for part in parts))

    def _with_bearing(self, offset: np.ndarray, variance: np.ndarray, odds: np.ndarray) -> tuple[np.ndarray, ...]:
        square = np.maximum(offset[..., 0] ** 2 + offset[..., 1] ** 2, 0.01)
        gx, gy = offset[..., 1] / square, -offset[..., 0] / square  # of the bearing, which falls by 1 with the heading
        x = self.xx * gx + self.xy * gy - self.xh
        y = self.xy * gx + self.yy * gy - self.yh
        h = self.xh * gx + self.yh * gy - self.hh
        gain = odds / (gx * x + gy * y - h + variance)
        return (
            self.xx - gain * x * x,
            self.xy - gain * x * y,
            self.xh - gain * x * h,
            self.yy - gain * y * y,
            self.yh - gain * y * h,
            self.hh - gain * h * h,
        )

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of the position, (...), m: the root of the trace."""
        return np.asarray(np.sqrt(np.maximum(self.xx + self.yy, 0.0)))


Read = Callable[[str], np.ndarray]
"""Returns a field of the observations in its unit, (rows, *shape)."""


class Occluder(NamedTuple):
    """An upright box in the own frame of every row."""

    center: np.ndarray
    """(rows, 2), m."""
    forward: np.ndarray
    """(rows, 2), of length 1, along its length."""
    half: tuple[float, float]
    """Half of its length and width, m."""
    below: float
    """Share of a line of sight, from the camera on, that is lower than its top."""
    there: np.ndarray
    """(rows,) bool."""
    moves: bool
    """True if it continues along `forward`."""


class Occluders:
    """The boxes that stand between a camera and landmarks; in the plane, with landmarks at their mean height."""

    def __init__(self, scenario: Scenario, layout: Mapping[str, object]) -> None:
        """Take sizes of vehicles and places of buildings, as far as the observation has the fields for them."""
        bodies = [vehicle.body for vehicle in scenario.vehicles]
        self._sizes: list[Body | None] = []
        if {"message_position", "message_forward", "message_mask"} <= {*layout}:
            # Slot n is vehicle n, or n + 1 for those that come before it: the larger is the safe guess.
            self._sizes = [max(pair, key=lambda b: b.size[0] * b.size[1] if b else 0.0) for pair in pairwise(bodies)]
        located = {"estimate_position", "estimate_forward"} <= {*layout}
        self._buildings = scenario.obstacles if located else ()
        self._origin = np.array(scenario.map.origin[:2])
        self._camera = float(scenario.camera.position[2])
        heights = [landmark.position[2] for landmark in scenario.landmarks if landmark.group is None]
        heights += [sum(group.height) / 2 for group in scenario.landmark_groups for _ in range(group.count)]
        self._rise = max(float(np.mean(heights)) - self._camera, 1e-6) if heights else 1e-6

    def boxes(self, read: Read) -> list[Occluder]:
        """Return the boxes in each row's observation."""
        found = [*self._vehicles(read), *self._houses(read)]
        return [box for box in found if box.below > 0.0 and box.there.any()]

    def _below(self, top: float) -> float:
        return min((top - self._camera) / self._rise, 1.0)

    def _vehicles(self, read: Read) -> Iterator[Occluder]:
        for slot, body in enumerate(self._sizes):
            if body is None:
                continue
            forward = read("message_forward")[:, slot, :2]
            forward = forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
            left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
            center = read("message_position")[:, slot, :2] + body.center[0] * forward + body.center[1] * left
            half = body.size[0] / 2, body.size[1] / 2
            below = self._below(body.center[2] + body.size[2] / 2)
            yield Occluder(center, forward, half, below, read("message_mask")[:, slot] > 0.5, moves=True)

    def _houses(self, read: Read) -> Iterator[Occluder]:
        if not self._buildings:
            return
        place, ahead = read("estimate_position")[:, :2], read("estimate_forward")[:, :2]
        ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        turn = np.stack([ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)], axis=1)  # map to own frame
        for house in self._buildings:
            center = np.array(house.center[:2]) - self._origin - place
            forward = turn @ np.array([np.cos(house.yaw), np.sin(house.yaw)])
            half, top = (house.size[0] / 2, house.size[1] / 2), house.center[2] + house.size[2] / 2
            there = np.ones(len(place), dtype=bool)
            yield Occluder(np.einsum("rij,rj->ri", turn, center), forward, half, self._below(top), there, moves=False)


def unhidden(
    boxes: list[Occluder], seen: np.ndarray, camera: np.ndarray, points: np.ndarray, distance: float
) -> np.ndarray:
    """Return flags (rows, P, K) of points in view that no box occludes.

    Args:
        boxes: of `Occluders.boxes`.
        seen: (rows, P, K), which points are in view without the boxes.
        camera: (rows, P, 2), m, where the camera is.
        points: (rows, K, 2), m.
        distance: m that moving boxes have driven since the observation.
    """
    place = np.nonzero(seen)  # few
    row, plan, point = place
    start = camera[row, plan]
    line = points[row, point] - start
    blocked = np.zeros(len(row), dtype=bool)
    for box in boxes:
        offset = (box.center + distance * box.forward if box.moves else box.center)[row] - start
        forward = box.forward[row]
        enter, leave = np.zeros(len(row)), np.full(len(row), box.below)
        left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
        for axis, half in zip((forward, left), box.half, strict=True):
            middle, along = (offset * axis).sum(axis=-1), (line * axis).sum(axis=-1)
            along = np.where(np.abs(along) < 1e-9, 1e-9, along)
            first, last = (middle - half) / along, (middle + half) / along
            enter = np.maximum(enter, np.minimum(first, last))
            leave = np.minimum(leave, np.maximum(first, last))
        blocked |= (enter < leave) & box.there[row]
    left_over = seen.copy()
    left_over[place] = ~blocked
    return left_over


MARGIN = math.radians(1.5)  # kept from the edges of the image
SHARE = 0.95  # of the range


class FieldOfView:
    """The horizontal field of view of a camera that looks ahead."""

    def __init__(self, camera: Camera) -> None:
        """Take a camera; one without an image has a field of view of 360 degrees, the model "none" sees nothing."""
        self.reach = SHARE * camera.range if camera.range is not None else math.inf
        self.reach = -1.0 if camera.model == "none" else self.reach
        self.ahead = float(camera.position[0])
        self.left, self.right = math.pi, -math.pi
        if camera.model == "pinhole":
            focal, middle, width = camera.focal_length[0], camera.principal_point[0], camera.image_size[0]
            self.left = math.atan(middle / focal) - MARGIN
            self.right = -math.atan((width - middle) / focal) + MARGIN

    @classmethod
    def of_rows(cls, views: Sequence["FieldOfView"], index: np.ndarray) -> "FieldOfView":
        """Return the view that each row has, of those with these indices, (rows,)."""
        found = cls.__new__(cls)
        for name in vars(views[0]):
            setattr(found, name, np.array([getattr(view, name) for view in views])[index][:, None, None])
        return found

    def sees(self, offset: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Return whether points are in view, (...).

        Args:
            offset: (..., 2), m, from the vehicle's reference point.
            heading: (...), rad, of the camera, in the same frame.
        """
        angle, distance = self._polar(offset, heading)
        return np.asarray((distance <= self.reach) & (angle <= self.left) & (angle >= self.right))

    def odds(self, offset: np.ndarray, heading: np.ndarray, angle_std: np.ndarray, range_std: np.ndarray) -> np.ndarray:
        """Return the probability (...) that points of uncertain direction and distance are in view.

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
