"""What hides landmarks, as a vehicle believes: buildings of the map, and vehicles where their messages put them."""

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Body

Read = Callable[[str], np.ndarray]
"""Returns a field of the observations in its unit, (rows, *shape)."""


class Box(NamedTuple):
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
    """Whether it goes on along `forward`."""


class Occluders:
    """The boxes that stand between a camera and landmarks; in the plane, with landmarks at their mean height."""

    def __init__(self, scenario: Scenario, layout: Mapping[str, object]) -> None:
        """Learn sizes and the places of buildings; what the observation does not tell is left out."""
        bodies = [vehicle.body for vehicle in scenario.vehicles]
        self._sizes: list[Body | None] = []
        if {"message_position", "message_forward", "message_mask"} <= {*layout}:
            # Slot n is vehicle n, or n + 1 for those that come before it: the larger is the safe guess.
            self._sizes = [max(pair, key=_footprint) for pair in pairwise(bodies)]
        located = {"estimate_position", "estimate_forward"} <= {*layout}
        self._buildings = scenario.obstacles if located else ()
        self._origin = np.array(scenario.map.origin[:2])
        self._camera = float(scenario.camera.position[2])
        heights = [landmark.position[2] for landmark in scenario.landmarks if landmark.group is None]
        heights += [sum(group.height) / 2 for group in scenario.landmark_groups for _ in range(group.count)]
        self._rise = max(float(np.mean(heights)) - self._camera, 1e-6) if heights else 1e-6

    def boxes(self, read: Read) -> list[Box]:
        """Return the boxes that each row knows of."""
        found = [*self._vehicles(read), *self._houses(read)]
        return [box for box in found if box.below > 0.0 and box.there.any()]

    def _below(self, top: float) -> float:
        return min((top - self._camera) / self._rise, 1.0)

    def _vehicles(self, read: Read) -> Iterator[Box]:
        for slot, body in enumerate(self._sizes):
            if body is None:
                continue
            forward = read("message_forward")[:, slot, :2]
            forward = forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
            left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
            center = read("message_position")[:, slot, :2] + body.center[0] * forward + body.center[1] * left
            half = body.size[0] / 2, body.size[1] / 2
            below = self._below(body.center[2] + body.size[2] / 2)
            yield Box(center, forward, half, below, read("message_mask")[:, slot] > 0.5, moves=True)

    def _houses(self, read: Read) -> Iterator[Box]:
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
            yield Box(np.einsum("rij,rj->ri", turn, center), forward, half, self._below(top), there, moves=False)


def _footprint(body: Body | None) -> float:
    return body.size[0] * body.size[1] if body else 0.0


def unhidden(boxes: list[Box], seen: np.ndarray, camera: np.ndarray, points: np.ndarray, way: float) -> np.ndarray:
    """Return which points in view no box hides, (rows, P, K) bool.

    Args:
        boxes: of `Occluders.boxes`.
        seen: (rows, P, K), which points are in view without the boxes.
        camera: (rows, P, 2), m, where the camera is.
        points: (rows, K, 2), m.
        way: m that boxes which move have gone on.
    """
    place = np.nonzero(seen)  # few
    row, plan, point = place
    start = camera[row, plan]
    line = points[row, point] - start
    blocked = np.zeros(len(row), dtype=bool)
    for box in boxes:
        offset = (box.center + way * box.forward if box.moves else box.center)[row] - start
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
