"""highway-env's road network as strips for pictures."""

from itertools import pairwise
from typing import Any

import numpy as np

from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Road

BEND = 2.0  # m, length of a strip of a lane that bends
MARGIN = 25.0  # m, of road that is drawn beyond the outermost landmark


def drawn_roads(network: Any, scenario: Scenario) -> tuple[Road, ...]:
    """Return strips of all lanes as far as the landmarks stand, y up, in the coordinates of the scenario's file."""
    places = [landmark.position[:2] for landmark in scenario.landmarks] or [(0.0, 0.0)]
    reach = float(np.abs(places).max()) + MARGIN
    return tuple(road for lane in network.lanes_list() for road in _strips(lane, reach))


def _strips(lane: Any, reach: float) -> list[Road]:
    s = np.linspace(0.0, lane.length, max(2, int(np.ceil(lane.length / BEND)) + 1))
    middle = np.array([lane.position(x, 0.0) for x in s]) * (1.0, -1.0)
    middle = middle[np.abs(middle).max(axis=1) <= reach]
    if np.ptp([lane.heading_at(x) for x in s]) < 1e-9:
        middle = middle[[0, -1]] if len(middle) else middle  # straight: one strip
    width = float(lane.width_at(0.0))
    return [
        Road(start=(ax, ay), end=(bx, by), width=width, marked=False)
        for (ax, ay), (bx, by) in pairwise(middle.tolist())
        if (ax, ay) != (bx, by)
    ]
